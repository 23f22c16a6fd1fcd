"""Detection of duplicate Gaussians on a wall that was mapped twice."""

import numpy as np

from ldo_service.gaussians.pruning import DeduplicationConfig, find_duplicates
from ldo_service.gaussians.renderer import render
from ldo_service.gaussians.rows import aligned_rows
from ldo_service.geometry import Camera, se3

SPACING_M = 0.02
CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)


def wall(
    width_m: float,
    height_m: float,
    *,
    left_m: float = 0.0,
    z_m: float = 1.5,
    gray: float = 0.5,
) -> np.ndarray:
    """Return flat Gaussians on a grid in the plane z, like those of densification."""
    x, y = np.meshgrid(
        np.arange(left_m, left_m + width_m, SPACING_M), np.arange(0, height_m, SPACING_M)
    )
    rows = aligned_rows(x.size)
    rows[:, 0], rows[:, 1], rows[:, 2] = x.ravel() - 0.5, y.ravel() - 0.5, z_m
    rows[:, 3:6] = np.log(0.6 * SPACING_M * np.array([1, 1, 0.1]))
    rows[:, 6], rows[:, 10], rows[:, 11:14] = 1, 3, gray
    return rows


def rotated(rows: np.ndarray, angle_rad: float) -> np.ndarray:
    """Return the rows rotated about the y axis through the center of the wall."""
    T = se3.exp(np.array([0, angle_rad, 0, 0, 0, 0]))
    center, rows = np.array([0, 0, 1.5]), rows.copy()
    rows[:, :3] = (rows[:, :3] - center) @ T[:3, :3].T + center
    rows[:, 6:10] = se3.quaternion(T[:3, :3])
    return rows


def joined(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    anchors = np.repeat([3, 90], [len(first), len(second)]).astype(np.int32)
    return np.concatenate([first, second]), anchors


def test_newer_duplicates_of_older_gaussians_are_found() -> None:
    first = wall(1.0, 1.0)
    second = wall(1.0, 1.0, left_m=0.5, z_m=1.512)
    second[:, :2] += 0.4 * SPACING_M
    rows, anchors = joined(first, second)
    mask = find_duplicates(rows, anchors, 90)
    assert not mask[: len(first)].any()
    inside = second[:, 0] < first[:, 0].max() + SPACING_M
    np.testing.assert_array_equal(mask[len(first) :][inside], True)
    beyond = second[:, 0] > first[:, 0].max() + 3 * SPACING_M
    np.testing.assert_array_equal(mask[len(first) :][beyond], False)


def test_removal_of_duplicates_leaves_no_holes() -> None:
    second = wall(1.0, 1.0, left_m=0.5, z_m=1.51)
    rows, anchors = joined(wall(1.0, 1.0), second)
    kept = rows[~find_duplicates(rows, anchors, 90)]
    opacity_before, opacity_after = (
        render(np.ascontiguousarray(r), CAMERA, np.eye(4)).opacity for r in (rows, kept)
    )
    solid = opacity_before > 0.95
    assert len(kept) < 0.8 * len(rows)
    assert solid.mean() > 0.3
    assert opacity_after[solid].min() > 0.9


def test_nearby_surfaces_are_no_duplicates() -> None:
    first = wall(1.0, 1.0)
    others = {
        "the back of a door": wall(1.0, 1.0, z_m=1.55),
        "a perpendicular wall": rotated(wall(1.0, 1.0), np.pi / 2),
        "a picture on it": wall(1.0, 1.0, gray=0.9),
    }
    for name, other in others.items():
        rows, anchors = joined(first, other)
        mask = find_duplicates(rows, anchors, 90)
        assert mask.mean() < 0.02, name


def test_gaussians_of_recent_keyframes_are_no_duplicates() -> None:
    rows, anchors = joined(wall(1.0, 1.0), wall(1.0, 1.0, z_m=1.51))
    assert not find_duplicates(rows, anchors, 90, DeduplicationConfig(keyframes_apart=100)).any()
    assert not find_duplicates(rows, anchors, 4).any()
    assert not find_duplicates(rows[:0], anchors[:0], 4).any()
