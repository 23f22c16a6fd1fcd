import numpy as np
from numpy.typing import NDArray

def surfaces(
    depth_m: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    max_step: float,
    min_cosine: float,
    labels: NDArray[np.int32],
) -> NDArray[np.int64]:
    """Write to `labels` [H, W] which smooth piece of a depth image each pixel belongs to, 0 on
    edges and where depth is missing, and return the pixels of each label, [S].

    Pieces are numbered in the order of their first pixels, row by row. Releases the GIL. Raises
    ValueError for arrays that do not fit. One thread; where a cosine is at its threshold the
    outcome may differ between instruction sets. `ldo_service.regions.foreground` says more.
    """

def foreground(
    depth_m: NDArray[np.float32],
    focal_px: float,
    labels: NDArray[np.int32],
    sizes: NDArray[np.int64],
    row: int,
    column: int,
    min_inside: float,
    max_gap: float,
    depth_bin: float,
    near_mode: float,
    grow_px: int,
    mask: NDArray[np.uint8],
) -> None:
    """Write to `mask` [h, w], a window of the image whose first pixel lies at (row, column), what
    of it is the object in its middle: 1, else 0.

    `labels` [H, W] and `sizes` [S] as `surfaces` returns them. Releases the GIL. Raises ValueError
    for arrays that do not fit and windows that are empty or beyond the image. One thread; where a
    depth is at the edge of a bin of the mode the outcome may differ between instruction sets.
    `ldo_service.regions.foreground` says more.
    """
