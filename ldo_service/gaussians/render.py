"""Images of the map: EWA splatting of 3D Gaussians, front to back.

The kernel is `ldo_service/kernels/rasterise.cpp`; its plain twin is `render_reference.py`.
"""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera
from ldo_service.kernels import _rasterise

RenderMemory = _rasterise.Pass  # scratch that one rendering leaves to the next


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
    bounds: _rasterise.Bounds | None = None,
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
    images = _rasterise.rasterise(rows, T, *intrinsics, *size, threads, memory, bounds)
    made_by = _contributions(memory, camera, threads) if contributions else None
    return Rendering(*images, made_by)


def _contributions(memory: RenderMemory, camera: Camera, threads: int) -> Contributions:
    indices, weights = np.empty(memory.visible, np.uint32), np.empty(memory.visible, np.float32)
    top = np.empty((camera.height, camera.width), np.int32)
    _rasterise.contributions(memory, indices, weights, top, threads)
    seen = weights > 0
    return Contributions(indices[seen], weights[seen], top)
