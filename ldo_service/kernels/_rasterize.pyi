import numpy as np
from numpy.typing import NDArray

def isa() -> str:
    """Instruction set that this process runs with: avx512, avx2 or baseline."""

def rasterize(
    rows: NDArray[np.float32],
    T_camera_map: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    threads: int = 1,
    memory: Pass | None = None,
    bounds: Bounds | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Colour [H, W, 3], weighted depth [H, W], median depth [H, W] and opacity [H, W].

    `rows` [N, 16] and `T_camera_map` [3, 4] are contiguous; `ldo_service.gaussians.renderer` says
    what they hold. Releases the GIL. Raises ValueError for wrong shapes, types, strides, sizes
    and cameras. Bitwise equal for any number of threads. With `memory`, scratch is kept in it for
    the next call, and what it held of a rendering is lost: fresh pages cost up to half a rendering.
    With `bounds`, blocks of rows that are out of view are not read; the images have the same bits.
    """

class Bounds:
    """Where each block of 256 consecutive rows lies, for one array of rows.

    Whoever changes rows says so before the next rendering. Rows that came behind the last, or
    that lie elsewhere in memory than at the last rendering, are noticed. One call at a time.
    """

    def __init__(self) -> None: ...
    def forget(self, first: int = 0, last: int = ...) -> None:
        """Rows [first, last) have changed; without arguments, all of them."""

    def forget_rows(self, indices: NDArray[np.uint32]) -> None:
        """These rows have changed."""

class Pass:
    """What the gradients of one rendering need, and memory that the next rendering uses again.

    One call at a time may use it: a second one, from another thread, raises ValueError.
    """

    def __init__(self) -> None: ...
    @property
    def visible(self) -> int:
        """Number V of Gaussians that may touch the image last rendered."""

def contributions(
    forward: Pass,
    indices: NDArray[np.uint32],
    weights: NDArray[np.float32],
    top: NDArray[np.int32],
    threads: int = 1,
) -> None:
    """Who made the image that was last rendered with `forward`.

    Writes the V row numbers, ascending, to `indices` [V], the Gaussians' weights summed over the
    pixels to `weights` [V], and to `top` [H, W] the row with the largest weight, or -1; of equal
    weights the nearer one's. Bitwise equal for any number of threads.
    """

def rasterize_planes(
    forward: Pass,
    rows: NDArray[np.float32],
    T_camera_map: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    planes: NDArray[np.float32],
    threads: int = 1,
    bounds: Bounds | None = None,
    tiles: NDArray[np.uint8] | None = None,
) -> int:
    """Write red, green, blue, weighted depth and opacity to `planes` [5, H, W].

    Where `tiles` [ceil(H / 16), ceil(W / 16)] is 0, the planes are zero and cost nothing.

    Returns the number V of Gaussians that may touch the image. Otherwise as `rasterise`.
    """

def backpropagate(
    forward: Pass,
    rows: NDArray[np.float32],
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    indices: NDArray[np.uint32],
    row_gradients: NDArray[np.float32],
    needle_weight: float = 0.0,
    needle_log_ratio: float = 0.0,
    threads: int = 1,
) -> NDArray[np.float64]:
    """Derivatives of L, given those by the planes that `rasterise_planes` last wrote.

    `rows` and `planes` must be as they were then. Writes the V row numbers, ascending, to
    `indices` [V] and dL/drow to `row_gradients` [V, 16], with the sum of the Gaussian's weights
    in field 14; returns dL/dxi [6] for T_map_camera exp(xi), rotation first.
    """

def descend(
    forward: Pass,
    rows: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
    steps: NDArray[np.int32],
    rates: NDArray[np.float32],
    beta1: float,
    beta2: float,
    epsilon: float,
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    indices: NDArray[np.uint32],
    weights: NDArray[np.float32],
    needle_weight: float = 0.0,
    needle_log_ratio: float = 0.0,
    max_sigma_px: float = ...,
    threads: int = 1,
) -> NDArray[np.float64]:
    """`backpropagate` and `adam_step` in one, without writing the gradients of the rows out.

    `rows`, `mean`, `square` and `steps` change in place, as do the bits that `adam_step` changes;
    then standard deviations of what moved are cut to `max_sigma_px` of the view; inf: none is.
    Writes the V row numbers to `indices` [V] and the Gaussians' weights to `weights` [V]; returns
    dL/dxi [6]. The rendering is used up.
    """
