"""Small scenes of Gaussians for the GPU kernels, with at most 150 pairs of a Gaussian and a tile.

Importing this module skips the tests of the importing module unless the kernels run in the
interpreter of Triton.
"""

import os
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from ldo_service.gaussians.renderer import Rasterizer
from ldo_service.geometry import Camera, se3
from ldo_service.kernels.gpu.arrays import HostArray, HostArrays

REASON = "run `make gpu-check`, which installs Triton and selects its interpreter"
if find_spec("triton") is None or os.environ.get("TRITON_INTERPRET") != "1":
    pytest.skip(REASON, allow_module_level=True)
if os.environ.get("LDO_ISA") != "baseline":
    # Wider instruction sets fuse products with sums, which the kernels do not.
    pytest.skip(REASON + ", and LDO_ISA=baseline", allow_module_level=True)

from ldo_service.evaluation import device_iteration  # noqa: E402, F401
from ldo_service.kernels.gpu import (  # noqa: E402
    contributions,  # noqa: F401
    descent,  # noqa: F401
    equation_sums,  # noqa: F401
    frame_loss,  # noqa: F401
    plane_rendering,
    view_rendering,  # noqa: F401
)

MAX_PAIRS = 150
TURNED = se3.exp(np.array([0.15, -0.2, 0.1, 0.1, -0.15, 0.2]))


class FilledArrays(HostArrays):
    """Arrays whose undefined values are NaN or -7, so that a result that uses them is wrong."""

    def empty(self, shape: tuple[int, ...], dtype: type) -> HostArray:
        fill = np.nan if np.dtype(dtype).kind == "f" else np.array(-7).astype(dtype)
        return HostArray(np.full(shape, fill, dtype))


ARRAYS = FilledArrays()


@dataclass(frozen=True, eq=False)
class Scene:
    """Rows [N, 16] of Gaussians, seen by a camera at a pose T_camera_map [4, 4]."""

    rows: np.ndarray
    camera: Camera
    T_camera_map: np.ndarray
    binning: int = 1

    @property
    def view(self) -> np.ndarray:
        camera = self.camera
        intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
        return plane_rendering.view_of(self.T_camera_map, intrinsics, self.binning)

    @property
    def T_rounded(self) -> np.ndarray:
        """Pose with the rounding to float32 of the kernels, in float64."""
        return self.T_camera_map.astype(np.float32).astype(float)

    def by_planes(self) -> np.ndarray:
        """Return random derivatives with respect to the planes, [5, H, W]."""
        rng = np.random.default_rng(self.camera.width)
        return rng.normal(size=(5, self.camera.height, self.camera.width)).astype(np.float32)

    def drawable_rows(self) -> np.ndarray:
        """Return rows in float64, in which rows that are not drawn are behind the camera."""
        rows = self.rows.astype(float)
        is_bad = ~np.isfinite(rows).all(axis=1) | (rows[:, 6:10] == 0).all(axis=1)
        rows[is_bad] = 0
        rows[is_bad, 6], rows[is_bad, 10], rows[is_bad, 2] = 1, -9, -1
        return rows


def camera_of(width: int, height: int) -> Camera:
    return Camera(width, height, 0.9 * width, 0.85 * width, 0.45 * width, 0.55 * height)


def cloud(
    n: int,
    seed: int,
    *,
    depth_m: tuple[float, float] = (0.5, 4.0),
    sigma: tuple[float, float] = (0.005, 0.1),
    logit: tuple[float, float] = (-3, 5),
) -> np.ndarray:
    """Return random Gaussians inside and beside the image; `sigma` is relative to the depth."""
    rng = np.random.default_rng(seed)
    rows, z = np.zeros((n, 16), np.float32), rng.uniform(*depth_m, n)
    rows[:, :3] = np.column_stack([rng.uniform(-0.8, 0.8, (n, 2)) * np.abs(z[:, None]), z])
    rows[:, 3:6] = np.log(np.abs(z[:, None]) * rng.uniform(*sigma, (n, 3)))
    rows[:, 6:10] = rng.normal(size=(n, 4))
    rows[:, 10] = rng.uniform(*logit, n)
    rows[:, 11:14] = rng.uniform(0, 1, (n, 3))
    return rows


def wall(n: int, seed: int, logit: tuple[float, float]) -> np.ndarray:
    """Return wide Gaussians behind each other, which fill the image."""
    rows = cloud(n, seed, depth_m=(1.0, 2.0), sigma=(0.1, 0.4), logit=logit)
    rows[:, :2] *= 0.4
    return rows


def ties() -> np.ndarray:
    """Return rows in three groups of sixteen, which have equal depths within a group."""
    rows = cloud(48, 8, sigma=(0.05, 0.2))
    rows[:, 2] = np.repeat([1.0, 1.5, 2.0], 16)[np.random.default_rng(0).permutation(48)]
    return rows


def broken() -> np.ndarray:
    """Return rows of which some are not finite, have no rotation, are behind, or are faint."""
    rows = cloud(40, 9)
    rows[3, 0], rows[7, 4], rows[11, 12] = np.nan, np.inf, -np.inf
    rows[15, 6:10], rows[19, 2], rows[23, 10] = 0, -1.0, -8.0
    # This row has no rotation either. Its center is the center of a pixel, (9, 11).
    rows[27, :3], rows[27, 6:10], rows[27, 10] = (0, 0, 1), 0, 5
    return rows


def wide() -> np.ndarray:
    """Return large Gaussians, most of them beyond the edges of the image."""
    rows = cloud(60, 4, sigma=(0.2, 0.5))
    rows[:, :2] *= 1.9
    return rows


def needles() -> np.ndarray:
    """Return long thin Gaussians at any angle, whose ridge lines have unequal slopes."""
    rows = cloud(30, 13, depth_m=(1.0, 3.0), logit=(-1, 3))
    rows[:, :2] *= 0.5
    rows[:, 3:6] = np.log(rows[:, 2:3] * [0.2, 0.02, 0.01])
    return rows


def faint_wall() -> np.ndarray:
    """Return 250 faint Gaussians in front of 60 opaque ones.

    The first batch of 256 has six of the opaque ones, which do not cover all blocks. Only in the
    second batch, the transmittance of all blocks is therefore below the limit.
    """
    rows = np.concatenate([wall(250, 10, (-5.3, -4.0)), wall(60, 11, (-1, 1))])
    rows[:250, :3] *= 0.4
    rows[:250, 3:6] += np.log(0.4)
    rows[250:, 3:6] += np.log(3)
    return rows


SCENES = {
    "cloud": Scene(cloud(90, 0), camera_of(28, 20), np.eye(4)),
    "turned": Scene(cloud(90, 1), camera_of(28, 20), TURNED),
    "odd size": Scene(cloud(80, 6), camera_of(17, 23), TURNED),
    "behind the camera": Scene(cloud(100, 2, depth_m=(-2, 2)), camera_of(20, 20), np.eye(4)),
    "beyond the edges": Scene(wide(), camera_of(16, 16), np.eye(4)),
    "empty tiles": Scene(cloud(5, 12, sigma=(0.005, 0.02)), camera_of(48, 40), np.eye(4)),
    "capped": Scene(cloud(50, 3, logit=(6, 9)), camera_of(20, 20), np.eye(4)),
    "dark": Scene(wall(140, 5, (-1.5, 1.0)), camera_of(16, 16), np.eye(4)),
    "ties": Scene(ties(), camera_of(16, 16), np.eye(4)),
    "needles": Scene(needles(), camera_of(28, 20), np.eye(4)),
    "broken rows": Scene(broken(), camera_of(20, 20), np.eye(4)),
    "one pixel": Scene(cloud(60, 5, sigma=(0.1, 0.3)), camera_of(1, 1), np.eye(4)),
    "binned": Scene(cloud(90, 1), camera_of(28, 20), TURNED, binning=2),
    "binned edges": Scene(wide(), camera_of(16, 16), np.eye(4), binning=2),
    "no Gaussians": Scene(cloud(0, 7), camera_of(9, 9), np.eye(4)),
}
NAMES = [name for name in SCENES if name != "no Gaussians"]
# This scene has more pairs than the others, because a batch has 256.
SEAM = Scene(faint_wall(), camera_of(16, 16), np.eye(4))


def rendered(scene: Scene) -> plane_rendering.PlaneRendering:
    rows, camera = ARRAYS.upload(scene.rows), scene.camera
    return plane_rendering.render(
        ARRAYS, rows, len(scene.rows), scene.view, camera.width, camera.height
    )


@cache
def of_kernel(name: str) -> plane_rendering.PlaneRendering:
    """Return the rendering of a scene by the GPU kernels."""
    return rendered(SCENES[name])


def of_cpu(scene: Scene) -> tuple[Rasterizer, np.ndarray]:
    """Return the C++ rasterizer and the planes that it renders of a scene."""
    rasterizer = Rasterizer()
    planes = rasterizer.render(scene.rows, scene.camera, scene.T_camera_map, binning=scene.binning)
    return rasterizer, planes


def host(array: Any) -> np.ndarray:
    return ARRAYS.download(array)
