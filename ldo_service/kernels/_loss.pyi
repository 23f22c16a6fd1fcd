import numpy as np
from numpy.typing import NDArray

def image_loss(
    planes: NDArray[np.float32],
    color: NDArray[np.uint8],
    depth: NDArray[np.float32],
    mask: NDArray[np.uint8] | None,
    exposure: NDArray[np.float32],
    l1: float,
    d_ssim: float,
    depth_weight: float,
    gradients: NDArray[np.float32],
    threads: int = 1,
) -> tuple[float, float, float, float]:
    """(L1, D-SSIM, depth L1, squared error).

    Writes the derivatives by the planes to `gradients`; `ldo_service.gaussians.loss` says what
    the arguments hold. Releases the GIL. Raises ValueError for arrays that do not fit. Bitwise
    equal for any number of threads.
    """
