"""Region matching between keyframes."""

import numpy as np
import pytest

from ldo_service.geometry import Camera
from ldo_service.regions.foreground import Foreground
from ldo_service.regions.region import Region, observe_region
from ldo_service.regions.region_matching import RegionMatcher
from ldo_service.regions.region_proposals import RegionProposal

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
WALL_M = np.full((120, 160), 2.0, np.float32)
MIN_PIXELS = 12


def part(left: int, top: int, width: int, height: int) -> Foreground:
    return Foreground(top, left, np.ones((height, width), bool))


def region(id_: int, mask: Foreground) -> Region:
    seen = observe_region(0, RegionProposal(mask.box_px, mask), WALL_M, CAMERA)
    assert seen is not None
    return Region(id_, 0, seen.box_px, seen)


def matcher_of(*regions: Region, depth_m: np.ndarray = WALL_M) -> RegionMatcher:
    """Return a matcher of the regions for a later keyframe with the same pose."""
    return RegionMatcher(
        regions, 1, depth_m, CAMERA, dict.fromkeys((0, 1), np.eye(4)), 0.1, MIN_PIXELS
    )


def test_overlaps_match_intersection_over_union() -> None:
    """The overlap is 0.5 for a whole and its half, and 0.2 for the partial overlap."""
    whole, half, neighbor = part(40, 40, 40, 40), part(40, 40, 40, 20), part(60, 60, 40, 20)
    shown = {7: whole, 3: half, 5: neighbor}
    overlaps = matcher_of(*(region(id_, mask) for id_, mask in shown.items())).overlaps(
        [*shown.items()]
    )
    both = 20 * 20 / (40 * 40 + 20 * 20)
    expected = [[1, 0.5, both], [0.5, 1, 0], [both, 0, 1]]
    np.testing.assert_allclose(overlaps, expected, atol=0.04)


def test_hidden_and_new_regions_overlap_only_themselves() -> None:
    whole, half = part(40, 40, 40, 40), part(40, 40, 40, 20)
    shown = [(7, whole), (3, half)]
    hidden = matcher_of(region(7, whole), region(3, half), depth_m=WALL_M - 1)
    new = matcher_of(region(7, whole))
    for matcher in (hidden, new):
        np.testing.assert_array_equal(matcher.overlaps(shown), np.eye(2))
    assert matcher_of().overlaps([]).shape == (0, 0)


@pytest.mark.parametrize(("seen_px", "ids"), [(160, [7]), (0, [])])
def test_seen_lists_visible_regions(seen_px: int, ids: list[int]) -> None:
    depth_m = WALL_M.copy()
    depth_m[:, seen_px:] = 0
    assert [*matcher_of(region(7, part(40, 40, 40, 40)), depth_m=depth_m).seen()] == ids
