"""How well two depth images agree on one surface under a pose. `ldo_service.geometry`."""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3


@dataclass(frozen=True, slots=True)
class SurfaceFitConfig:
    gate_m: float = 0.1  # along the ray, beyond which two depths are of different surfaces
    gate_share: float = 0.02  # of the depth, on top: the noise of structured light at 5 m
    min_overlap: float = 0.2  # share of the new surface that the old keyframe sees too
    max_rmse_m: float = 0.03  # along the normals
    # Share of what falls into the old view and lies where that saw through: things come and go, a
    # wrong pose puts walls into the air.
    max_conflict: float = 0.15

    def __post_init__(self) -> None:
        if min(self.gate_m, self.max_rmse_m) <= 0 or self.gate_share < 0:
            raise ConfigError(
                f"{self}: gate_m and max_rmse_m must be positive, gate_share not < 0."
            )
        if not (0 <= self.min_overlap <= 1 and 0 <= self.max_conflict <= 1):
            raise ConfigError(f"{self}: min_overlap and max_conflict must be within 0..1.")


@dataclass(frozen=True, slots=True)
class SurfaceFit:
    overlap: float  # of the new surface's points, those that the old keyframe measured too
    rmse_m: float  # of these along their normals
    conflict: float  # of the points within the old view, those in its free space


def surface_fit(
    points: np.ndarray,
    T_old_new: np.ndarray,
    old_depth_m: np.ndarray,
    camera: Camera,
    config: SurfaceFitConfig,
) -> SurfaceFit:
    """Points [7, N] of the new keyframe (see `Reference`) against the old depth [H, W].

    A point p with normal n falls on a pixel whose depth makes the point q on the same ray:

        |z_p - z_q| <= gate    one surface, residual n . (p - q)
        z_p < z_q - gate       the old camera saw through it: conflict
        z_p > z_q + gate       hidden, says nothing
    """
    p = se3.transform(T_old_new, points[:3].T.astype(float))
    normals = points[4:7].T.astype(float) @ T_old_new[:3, :3].T
    seen = np.flatnonzero(p[:, 2] > 0)
    pixels = np.rint(camera.project(p[seen])).astype(np.int64)
    inside = np.all((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=1)
    seen, (u, v) = seen[inside], pixels[inside].T
    old_m = old_depth_m[v, u].astype(float)
    seen, old_m = seen[old_m > 0], old_m[old_m > 0]
    if not len(seen):
        return SurfaceFit(0.0, 0.0, 0.0)
    z = p[seen, 2]
    gate_m = config.gate_m + config.gate_share * old_m
    is_one = np.abs(z - old_m) <= gate_m
    along = np.einsum("ij,ij->i", normals[seen], p[seen] * (1 - old_m / z)[:, None])
    has_normal = is_one & np.any(normals[seen] != 0, axis=1)
    squares = along[has_normal] ** 2
    return SurfaceFit(
        overlap=float(is_one.sum() / points.shape[1]),
        rmse_m=float(np.sqrt(squares.mean())) if len(squares) else 0.0,
        conflict=float((z < old_m - gate_m).mean()),
    )
