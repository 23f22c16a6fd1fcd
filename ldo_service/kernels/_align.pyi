import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Intrinsics = tuple[float, float, float, float]

isa: str

def halve(values: Image, tolerance: float, least: int = 1) -> Image: ...
def pack(image: Image, depth_m: Image, max_depth_m: float) -> Image: ...
def normals(depth_m: Image, intrinsics: Intrinsics, radius: int) -> Image: ...
def points(texels: Image, normals: Image, intrinsics: Intrinsics) -> Image: ...
def normal_equations(
    points: Image,
    texels: Image,
    intrinsics: Intrinsics,
    T_camera_reference: NDArray[np.float64],
    gain: float,
    bias: float,
    intensity_sigma: float,
    depth_noise_scale: float,
    noise: tuple[float, float, float],
    gate: float,
    occlusion: float,
) -> tuple[
    NDArray[np.float64],
    NDArray[np.float64],
    tuple[float, float, float, float, float, float, float],
]: ...
