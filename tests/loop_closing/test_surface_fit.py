"""Overlap, distance and conflict of surfaces whose truth is known."""

import numpy as np
import pytest

from ldo_service.geometry import Camera
from ldo_service.loop_closing.pose_estimation import DepthConsistencyConfig, check_depth_consistency

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
CONFIG = DepthConsistencyConfig()


def wall(distance_m: float) -> np.ndarray:
    return np.full((120, 160), distance_m, np.float32)


def points_of(depth_m: np.ndarray) -> np.ndarray:
    """[7, N] as a reference has them, of a wall that faces the camera."""
    p = (CAMERA.rays() * depth_m[..., None]).reshape(-1, 3)
    normals = np.tile([0.0, 0, -1], (len(p), 1))
    return np.column_stack([p, np.zeros(len(p)), normals]).T.astype(np.float32)


def shifted(x_m: float = 0.0, z_m: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[[0, 2], 3] = x_m, z_m
    return T


def test_a_wall_meets_itself() -> None:
    fit = check_depth_consistency(points_of(wall(2)), np.eye(4), wall(2), CAMERA, CONFIG)
    assert (fit.overlap, fit.conflict) == (1, 0)
    assert fit.rmse_m < 1e-6


def test_half_of_a_wall_is_seen_after_half_a_view_to_the_side() -> None:
    """160 pixels see 2 * 160 / 150 m of it."""
    fit = check_depth_consistency(
        points_of(wall(2)), shifted(x_m=160 / 150), wall(2), CAMERA, CONFIG
    )
    assert fit.overlap == pytest.approx(0.5, abs=0.01)
    assert fit.rmse_m < 1e-6


def test_surfaces_five_centimeters_apart_are_so_along_their_normals() -> None:
    fit = check_depth_consistency(points_of(wall(2)), shifted(z_m=0.05), wall(2), CAMERA, CONFIG)
    assert fit.rmse_m == pytest.approx(0.05, abs=1e-4)


def test_a_wall_in_the_air_is_a_conflict_and_one_behind_is_hidden() -> None:
    before = check_depth_consistency(points_of(wall(2)), np.eye(4), wall(3), CAMERA, CONFIG)
    behind = check_depth_consistency(points_of(wall(3)), np.eye(4), wall(2), CAMERA, CONFIG)
    assert (before.overlap, before.conflict) == (0, 1)
    assert (behind.overlap, behind.conflict) == (0, 0)


def test_where_the_old_keyframe_measured_nothing_nothing_is_said() -> None:
    fit = check_depth_consistency(points_of(wall(2)), np.eye(4), wall(0), CAMERA, CONFIG)
    assert (fit.overlap, fit.rmse_m, fit.conflict) == (0, 0, 0)
