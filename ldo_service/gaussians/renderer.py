"""Rendering of the map and its derivatives: EWA splatting of 3D Gaussians, front to back.

The kernels are `kernels/rasterize.cpp`, `kernels/blend_gradient.hpp` and
`kernels/projection_gradient.hpp`; `tests/reference/render.py` implements them in plain NumPy.
"""

from dataclasses import dataclass
from math import inf

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera
from ldo_service.kernels import _rasterize

from .model import ROW, aligned_rows

PLANES = 5  # red, green, blue, weighted depth, opacity
WEIGHT = 14  # field of a row of gradients


@dataclass(frozen=True, eq=False, slots=True)
class AdamStep:
    """rows, mean, square  [N, 16] float32: parameters and moments, changed in place
    steps               [N] int32, that each row has made, changed in place
    rates               [16] float32, length of a step per field
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
    """Derivatives of a scalar L by what was rendered. Views: valid until the next rendering.

    indices  [V] uint32, ascending: the rows that may touch the image
    rows     [V, 16] float32, dL/drow; field 14 holds the Gaussian's weights summed over the
             pixels (px), field 15 zero. A Gaussian that is hidden has zeros only.
    xi       [6] float64, dL/dxi at xi = 0 of T_map_camera exp(xi): rotation rad, translation m
    """

    indices: np.ndarray
    rows: np.ndarray
    xi: np.ndarray


@dataclass(frozen=True, slots=True)
class VisibleGaussians:
    """What a step of the optimiser reached. Views: valid until the next rendering.

    indices  [V] uint32, ascending: the rows that may touch the image
    weights  [V] float32, of each Gaussian, summed over the pixels (px); 0: hidden, and not moved
    xi       [6] float64, dL/dxi at xi = 0 of T_map_camera exp(xi): rotation rad, translation m
    """

    indices: np.ndarray
    weights: np.ndarray
    xi: np.ndarray


class Rasterizer:
    """Renders one view after the other for the optimiser, and keeps the memory for the next.

    Not for two threads at once. Its images have no median depth; otherwise they are `render`'s.
    """

    def __init__(self, *, threads: int = 1) -> None:
        self.threads = threads
        self._pass = _rasterize.Pass()
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
    ) -> np.ndarray:
        """Planes [5, H, W] float32: red, green, blue, depth sum w_i z_i (m), opacity.

        Arguments as those of `render`; the result is overwritten by the next rendering. Where
        `tiles` [ceil(H / 16), ceil(W / 16)] uint8 is 0, the planes are zero and are not computed;
        give `image_loss` the same, and the gradients are those of these tiles alone.
        """
        if camera.distortion:
            raise DataError("the rasteriser knows no lens distortion: pass camera.rectified().")
        size = (PLANES, camera.height, camera.width)
        if self._planes.shape != size:
            self._planes = _new_planes(camera.height, camera.width)
        T = np.ascontiguousarray(np.asarray(T_camera_map)[:3], np.float32)
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        self._visible = _rasterize.rasterize_planes(
            self._pass, rows, T, *intrinsics, self._planes, self.threads, bounds, tiles
        )
        self._rows = rows
        return self._planes

    def gradients(
        self, by_planes: np.ndarray, *, needle_weight: float = 0.0, needle_ratio: float = 1.0
    ) -> RowGradients:
        """Derivatives of L, given dL/dplanes [5, H, W], at the last rendering.

        To L is added needle_weight * mean over pixels of sum_i w_i max(0, log(longest / middle
        axis of i) - log needle_ratio), with w_i held fixed. The rows must still be as they were
        rendered. Bitwise equal for any number of threads.
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
        """The step of `step` against what `gradients` would give, to the same bits.

        Changes the rows that were rendered, in place, and the moments. Their gradients stay in
        cache, which saves a sixth of an iteration. Of what moved, no standard deviation is longer
        then than `max_sigma_px` in this view, at the depth of the mean. Raises ValueError where
        `step` is for other rows than were rendered last, or they were stepped on since.
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


def _new_planes(height: int, width: int) -> np.ndarray:
    """Planes [5, H, W] on a cache line: where W is a multiple of 16, no two tiles share one."""
    size = PLANES * height * width
    return aligned_rows(-(-size // ROW)).reshape(-1)[:size].reshape(PLANES, height, width)


RenderMemory = _rasterize.Pass  # scratch that one rendering leaves to the next


@dataclass(frozen=True, slots=True)
class Contributions:
    """Who made an image.

    indices  [V] uint32, ascending: the rows with any weight
    weights  [V] float32, w_i summed over the pixels (px)
    top      [H, W] int32, per pixel the row with the largest w_i, of equals the nearest; -1 where
             no row has any: `np.where(top >= 0, labels[top], nothing)` is an image of labels
    """

    indices: np.ndarray
    weights: np.ndarray
    top: np.ndarray


@dataclass(frozen=True, slots=True)
class Rendering:
    """What a camera sees of the map. With w_i = alpha_i prod_{j<i} (1 - alpha_j), near to far:

    color            [H, W, 3] float32, sum w_i c_i, background black
    weighted_depth_m [H, W] float32, sum w_i z_i: not divided by the opacity
    median_depth_m   [H, W] float32, z where the transmittance first falls below one half, or 0:
                     a surface that was there, where the mean may lie between two
    opacity          [H, W] float32, sum w_i = 1 - transmittance
    contributions    if they were asked for
    """

    color: np.ndarray
    weighted_depth_m: np.ndarray
    median_depth_m: np.ndarray
    opacity: np.ndarray
    contributions: Contributions | None = None

    @property
    def depth_m(self) -> np.ndarray:
        """Mean depth [H, W] where the opacity exceeds one half, else 0 (computed on each call)."""
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

    Each pixel blends, by increasing (z, index), alpha = min(0.99, o exp(-d' S^-1 d / 2)) with
    S = J R Sigma R' J' + 0.3 px^2 I; Gaussians with z < 0.05 m and alpha < 1/255 are left out.
    A block of 4x4 pixels is finished when all its transmittances are below 1e-4.

    rows          [N, 16] float32, contiguous: mean [3] in metres (map), log scale [3] in
                  log metres, quaternion wxyz [4] of any length, opacity logit, rgb [3], 2 unused.
                  Rows that hold NaN or infinity are not drawn.
    camera        without distortion; raises DataError with it
    T_camera_map  [4, 4]
    bounds        of these rows (`GaussianMap.bounds`): those out of view are then not read, which
                  changes no bit
    memory        scratch for this call and the next, one call at a time: fresh pages cost time
    contributions also say who made the image, for about half as much time again
    Raises ValueError for arrays that do not fit. Bitwise equal for any number of threads; the
    last bits differ between instruction sets (`ldo_service.kernels.isa`).
    Zwicker et al., EWA splatting, 2002; Kerbl et al., 3D Gaussian splatting, 2023.
    """
    if camera.distortion:
        raise DataError("the rasteriser knows no lens distortion: pass camera.rectified().")
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
