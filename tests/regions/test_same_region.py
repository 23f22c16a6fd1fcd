"""Overlap of a known region with one observed in another keyframe."""

import numpy as np
import pytest

from ldo_service.geometry import Camera, se3
from ldo_service.regions.foreground import Foreground
from ldo_service.regions.region import Region, RegionObservation, observe_region
from ldo_service.regions.region_matching import projected, reverse_overlap
from ldo_service.regions.region_proposals import RegionProposal

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
SHAPE = 120, 160
FAR_M = 2.0
WALL = np.full(SHAPE, FAR_M, np.float32)


def proposal(left: int, top: int, right: int, bottom: int) -> RegionProposal:
    """Return a proposal of these columns and rows, clipped to the image."""
    left, top, right, bottom = max(left, 0), max(top, 0), min(right, 160), min(bottom, 120)
    box = np.array([left, top, right, bottom]) - 0.5
    return RegionProposal(box, Foreground(top, left, np.ones((bottom - top, right - left), bool)))


def observe(
    keyframe: int, region_proposal: RegionProposal, depth_m: np.ndarray = WALL
) -> RegionObservation:
    observation = observe_region(keyframe, region_proposal, depth_m, CAMERA)
    assert observation is not None
    return observation


def overlaps(
    known: RegionProposal, current: RegionProposal, *, x_m=0.0, depth_m=WALL
) -> tuple[float, float]:
    """Return the fractions of two regions that lie in each other.

    The first is the fraction of the region of keyframe 0, as visible in keyframe 1, that lies in
    the region of keyframe 1. The second is the reverse. Keyframe 1 is x_m to the right.
    """
    T_map_keyframe = {0: np.eye(4), 1: se3.exp(np.array([0, 0, 0, x_m, 0, 0]))}
    first = observe(0, known)
    region = Region(0, 0, first.box_px, first)
    T_camera_map = se3.inverse(T_map_keyframe[1])
    projection = projected([region], depth_m, CAMERA, T_camera_map, T_map_keyframe, 0.1)
    second = observe(1, current, depth_m)
    reverse = reverse_overlap(second, region, SHAPE, CAMERA, T_map_keyframe, 12)
    return float(projection.shares_in(current.part)[0]), reverse


def test_overlaps_match_the_common_area() -> None:
    """10 of 40 columns are common: a quarter. In reverse it is half of 20 columns."""
    forward, reverse = overlaps(proposal(20, 40, 60, 80), proposal(50, 40, 70, 80))
    assert forward == pytest.approx(0.25, abs=0.06)
    assert reverse == pytest.approx(0.5, abs=0.06)


def test_overlaps_account_for_camera_motion() -> None:
    """0.5 m at 2 m and f = 120 px are 30 px."""
    assert min(overlaps(proposal(60, 40, 100, 80), proposal(30, 40, 70, 80), x_m=0.5)) > 0.95


def test_region_clipped_by_the_image_still_overlaps() -> None:
    assert min(overlaps(proposal(60, 40, 100, 80), proposal(-30, 40, 10, 80), x_m=1.5)) > 0.95


def test_object_on_a_table_overlaps_in_one_direction_only() -> None:
    table, cup = proposal(20, 40, 140, 80), proposal(70, 50, 90, 70)
    forward, reverse = overlaps(table, cup)
    assert forward < 0.2
    assert reverse > 0.95
    forward, reverse = overlaps(cup, table)
    assert forward > 0.95
    assert reverse < 0.2


def test_hidden_pixels_do_not_count() -> None:
    """A post hides the right half of a picture; the left half matches fully."""
    depth_m = WALL.copy()
    depth_m[:, 80:160] = 1.0
    known, left_half = proposal(60, 40, 100, 80), proposal(60, 40, 80, 80)
    assert overlaps(known, left_half, depth_m=depth_m)[0] > 0.95
    assert overlaps(known, left_half)[0] == pytest.approx(0.5, abs=0.06)


def test_occluder_does_not_match_the_region_behind() -> None:
    depth_m = WALL.copy()
    depth_m[:, 60:100] = 1.0
    assert overlaps(proposal(60, 40, 100, 80), proposal(60, 40, 100, 80), depth_m=depth_m)[0] == 0
