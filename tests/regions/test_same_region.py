"""When two sightings are of the same region."""

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


def at(left: int, top: int, right: int, bottom: int) -> RegionProposal:
    """A region of these columns and rows, cut to the image."""
    left, top, right, bottom = max(left, 0), max(top, 0), min(right, 160), min(bottom, 120)
    box = np.array([left, top, right, bottom]) - 0.5
    return RegionProposal(box, Foreground(top, left, np.ones((bottom - top, right - left), bool)))


def seen(keyframe: int, candidate: RegionProposal, depth_m: np.ndarray = WALL) -> RegionObservation:
    sighting = observe_region(keyframe, candidate, depth_m, CAMERA)
    assert sighting is not None
    return sighting


def shares(
    known: RegionProposal, now: RegionProposal, *, x_m=0.0, depth_m=WALL
) -> tuple[float, float]:
    """Of what keyframe 1, x_m to the right of keyframe 0, sees of the region known from there, the
    share in the one seen now; and back."""
    T_map_keyframe = {0: np.eye(4), 1: se3.exp(np.array([0, 0, 0, x_m, 0, 0]))}
    first = seen(0, known)
    region = Region(0, 0, first.box_px, first)
    T_camera_map = se3.inverse(T_map_keyframe[1])
    there = projected([region], depth_m, CAMERA, T_camera_map, T_map_keyframe, 0.1)
    second = seen(1, now, depth_m)
    back = reverse_overlap(second, region, SHAPE, CAMERA, T_map_keyframe, 12)
    return float(there.shares_in(now.part)[0]), back


def test_shares_are_those_of_the_areas() -> None:
    """40 columns of which 10 are common: a quarter, and of 20 the other way a half."""
    here, back = shares(at(20, 40, 60, 80), at(50, 40, 70, 80))
    assert here == pytest.approx(0.25, abs=0.06)
    assert back == pytest.approx(0.5, abs=0.06)


def test_it_is_followed_as_the_camera_moves() -> None:
    """0.5 m at 2 m and f = 120 px are 30 px."""
    assert min(shares(at(60, 40, 100, 80), at(30, 40, 70, 80), x_m=0.5)) > 0.95


def test_what_the_image_cuts_off_is_still_the_same() -> None:
    assert min(shares(at(60, 40, 100, 80), at(-30, 40, 10, 80), x_m=1.5)) > 0.95


def test_what_stands_on_a_thing_is_not_the_thing() -> None:
    table, cup = at(20, 40, 140, 80), at(70, 50, 90, 70)
    here, back = shares(table, cup)
    assert here < 0.2
    assert back > 0.95
    here, back = shares(cup, table)
    assert here > 0.95
    assert back < 0.2


def test_what_is_hidden_says_nothing() -> None:
    """A post before the right half of a picture: the left half is seen, and is it."""
    depth_m = WALL.copy()
    depth_m[:, 80:160] = 1.0
    known, left_half = at(60, 40, 100, 80), at(60, 40, 80, 80)
    assert shares(known, left_half, depth_m=depth_m)[0] > 0.95
    assert shares(known, left_half)[0] == pytest.approx(0.5, abs=0.06)


def test_the_post_is_not_the_picture_behind() -> None:
    depth_m = WALL.copy()
    depth_m[:, 60:100] = 1.0
    assert shares(at(60, 40, 100, 80), at(60, 40, 100, 80), depth_m=depth_m)[0] == 0
