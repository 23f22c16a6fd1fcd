"""Pose from shape alone: point clouds, for large motions where nothing has a texture.

`small_gicp` pairs each point with its nearest neighbours, so it reaches farther than the alignment
of `align`, which pairs along the ray, and sees less well. Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass

import numpy as np
import small_gicp

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3

from .pyramid import Level, Pyramid
from .reference import Reference

NEIGHBOURS = 10  # that the covariance of a point is taken from, small_gicp's default


@dataclass(frozen=True, slots=True)
class ShapeConfig:
    level: int = 2  # of the pyramid: 80 pixels wide
    spacing: float = 0.03  # of the points, in median depths
    reach: float = 0.25  # between partners, in median depths: a large step of a robot
    iterations: int = 30  # at most
    min_partners: float = 0.6  # share of the frame's points that find one

    def __post_init__(self) -> None:
        if self.level < 0 or self.iterations < 1:
            raise ConfigError(f"{self}: level must not be negative, iterations at least 1.")
        if not (0 < self.spacing < self.reach and 0 < self.min_partners <= 1):
            raise ConfigError(f"{self}: 0 < spacing < reach and 0 < min_partners <= 1 are needed.")


def pose_from_shape(
    reference: Reference, view: Pyramid, T_reference_camera: np.ndarray, config: ShapeConfig
) -> np.ndarray | None:
    """T_reference_camera [4, 4] by GICP (Koide 2024), from a guess; None where that finds nothing.

    Deterministic: one thread.
    """
    scale_m = reference.median_depth_m
    level = min(config.level, len(view.levels) - 1, len(reference.points) - 1)
    clouds = reference.points[level][:3].T, _points(view.levels[level])
    if min(map(len, clouds)) < NEIGHBOURS:
        return None
    (there, tree), (here, _) = (_cloud(points, config.spacing * scale_m) for points in clouds)
    found = small_gicp.align(
        there,
        here,
        tree,
        T_reference_camera,
        max_correspondence_distance=config.reach * scale_m,
        max_iterations=config.iterations,
    )
    if not found.converged or found.num_inliers < config.min_partners * here.size():
        return None
    return se3.orthonormalised(found.T_target_source)


def _cloud(points: np.ndarray, spacing_m: float) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
    return small_gicp.preprocess_points(points.astype(np.float64), spacing_m, NEIGHBOURS)


def _points(level: Level) -> np.ndarray:
    """[N, 3] of the pixels with depth."""
    points = level.camera.rays() * level.depth_m[..., None]
    return points[level.depth_m > 0]
