"""Tests of overlap, distance and conflict of surfaces with known geometry."""

import numpy as np
import pytest

from ldo_service.geometry import Camera
from ldo_service.loop_closing.pose_estimation import DepthConsistencyConfig, check_depth_consistency

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
CONFIG = DepthConsistencyConfig()


def wall_depth(distance_m: float) -> np.ndarray:
    """Return the depth image [H, W] of a wall that faces the camera, in meters."""
    return np.full((120, 160), distance_m, np.float32)


def points_of(depth_m: np.ndarray) -> np.ndarray:
    """Return reference points [7, N] of a wall that faces the camera."""
    p = (CAMERA.rays() * depth_m[..., None]).reshape(-1, 3)
    normals = np.tile([0.0, 0, -1], (len(p), 1))
    return np.column_stack([p, np.zeros(len(p)), normals]).T.astype(np.float32)


def shifted(x_m: float = 0.0, z_m: float = 0.0) -> np.ndarray:
    """Return a translation [4, 4] along x and z."""
    T = np.eye(4)
    T[[0, 2], 3] = x_m, z_m
    return T


def test_identical_walls_overlap_fully() -> None:
    fit = check_depth_consistency(
        points_of(wall_depth(2)), np.eye(4), wall_depth(2), CAMERA, CONFIG
    )
    assert (fit.overlap, fit.conflict) == (1, 0)
    assert fit.rmse_m < 1e-6


def test_sideways_shift_by_half_the_view_halves_the_overlap() -> None:
    """The image of 160 pixels shows 2 * 160 / 150 m of the wall."""
    fit = check_depth_consistency(
        points_of(wall_depth(2)), shifted(x_m=160 / 150), wall_depth(2), CAMERA, CONFIG
    )
    assert fit.overlap == pytest.approx(0.5, abs=0.01)
    assert fit.rmse_m < 1e-6


def test_rmse_is_the_distance_along_the_normals() -> None:
    fit = check_depth_consistency(
        points_of(wall_depth(2)), shifted(z_m=0.05), wall_depth(2), CAMERA, CONFIG
    )
    assert fit.rmse_m == pytest.approx(0.05, abs=1e-4)


def test_surface_in_free_space_conflicts_and_occluded_one_does_not() -> None:
    in_front = check_depth_consistency(
        points_of(wall_depth(2)), np.eye(4), wall_depth(3), CAMERA, CONFIG
    )
    behind = check_depth_consistency(
        points_of(wall_depth(3)), np.eye(4), wall_depth(2), CAMERA, CONFIG
    )
    assert (in_front.overlap, in_front.conflict) == (0, 1)
    assert (behind.overlap, behind.conflict) == (0, 0)


def test_pixels_without_depth_give_no_overlap_and_no_conflict() -> None:
    fit = check_depth_consistency(
        points_of(wall_depth(2)), np.eye(4), wall_depth(0), CAMERA, CONFIG
    )
    assert (fit.overlap, fit.rmse_m, fit.conflict) == (0, 0, 0)
