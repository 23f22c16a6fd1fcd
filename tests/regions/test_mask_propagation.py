"""Mask propagation to a keyframe without a segment of the region."""

import numpy as np
import pytest

from ldo_service.geometry import Camera, se3
from ldo_service.regions.foreground import Foreground
from ldo_service.regions.region import observe_region
from ldo_service.regions.region_matching import MIN_PIXELS, STRIDE_PX, pixels, propagate_mask
from ldo_service.regions.region_proposals import RegionProposal

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
SHAPE = 120, 160
OBJECT_M, WALL_M = 1.2, 2.4
DISC = (np.arange(160) - 60) ** 2 + (np.arange(120)[:, None] - 50) ** 2 < 24**2


def scene(x_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return depth [H, W] and disc mask of a disc in front of a wall.

    Each pixel's ray is cast from a camera x_m to the right.
    """
    u = np.arange(160) + CAMERA.fx * x_m / OBJECT_M
    is_disc = (u - 60) ** 2 + (np.arange(120)[:, None] - 50) ** 2 < 24**2
    return np.where(is_disc, OBJECT_M, WALL_M).astype(np.float32), is_disc


def propagated_to(x_m: float, gap_m: float = 0.1, depth_m: np.ndarray | None = None):
    """Propagate the disc mask, observed at the origin, to a camera x_m to the right."""
    before_m, is_disc = scene(0.0)
    assert np.array_equal(is_disc, DISC)
    part = Foreground(26, 36, DISC[26:75, 36:85])
    observation = observe_region(0, RegionProposal(part.box_px, part), before_m, CAMERA)
    assert observation is not None
    T = se3.exp(np.array([0, 0, 0, x_m, 0, 0]))
    now_m = scene(x_m)[0] if depth_m is None else depth_m
    rows, columns, is_inside = pixels(observation.p_camera - [x_m, 0, 0], CAMERA, SHAPE)
    assert is_inside.sum() >= 12
    seen = rows[is_inside], columns[is_inside]
    return propagate_mask(observation, *seen, now_m, CAMERA, T, gap_m)


def iou(found: Foreground | None, is_disc: np.ndarray) -> float:
    """Return the intersection over union."""
    assert found is not None
    image = found.image(SHAPE)
    return np.count_nonzero(image & is_disc) / np.count_nonzero(image | is_disc)


def test_propagated_mask_matches_object_after_camera_motion() -> None:
    """0.2 m at 1.2 m and f = 120 px are 20 px.

    A disc of 48 px that consists of squares of 4 px has an IoU above 0.8 with the exact disc.
    """
    for x_m in (0.0, 0.2, -0.3):
        _, is_disc = scene(x_m)
        assert iou(propagated_to(x_m), is_disc) > 0.8


def test_background_inside_the_earlier_mask_is_excluded() -> None:
    """The object has moved by 30 px and the wall by 15 px after 0.3 m.

    Some of the wall lies in the earlier mask, over a meter behind the object.
    """
    now_m, is_disc = scene(0.3)
    row, column = np.nonzero(~is_disc)
    old_column = column + CAMERA.fx * 0.3 / now_m[row, column]
    is_behind = (old_column - 60) ** 2 + (row - 50) ** 2 < 20**2
    assert np.count_nonzero(is_behind) > 200, "the test needs such pixels"
    found = propagated_to(0.3)
    assert found is not None
    wrong = np.count_nonzero(found.image(SHAPE) & ~is_disc)
    assert wrong < 4 * STRIDE_PX * 48, "the squares extend beyond the rim"
    assert np.count_nonzero(found.image(SHAPE)[row[is_behind], column[is_behind]]) < wrong


def test_missing_object_or_depth_gives_no_mask() -> None:
    wall_only = np.full(SHAPE, WALL_M, np.float32)
    assert propagated_to(0.1, depth_m=wall_only) is None
    assert propagated_to(0.1, depth_m=np.zeros(SHAPE, np.float32)) is None


def test_fewer_than_twelve_samples_give_no_mask() -> None:
    """The visible part of the disc is its left columns, with a varying number of samples."""
    counts = {}
    for columns in range(37, 61, STRIDE_PX):
        now_m, _ = scene(0.0)
        now_m[:, columns:] = WALL_M
        visible = np.count_nonzero(now_m[::STRIDE_PX, ::STRIDE_PX] == np.float32(OBJECT_M))
        counts[visible] = propagated_to(0.0, depth_m=now_m) is not None
    assert MIN_PIXELS == 12
    assert min(counts) < 12 < max(counts)
    assert all(is_shown == (visible >= 12) for visible, is_shown in counts.items())


def test_propagated_mask_is_clipped_to_the_image() -> None:
    found = propagated_to(0.45)
    assert found is not None
    assert found.column == 0
    assert iou(found, scene(0.45)[1]) > 0.7


@pytest.mark.parametrize("rows", [24, 48, 95, 96])
@pytest.mark.parametrize("columns", [24, 95, 96, 130])
def test_rectangle_of_any_size_is_propagated_whole(rows: int, columns: int) -> None:
    """The sampled points must not lie on lines."""
    depth_m, mask = np.full(SHAPE, WALL_M, np.float32), np.zeros(SHAPE, bool)
    mask[12 : 12 + rows, 20 : 20 + columns] = True
    part = Foreground(12, 20, mask[12 : 12 + rows, 20 : 20 + columns])
    observation = observe_region(0, RegionProposal(part.box_px, part), depth_m, CAMERA)
    assert observation is not None
    rows_px, columns_px, _ = pixels(observation.p_camera, CAMERA, SHAPE)
    found = propagate_mask(observation, rows_px, columns_px, depth_m, CAMERA, np.eye(4), 1e-3)
    assert iou(found, mask) > 0.85
