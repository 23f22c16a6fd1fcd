"""What a keyframe sees of earlier regions, beside what it shows of them itself."""

import numpy as np
import pytest

from ldo_service.geometry import Camera
from ldo_service.regions.foreground import Foreground
from ldo_service.regions.region import Region, observe_region
from ldo_service.regions.region_matching import RegionMatcher
from ldo_service.regions.region_proposals import RegionProposal

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
WALL_M = np.full((120, 160), 2.0, np.float32)
LEAST = 12


def part(left: int, top: int, width: int, height: int) -> Foreground:
    return Foreground(top, left, np.ones((height, width), bool))


def region(id_: int, of: Foreground) -> Region:
    seen = observe_region(0, RegionProposal(of.box_px, of), WALL_M, CAMERA)
    assert seen is not None
    return Region(id_, 0, seen.box_px, seen)


def known(*regions: Region, depth_m: np.ndarray = WALL_M) -> RegionMatcher:
    """Seen again from the same place."""
    return RegionMatcher(regions, 1, depth_m, CAMERA, dict.fromkeys((0, 1), np.eye(4)), 0.1, LEAST)


def test_regions_overlap_by_what_each_has_of_the_other() -> None:
    """Of a whole and its upper half, 0.5; of two that share half of each, a third; of others 0."""
    whole, half, beside = part(40, 40, 40, 40), part(40, 40, 40, 20), part(60, 60, 40, 20)
    shown = {7: whole, 3: half, 5: beside}
    overlaps = known(*(region(id_, of) for id_, of in shown.items())).overlaps([*shown.items()])
    both = 20 * 20 / (40 * 40 + 20 * 20)
    expected = [[1, 0.5, both], [0.5, 1, 0], [both, 0, 1]]
    np.testing.assert_allclose(overlaps, expected, atol=0.04)


def test_what_is_hidden_or_new_overlaps_nothing_but_itself() -> None:
    whole, half = part(40, 40, 40, 40), part(40, 40, 40, 20)
    shown = [(7, whole), (3, half)]
    hidden = known(region(7, whole), region(3, half), depth_m=WALL_M - 1)
    new = known(region(7, whole))
    for one in (hidden, new):
        np.testing.assert_array_equal(one.overlaps(shown), np.eye(2))
    assert known().overlaps([]).shape == (0, 0)


@pytest.mark.parametrize(("seen_px", "ids"), [(160, [7]), (0, [])])
def test_it_tells_what_it_sees(seen_px: int, ids: list[int]) -> None:
    depth_m = WALL_M.copy()
    depth_m[:, seen_px:] = 0
    assert [*known(region(7, part(40, 40, 40, 40)), depth_m=depth_m).seen()] == ids
