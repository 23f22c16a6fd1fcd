"""Rendering of the map and its derivatives: EWA splatting of 3D Gaussians, front to back.

The kernels are `kernels/rasterize.cpp`, `kernels/blend_gradient.hpp` and
`kernels/projection_gradient.hpp`. Their NumPy reference implementation is
`tests/reference/render.py`.
"""

from dataclasses import dataclass
from math import inf

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera
from ldo_service.kernels import _rasterize

from .rows import ROW, aligned_rows

PLANES = 5  # Red, green, blue, weighted depth, opacity.


@dataclass(frozen=True, eq=False, slots=True)
class AdamStep:
    """Arguments of one step of Adam, for `Rasterizer.descend`.

    Attributes:
        rows: Parameters, [N, 16] float32; changed in place.
        mean: First moments, [N, 16] float32; changed in place.
        square: Second moments, [N, 16] float32; changed in place.
        steps: Number of steps of each row, [N] int32; changed in place.
        rates: Learning rate of each column, [16] float32.
        beta1: Decay of the first moments.
        beta2: Decay of the second moments.
        epsilon: Positive constant that is added to the square root of the second moments.
    """

    rows: np.ndarray
    mean: np.ndarray
    square: np.ndarray
    steps: np.ndarray
    rates: np.ndarray
    beta1: float
    beta2: float
    epsilon: float


@dataclass(frozen=True, slots=True)
class RowGradients:
    """Derivatives of the loss L at the last rendering.

    The arrays are views of reused memory, valid until the next rendering.

    Attributes:
        indices: Rows that may touch the image, [V] uint32, ascending.
        rows: dL/drow, [V, 16] float32. Column 14 is not a derivative but the blending weight of the
            Gaussian summed over the pixels. Column 15 is zero. A hidden Gaussian has only zeros.
        xi: dL/dxi at xi = 0 for the pose T_map_camera exp(xi), [6] float64. The vector xi is a
            rotation in rad, then a translation in meters.
    """

    indices: np.ndarray
    rows: np.ndarray
    xi: np.ndarray


@dataclass(frozen=True, slots=True)
class VisibleGaussians:
    """Gaussians that may touch the last rendered image, after a step of the optimizer.

    The arrays are views of reused memory, valid until the next rendering.

    Attributes:
        indices: Rows that may touch the image, [V] uint32, ascending.
        weights: Blending weight of each Gaussian summed over the pixels, [V] float32. It is 0 for
            hidden Gaussians, which the step does not change.
        xi: Derivative of the loss by xi at xi = 0, for the pose T_map_camera exp(xi), [6] float64.
            The vector xi is a rotation in rad, then a translation in meters.
    """

    indices: np.ndarray
    weights: np.ndarray
    xi: np.ndarray


class Rasterizer:
    """Renderer for the optimizer; the renderer reuses its memory from image to image.

    Its images equal those of `render`, but have no median depth. Not thread-safe.

    Args:
        threads: Threads of the kernels.
        memory: Scratch memory to use; None for memory of its own.
    """

    def __init__(self, *, threads: int = 1, memory: "RenderMemory | None" = None) -> None:
        self.threads = threads
        self._pass = memory or _rasterize.Pass()
        self._planes = np.empty((PLANES, 0, 0), np.float32)
        self._rows = aligned_rows(0)
        self._visible = 0
        self._indices = np.empty(0, np.uint32)
        self._gradients = aligned_rows(0)
        self._weights = np.empty(0, np.float32)

    def render(
        self,
        rows: np.ndarray,
        camera: Camera,
        T_camera_map: np.ndarray,
        *,
        bounds: _rasterize.Bounds | None = None,
        tiles: np.ndarray | None = None,
        binning: int = 1,
    ) -> np.ndarray:
        """Render the image planes that the loss needs.

        Args:
            rows: Gaussians, [N, 16] float32, contiguous; the function `render` lists the columns.
            camera: Intrinsics without distortion.
            T_camera_map: [4, 4].
            bounds: Bounds of these rows (`GaussianMap.bounds`). With them, the renderer does not
                read invisible rows. None reads all rows.
            tiles: [ceil(H / 16), ceil(W / 16)] uint8. Tiles with value 0 are not rendered, and
                their pixels are zero. Pass the same array to `image_loss`, so that it ignores these
                tiles.
            binning: Number of full-image pixels along each side of a rendered pixel: 1, or 2 for
                `Camera.halved`. Splats are averaged over the rendered pixel.

        Returns:
            Planes [5, H, W] float32: red, green, blue, weighted depth in meters and opacity, as in
            `Rendering`. The next rendering overwrites them.

        Raises:
            DataError: The camera has lens distortion.
        """
        require_undistorted(camera)
        size = (PLANES, camera.height, camera.width)
        if self._planes.shape != size:
            self._planes = _new_planes(camera.height, camera.width)
        T = np.ascontiguousarray(np.asarray(T_camera_map)[:3], np.float32)
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        self._visible = _rasterize.rasterize_planes(
            self._pass, rows, T, *intrinsics, self._planes, self.threads, bounds, tiles, binning
        )
        self._rows = rows
        return self._planes

    def gradients(
        self, by_planes: np.ndarray, *, needle_weight: float = 0.0, needle_ratio: float = 1.0
    ) -> RowGradients:
        """Compute the derivatives of the loss L at the last rendering.

        An additional term in L penalizes needle-shaped Gaussians:

            needle_weight * mean over pixels of
                sum_i w_i max(0, log(longest / middle axis of Gaussian i) - log needle_ratio)

        The derivative of this term treats the blending weights w_i as constants. The rendered rows
        must not have changed since the rendering. The result is bitwise equal for any number of
        threads.

        Args:
            by_planes: dL/dplanes without the additional term, [5, H, W] as `render` returns them.
            needle_weight: Weight of the additional term.
            needle_ratio: Ratio of the longest to the middle axis above which the term is positive.
        """
        indices = self._room_for_indices()
        if len(self._gradients) < self._visible:
            self._gradients = aligned_rows(self._visible * 5 // 4)
        gradients = self._gradients[: self._visible]
        xi = _rasterize.backpropagate(
            self._pass,
            self._rows,
            self._planes,
            by_planes,
            indices,
            gradients,
            needle_weight,
            float(np.log(needle_ratio)),
            self.threads,
        )
        return RowGradients(indices, gradients, xi)

    def descend(
        self,
        by_planes: np.ndarray,
        step: AdamStep,
        *,
        needle_weight: float = 0.0,
        needle_ratio: float = 1.0,
        max_sigma_px: float = inf,
    ) -> VisibleGaussians:
        """Compute the gradients and take a step of Adam in one pass.

        The result is bitwise equal to that of two passes. One pass takes a sixth less time per
        iteration, since gradients stay in the CPU cache. The rendered rows and the moments change
        in place.

        Args:
            by_planes: dL/dplanes without the penalty on needles, [5, H, W] as `render` returns
                them.
            step: Parameters, moments and rates.
            needle_weight: Weight of the penalty on needles; see `gradients`.
            needle_ratio: Ratio of the longest to the middle axis above which the penalty applies.
            max_sigma_px: Largest standard deviation of a Gaussian after the step, in pixels at the
                depth of its mean. Gaussians that the step does not change are not limited.

        Raises:
            ValueError: `step.rows` are not the rows of the last rendering, or an earlier step has
                changed them since the rendering.
        """
        indices = self._room_for_indices()
        if len(self._weights) < self._visible:
            self._weights = np.empty(self._visible * 5 // 4, np.float32)
        weights = self._weights[: self._visible]
        xi = _rasterize.descend(
            self._pass,
            step.rows,
            step.mean,
            step.square,
            step.steps,
            step.rates,
            step.beta1,
            step.beta2,
            step.epsilon,
            self._planes,
            by_planes,
            indices,
            weights,
            needle_weight,
            float(np.log(needle_ratio)),
            max_sigma_px,
            self.threads,
        )
        return VisibleGaussians(indices, weights, xi)

    def _room_for_indices(self) -> np.ndarray:
        if len(self._indices) < self._visible:
            self._indices = np.empty(self._visible * 5 // 4, np.uint32)
        return self._indices[: self._visible]


def require_undistorted(camera: Camera) -> None:
    """Check that the rasterizer supports a camera.

    Raises:
        DataError: The camera has lens distortion.
    """
    if camera.distortion:
        raise DataError("the rasterizer does not support lens distortion. Pass camera.rectified().")


def _new_planes(height: int, width: int) -> np.ndarray:
    """Return planes [5, H, W] that start at a cache line.

    If W is a multiple of 16, no cache line contains pixels of two tiles.
    """
    size = PLANES * height * width
    return aligned_rows(-(-size // ROW)).reshape(-1)[:size].reshape(PLANES, height, width)


RenderMemory = _rasterize.Pass  # Scratch memory that several renderings use one after the other.


@dataclass(frozen=True, slots=True)
class Contributions:
    """Contributions of the Gaussians to an image.

    Attributes:
        indices: Rows with a weight above 0, [V] uint32, ascending.
        weights: Blending weight w_i summed over the pixels, [V] float32.
        top: Row with the largest w_i at each pixel, [H, W] int32. If several w_i are equal, the
            nearest Gaussian counts. The value is -1 if no Gaussian touches the pixel.
    """

    indices: np.ndarray
    weights: np.ndarray
    top: np.ndarray


@dataclass(frozen=True, slots=True)
class Rendering:
    """Rendering of the map: color, depth and opacity.

    The Gaussians i at a pixel are ordered from near to far. They have opacity alpha_i, color c_i,
    depth z_i and blending weight w_i = alpha_i prod_{j<i} (1 - alpha_j).

    Attributes:
        color: sum w_i c_i, [H, W, 3] float32; the background is black.
        weighted_depth_m: sum w_i z_i, [H, W] float32; not divided by the opacity.
        median_depth_m: Depth at which the transmittance falls below one half, [H, W] float32; 0 if
            it stays higher. The median lies on a surface, while the mean may lie between surfaces.
        opacity: sum w_i = 1 - transmittance, [H, W] float32.
        contributions: Contributions of the Gaussians, if requested.
    """

    color: np.ndarray
    weighted_depth_m: np.ndarray
    median_depth_m: np.ndarray
    opacity: np.ndarray
    contributions: Contributions | None = None

    @property
    def depth_m(self) -> np.ndarray:
        """Mean depth [H, W] in meters, 0 where the opacity is at most 0.5; computed on access."""
        covered = self.opacity > 0.5
        return np.where(covered, self.weighted_depth_m / np.where(covered, self.opacity, 1), 0)


def render(
    rows: np.ndarray,
    camera: Camera,
    T_camera_map: np.ndarray,
    *,
    threads: int = 1,
    bounds: _rasterize.Bounds | None = None,
    memory: RenderMemory | None = None,
    contributions: bool = False,
) -> Rendering:
    """Render Gaussians into a pinhole camera.

    Each pixel blends the Gaussians by increasing depth z, and by index at equal z. A Gaussian has
    alpha = min(0.99, o exp(-d' S^-1 d / 2)) with S = J R Sigma R' J' + 0.3 px^2 I. Here o is the
    opacity, d the offset from the projected mean in pixels, and Sigma the covariance in the map
    frame. R is the rotation of `T_camera_map`, and J the Jacobian of the projection.
    Gaussians with z < 0.05 m or alpha < 1/255 are skipped. A block of 4x4 pixels is finished when
    all its transmittances are below 1e-4.

    The result is bitwise equal for any number of threads; the last bits differ between
    instruction sets (`ldo_service.kernels.isa`).

    Zwicker et al., EWA splatting, 2002; Kerbl et al., 3D Gaussian splatting, 2023.

    Args:
        rows: [N, 16] float32, contiguous. The columns are: mean in the map frame [3], meters;
            logarithms of the standard deviations in meters [3]; quaternion wxyz [4] of any length;
            opacity logit; RGB [3] in 0..1; 2 unused. Rows with NaN or infinity are not rendered.
        camera: Intrinsics without distortion.
        T_camera_map: [4, 4].
        threads: Threads of the kernel.
        bounds: Bounds of these rows (`GaussianMap.bounds`). With them, the renderer does not read
            invisible rows. The result is the same.
        memory: Scratch memory to reuse in several calls, which saves the time of its allocation.
            Only one call may use it at a time.
        contributions: Also compute the contributions of the Gaussians, which takes about 50 % more
            time.

    Raises:
        DataError: The camera has lens distortion.
        ValueError: The shapes of the arrays do not match.
    """
    require_undistorted(camera)
    T = np.ascontiguousarray(np.asarray(T_camera_map)[:3], np.float32)
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    size = camera.width, camera.height
    memory = memory or RenderMemory()
    images = _rasterize.rasterize(rows, T, *intrinsics, *size, threads, memory, bounds)
    made_by = _contributions(memory, camera, threads) if contributions else None
    return Rendering(*images, made_by)


def _contributions(memory: RenderMemory, camera: Camera, threads: int) -> Contributions:
    indices, weights = np.empty(memory.visible, np.uint32), np.empty(memory.visible, np.float32)
    top = np.empty((camera.height, camera.width), np.int32)
    _rasterize.contributions(memory, indices, weights, top, threads)
    seen = weights > 0
    return Contributions(indices[seen], weights[seen], top)
