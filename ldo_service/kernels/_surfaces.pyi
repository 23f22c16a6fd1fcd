"""Binding of the comparison of calibration views, `kernels/surfaces.hpp`."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

def surfaces(
    depth_m: Values, rays: Values, step_ratio: float, step_m: float, result: Values
) -> None:
    """Compute points and normals of the blocks of a view.

    Args:
        depth_m: Depth of the blocks, [h, w] meters; 0 where unknown.
        rays: Viewing rays of the blocks with z = 1, [h w, 3].
        step_ratio: Neighbors belong to one surface if their depths differ by less than this
            fraction of the depth plus `step_m`.
        step_m: See `step_ratio`.
        result: Output, [h w, 6]: point and unit normal of each block. The normal is 0 0 0 unless
            the block and its four neighbors belong to one surface.

    Raises:
        ValueError: An array has the wrong shape, type or strides.
    """

def compare(
    there: Values,
    here: Values,
    basis: Values,
    T_here_there: Values,
    velocity_there: Values,
    velocity_here: Values,
    times_s: tuple[float, float],
    intrinsics: tuple[float, float, float, float],
    block: int,
    width: int,
    stride: int,
    max_step_ratio: float,
    rows: Values,
    depths: Values,
    indices: NDArray[np.int64],
) -> int:
    """Compare each `stride`-th surface block of one view with the surface of another view.

    The first view is called "there", the second "here". The residual is the distance, in meters, of
    the moved point from the tangent plane here. Its derivatives are computed at the mean depth of
    point and plane, so that their noise does not correlate with the noise of the residual.

    Args:
        there: Result of `surfaces` for the first view, [h w, 6].
        here: The same for the second view.
        basis: Basis functions of the depth bias at the blocks, [h w, 3].
        T_here_there: Transform from the first camera to the second one, [4, 4], at the times of
            the middle rows of their color images.
        velocity_there: Velocity of the first camera, [6]: rotation in rad/s, then translation in
            m/s. The camera is at T exp(velocity t) after the time t.
        velocity_here: Velocity of the second camera, [6].
        times_s: Readout of depth and delay of depth after color, seconds.
        intrinsics: fx, fy, cx, cy of the full image.
        block: Side of a block, pixels.
        width: Number of blocks in a row, w.
        stride: Distance of compared blocks along each axis, in blocks.
        max_step_ratio: Depth difference, as a fraction of depth, beyond which point and plane are
            different surfaces.
        rows: Output, [N, 13]. The first 12 columns are derivatives of the residual: by the bias
            (3), by the times of the shutter (3: readout of color, readout of depth, delay of
            depth), and by rotation and translation of T_here_there (6, for exp(x) T). The last
            column is the residual. N is the number of compared blocks.
        depths: Output, [N]: mean depth of the moved point and the plane on its ray, meters.
        indices: Output, [N, 2]: blocks there and here.

    Returns:
        The number of rows written.

    Raises:
        ValueError: An array has the wrong shape, type or strides, or a number is out of range.
    """

def compare_features(
    there: Values,
    pixels_there: Values,
    depth_there: Values,
    pixels_here: Values,
    T_here_there: Values,
    velocity_there: Values,
    velocity_here: Values,
    bias: Sequence[float],
    times_s: Sequence[float],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    block: int,
    rows: Values,
) -> None:
    """Compare features of two views by their reprojection errors, in pixels.

    The point of a feature is moved between the times at which its rows were recorded, as in
    `compare`.

    Args:
        there: Result of `surfaces` for the first view, [h w, 6].
        pixels_there: Pixels of the features in the first view, [M, 2].
        depth_there: Their depth in the first view, [M] meters, above 0.
        pixels_here: Their pixels in the second view, [M, 2].
        T_here_there: Transform from the first camera to the second one, [4, 4].
        velocity_there: Velocity of the first camera, see `compare`, [6].
        velocity_here: Velocity of the second camera, [6].
        bias: Coefficients of the depth bias, [3] 1/m; it is removed from the depth.
        times_s: Readout of color, readout of depth and delay of depth, [3] seconds.
        intrinsics: fx, fy, cx, cy of the full image.
        size: Width and height of the full image, pixels.
        block: Side of a block, pixels.
        rows: Output, [2 M, 13]. Each feature has two rows: the error in u, and the error in v. The
            columns are those of `compare`.

    Raises:
        ValueError: An array has the wrong shape, type or strides, or a number is out of range.
    """

def reproject(
    points: Values,
    pixels: Values,
    T: Values,
    intrinsics: tuple[float, float, float, float],
    errors: Values,
    derivatives: Values,
    moved: Values,
) -> None:
    """Compute reprojection errors and their derivatives.

    Args:
        points: Points, [N, 3] meters.
        pixels: Measured pixels of the points, [N, 2].
        T: Transform of the points into the camera, [4, 4].
        intrinsics: fx, fy, cx, cy of the camera.
        errors: Output, [N, 2] pixels.
        derivatives: Output, [N, 2, 6]: derivatives of the errors with respect to x in exp(x) T,
            rotation first.
        moved: Output, [N, 3]: points in the camera, meters.

    Raises:
        ValueError: An array has the wrong shape, type or strides.
    """
