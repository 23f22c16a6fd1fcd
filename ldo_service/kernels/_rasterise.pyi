import numpy as np
from numpy.typing import NDArray

def isa() -> str:
    """Instruction set that this process runs with: avx512, avx2 or baseline."""

def rasterise(
    rows: NDArray[np.float32],
    T_camera_map: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    threads: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Colour [H, W, 3], weighted depth [H, W], median depth [H, W] and opacity [H, W].

    `rows` [N, 16] and `T_camera_map` [3, 4] are contiguous; `ldo_service.gaussians.render` says
    what they hold. Releases the GIL. Raises ValueError for wrong shapes, types, strides, sizes
    and cameras. Bitwise equal for any number of threads.
    """
