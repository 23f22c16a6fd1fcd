"""Masks carried over to a keyframe that set nothing apart there."""

import numpy as np
import pytest

from ldo_service.geometry import Camera, se3
from ldo_service.regions.foreground import Foreground
from ldo_service.regions.region import observe_region
from ldo_service.regions.region_matching import LEAST, STRIDE_PX, pixels, propagate_mask
from ldo_service.regions.region_proposals import RegionProposal

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
SHAPE = 120, 160
THING_M, WALL_M = 1.2, 2.4
DISC = (np.arange(160) - 60) ** 2 + (np.arange(120)[:, None] - 50) ** 2 < 24**2


def scene(x_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] of a disc before a wall from a camera x_m to the right, and where the disc is,
    by casting each pixel's ray."""
    u = np.arange(160) + CAMERA.fx * x_m / THING_M
    is_disc = (u - 60) ** 2 + (np.arange(120)[:, None] - 50) ** 2 < 24**2
    return np.where(is_disc, THING_M, WALL_M).astype(np.float32), is_disc


def shown_from(x_m: float, gap_m: float = 0.1, depth_m: np.ndarray | None = None):
    """What a camera x_m to the right sees of the disc that was set apart before."""
    before_m, is_disc = scene(0.0)
    assert np.array_equal(is_disc, DISC)
    part = Foreground(26, 36, DISC[26:75, 36:85])
    sighting = observe_region(0, RegionProposal(part.box_px, part), before_m, CAMERA)
    assert sighting is not None
    T = se3.exp(np.array([0, 0, 0, x_m, 0, 0]))
    now_m = scene(x_m)[0] if depth_m is None else depth_m
    rows, columns, is_inside = pixels(sighting.p_camera - [x_m, 0, 0], CAMERA, SHAPE)
    assert is_inside.sum() >= 12
    seen = rows[is_inside], columns[is_inside]
    return propagate_mask(sighting, *seen, now_m, CAMERA, T, gap_m)


def overlap(found: Foreground | None, is_disc: np.ndarray) -> float:
    """IoU."""
    assert found is not None
    image = found.image(SHAPE)
    return np.count_nonzero(image & is_disc) / np.count_nonzero(image | is_disc)


def test_a_mask_lies_where_the_thing_is_now() -> None:
    """0.2 m at 1.2 m and f = 120 px are 20 px: by squares of 4 px a disc of 48 is met by 0.8."""
    for x_m in (0.0, 0.2, -0.3):
        _, is_disc = scene(x_m)
        assert overlap(shown_from(x_m), is_disc) > 0.8


def test_the_wall_behind_that_the_mask_would_cover_from_here_is_not_its_own() -> None:
    """From 0.3 m aside, the thing has moved by 30 px and the wall by 15: some of the wall lies in
    the old mask, a metre behind the thing."""
    now_m, is_disc = scene(0.3)
    row, column = np.nonzero(~is_disc)
    old_column = column + CAMERA.fx * 0.3 / now_m[row, column]
    is_behind = (old_column - 60) ** 2 + (row - 50) ** 2 < 20**2
    assert np.count_nonzero(is_behind) > 200, "or nothing would be told apart"
    found = shown_from(0.3)
    assert found is not None
    wrong = np.count_nonzero(found.image(SHAPE) & ~is_disc)
    assert wrong < 4 * STRIDE_PX * 48, "squares reach over the rim"
    assert np.count_nonzero(found.image(SHAPE)[row[is_behind], column[is_behind]]) < wrong


def test_what_has_gone_or_has_no_depth_is_not_shown() -> None:
    gone = np.full(SHAPE, WALL_M, np.float32)
    assert shown_from(0.1, depth_m=gone) is None
    assert shown_from(0.1, depth_m=np.zeros(SHAPE, np.float32)) is None


def test_next_to_nothing_is_not_shown() -> None:
    """Of the disc only its left columns, by how many pixels of the grid they have."""
    counts = {}
    for columns in range(37, 61, STRIDE_PX):
        now_m, _ = scene(0.0)
        now_m[:, columns:] = WALL_M
        left = np.count_nonzero(now_m[::STRIDE_PX, ::STRIDE_PX] == np.float32(THING_M))
        counts[left] = shown_from(0.0, depth_m=now_m) is not None
    assert LEAST == 12
    assert min(counts) < 12 < max(counts)
    assert all(is_shown == (left >= 12) for left, is_shown in counts.items())


def test_it_ends_at_the_border_of_the_image() -> None:
    found = shown_from(0.45)
    assert found is not None
    assert found.column == 0
    assert overlap(found, scene(0.45)[1]) > 0.7


@pytest.mark.parametrize("rows", [24, 48, 95, 96])
@pytest.mark.parametrize("columns", [24, 95, 96, 130])
def test_a_rectangle_is_whole_whatever_its_sides(rows: int, columns: int) -> None:
    """Its points must not lie on lines."""
    depth_m, mask = np.full(SHAPE, WALL_M, np.float32), np.zeros(SHAPE, bool)
    mask[12 : 12 + rows, 20 : 20 + columns] = True
    part = Foreground(12, 20, mask[12 : 12 + rows, 20 : 20 + columns])
    sighting = observe_region(0, RegionProposal(part.box_px, part), depth_m, CAMERA)
    assert sighting is not None
    at, to, _ = pixels(sighting.p_camera, CAMERA, SHAPE)
    assert overlap(propagate_mask(sighting, at, to, depth_m, CAMERA, np.eye(4), 1e-3), mask) > 0.85
