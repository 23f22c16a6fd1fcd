import numpy as np
from numpy.typing import NDArray

def assign(
    rows: NDArray[np.float32],
    indices: NDArray[np.uint32],
    T_camera_map: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    depth_m: NDArray[np.float32],
    boxes: NDArray[np.float32],
    scores: NDArray[np.float32],
    rects: NDArray[np.int32],
    sums: NDArray[np.int32],
    by_iou: bool,
    min_overlap: float,
    max_depth_gap_m: float,
    region: NDArray[np.int32],
    overlap: NDArray[np.float32],
    z: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Write to `region` [V] which of M regions each of rows[indices] belongs to, -1 where none,
    -2 where it is not expected; the overlap with it to `overlap` [V], its depth (m) to `z` [V].

    `boxes` [M, 4]; `scores` [M]; `rects` [M, 4] column, row, width, height of the rectangle whose
    summed-area table [height + 1, width + 1] is the next in `sums`; width 0: all of the box.
    Releases the GIL. Raises ValueError for arrays that do not fit and indices that do not ascend.
    Bitwise equal for any number of threads. `ldo_service.semantics.label_assignment` says more.
    """

def update(
    labels: NDArray[np.uint8],
    indices: NDArray[np.uint32],
    observed: NDArray[np.int16],
    confidence: NDArray[np.float32],
    extent_m: NDArray[np.float32],
    is_corrected: bool,
    keep: float,
    miss_weight: float,
    miss_limit: int,
    usual_extent_m: float,
    hold_back: float,
    threads: int = 1,
) -> None:
    """One observation of each of labels[indices], rows [N, 32] of bytes, in place.

    `observed` [V]: a label, -1 for a miss, -2 for none; `confidence` [V] of labels; `extent_m` [V]
    of the label's object, or of the smallest object that is worth missing. Releases the GIL.
    Raises ValueError for arrays that do not fit and indices that do not ascend. Bitwise equal for
    any number of threads. `ldo_service.semantics.gaussian_labels` says more.
    """

def agree(
    rows: NDArray[np.float32],
    labels: NDArray[np.uint8],
    indices: NDArray[np.uint32],
    sigma_m: float,
    radius_m: float,
    rate: float,
    threads: int = 1,
) -> tuple[float, float]:
    """A step of labels[indices] towards their neighbours, in place; the literal and the expected
    disagreement before it, summed over them.

    `rows` [N, 16] float32; `labels` [N, 32] bytes. Releases the GIL. Raises ValueError for arrays
    that do not fit and indices that do not ascend. Bitwise equal for any number of threads.
    `ldo_service.semantics.gaussian_labels` says more.
    """
