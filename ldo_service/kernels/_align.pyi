"""Binding of the alignment kernels, `kernels/align.hpp`."""

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy, pixels.

isa: str

# Average the 2x2 blocks of an image [H, W] to [H // 2, W // 2]. Zeros are missing values. Only
# values of at most (1 + `tolerance`) times the lowest value of a block are averaged. The result is
# 0 for a block with fewer than `least` such values.
def halve(values: Image, tolerance: float, least: int = 1) -> Image: ...

# Average the 2x2 blocks of a gray image [H, W] to [H // 2, W // 2]. Zeros are missing values, and
# so are gray levels of at least `clipped`. The result is 0 for a block with fewer than `least`
# values.
def halve_gray(gray: NDArray[np.uint8], clipped: int, least: int) -> Image: ...

# Combine gray levels [H, W] (0 where clipped) and depth [H, W] in meters (0 where missing) into
# texels [H, W, 4]: intensity, two gradients, depth. Depth beyond `max_depth_m` becomes 0.
def pack(image: Image, depth_m: Image, max_depth_m: float) -> Image: ...

# Compute normals [H, W, 3] towards the camera from depth [H, W] in meters, over `radius` pixels.
def normals(depth_m: Image, intrinsics: Intrinsics, radius: int) -> Image: ...

# Back-project texels with depth to points [7, N]: coordinates, intensity, normal. A missing normal
# is 0 0 0.
def points(texels: Image, normals: Image, intrinsics: Intrinsics) -> Image: ...

# Compute the Hessian [8, 8] and the gradient [8] of all residuals, and seven sums. The unknowns are
# rotation, translation, gain and bias. The first sum is the number of visible points. Three sums
# follow for the photometric residuals: number, number of inliers and sum of weighted squares. The
# last three are the same for the geometric residuals.
# `noise` is (floor, growth, nearest) of the depth noise: sigma = floor + growth (z - nearest)^2, in
# meters. `gate` is the largest depth difference between a point and the target surface. A point is
# hidden if it lies more than `occlusion` behind that surface. Both are fractions of the depth.
# `cells` has a cell number of 0..63 for each point, [N]. The last result, [64, 2, 8], is then the
# gradient of the photometric and of the geometric residuals by cell; without `cells`, it is empty.
# All of 16 consecutive points are added to the cell of their middle point.
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
    cells: NDArray[np.uint8] | None = None,
) -> tuple[
    NDArray[np.float64],
    NDArray[np.float64],
    tuple[float, float, float, float, float, float, float],
    NDArray[np.float64],
]: ...
