"""Which regions are to be named."""

import doctest
from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera
from ldo_service.regions import region_proposals, region_views
from ldo_service.regions.foreground import Foreground
from ldo_service.regions.geometric_segmentation import segment_geometry
from ldo_service.regions.region_proposals import (
    RegionProposal,
    RegionProposalConfig,
    labeled_regions,
    propose_regions,
    regions_of_image,
    remove_structure,
)

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
WALL_M, NEAR_M = 3.0, 2.0
CONFIG = RegionProposalConfig(min_side_px=12)
GRAY = np.full((120, 160, 3), 128, np.uint8)
LOOSE = RegionProposalConfig(min_side_px=22, min_fill=0.1)
NOBODY = np.zeros((120, 160), bool)


def wall_with(*boxes: tuple[int, int, int, int]) -> np.ndarray:
    """A wall that fills the view, and things before it: first and last column and row."""
    depth_m = np.full((120, 160), WALL_M, np.float32)
    for left, top, right, bottom in boxes:
        depth_m[top : bottom + 1, left : right + 1] = NEAR_M
    return depth_m


def asked(*args, **kwargs) -> list[RegionProposal]:
    """But for what the detector is sure of, which is followed alone."""
    return [one for one in followed(*args, **kwargs) if one.score < CONFIG.sure]


def followed(depth_m, boxes=(), labels=(), scores=(), is_labelled=NOBODY, config=CONFIG):
    boxes = np.reshape(np.array(boxes, float), (-1, 4))
    found = regions(depth_m, config)
    scores = np.array(scores)
    return propose_regions(boxes, labels, scores, depth_m, CAMERA, is_labelled, found, [], config)


def regions(depth_m: np.ndarray, config: RegionProposalConfig = CONFIG) -> list[RegionProposal]:
    found = segment_geometry(GRAY, depth_m, CAMERA, config.segments)
    return regions_of_image(found, depth_m.shape, config)


THING = (60, 40, 89, 79)


@pytest.mark.parametrize("module", [region_proposals, region_views])
def test_the_examples_hold(module) -> None:
    names = {name: getattr(module, name) for name in dir(module)}
    result = doctest.testmod(module, extraglobs=names)
    assert (result.attempted > 0, result.failed) == (True, 0)


def test_what_stands_before_a_wall_is_asked_about_and_the_wall_is_not() -> None:
    (found,) = asked(wall_with(THING))
    assert found.box_px == pytest.approx(np.array([59.5, 39.5, 89.5, 79.5]), abs=3)
    assert (found.label, found.score) == ("", 0)
    mask = found.part.image((120, 160))
    truth = wall_with(THING) == NEAR_M
    assert np.count_nonzero(mask & truth) > 0.8 * np.count_nonzero(truth)
    assert not np.any(mask & ~truth)
    assert asked(wall_with()) == []


@pytest.mark.parametrize(("score", "count"), [(0.61, 0), (0.6, 0), (0.59, 1), (0.1, 1)])
def test_a_box_is_asked_about_below_the_score_of_the_paper(score: float, count: int) -> None:
    box = (59.5, 39.5, 89.5, 79.5)
    found = asked(wall_with(THING), [box], ["vase"], [score])
    assert len(found) == count, "the object in it is not asked about a second time"
    assert len(followed(wall_with(THING), [box], ["vase"], [score])) == 1
    for one in found:
        assert (one.label, one.score) == ("vase", score)
        assert one.box_px == pytest.approx(np.array(box), abs=3), "of what stands there"


def test_a_box_around_no_region_is_asked_about_as_it_is() -> None:
    box = (10.5, 10.5, 50.5, 60.5)
    (found,) = asked(wall_with((10, 10, 28, 60)), [box], ["vase"], [0.3], config=LOOSE)
    assert found.box_px.tolist() == list(box)


def test_a_wall_seen_through_a_box_s_thing_is_no_part_of_it() -> None:
    """A trellis 0.3 m before a wall: what is between its bars is inside of it."""
    bars = [(left, 30, left + 5, 89) for left in (60, 72, 84, 96)]
    is_bar = wall_with(*bars, (60, 30, 101, 35), (60, 84, 101, 89)) == NEAR_M
    depth_m = np.where(is_bar, WALL_M - 0.3, WALL_M).astype(np.float32)
    told = np.array([(60, 30, 101, 89)], float), ["tv"], np.array([0.9]), depth_m, CAMERA, NOBODY
    wall = Foreground(0, 0, ~is_bar)
    (whole,), (cut,) = (propose_regions(*told, [], room, CONFIG) for room in ([], [wall]))
    was, now = (one.part.image(is_bar.shape) for one in (whole, cut))
    assert np.mean(was[is_bar]) > 0.95
    assert np.count_nonzero(was & ~is_bar) > 100, "or it shows nothing"
    assert np.array_equal(now, was & is_bar)


def test_a_box_of_which_the_wall_leaves_too_little_is_asked_about_with_it() -> None:
    box = (50, 30, 109, 109)
    is_bar = wall_with((78, 30, 81, 109), (50, 30, 109, 33), (50, 106, 109, 109)) == NEAR_M
    depth_m = np.where(is_bar, WALL_M - 0.3, WALL_M).astype(np.float32)
    told = np.array([box], float), ["tv"], np.array([0.4]), depth_m, CAMERA, NOBODY
    wall = ~is_bar
    wall[96:] = False
    (found,) = propose_regions(*told, [], [Foreground(0, 0, wall)], CONFIG)
    assert np.count_nonzero(found.part.mask) > 1.2 * CONFIG.min_fill * 59 * 79
    assert np.count_nonzero(found.part.image(wall.shape) & wall) > 100


def test_what_hangs_flat_on_a_wall_stays_whole() -> None:
    clock, wall = Foreground(40, 60, np.ones((30, 30), bool)), np.ones((120, 160), bool)
    assert remove_structure(clock, [Foreground(0, 0, wall)], 0.5) is clock


def test_a_hesitant_box_of_what_a_sure_one_has_is_not_asked_about() -> None:
    boxes = [(59.5, 39.5, 89.5, 79.5), (58.5, 39.5, 89.5, 78.5)]
    assert asked(wall_with(THING), boxes, ["chair", "bench"], [0.9, 0.5]) == []


def test_what_the_map_has_a_name_for_is_not_asked_about() -> None:
    depth_m = wall_with(THING, (110, 40, 139, 79))
    assert len(asked(depth_m)) == 2
    is_labelled = np.zeros((120, 160), bool)
    is_labelled[:, :100] = True
    (found,) = asked(depth_m, is_labelled=is_labelled)
    assert found.box_px[0] > 100


def test_what_stands_on_a_named_thing_is_asked_about_all_the_same() -> None:
    """The name is that of the thing."""
    on_it = RegionProposal(
        np.array([20, 20, 59, 59]) - 0.5, Foreground(20, 20, np.ones((39, 39), bool))
    )
    depth_m, named = wall_with(), np.ones((120, 160), bool)
    none = np.zeros((0, 4)), [], np.zeros(0), depth_m, CAMERA, named
    for kind, count in (("standing", 1), ("convex", 0), ("apart", 0), ("flat", 0)):
        assert len(propose_regions(*none, [replace(on_it, kind=kind)], [], CONFIG)) == count
    # but not once a box is drawn about it
    box = on_it.box_px[None], ["cup"], np.array([0.9]), depth_m, CAMERA, named
    (found,) = propose_regions(*box, [replace(on_it, kind="standing")], [], CONFIG)
    assert found.number == 0


def test_what_the_map_has_a_name_for_is_found_again_where_no_box_is() -> None:
    depth_m = wall_with(THING, (110, 40, 139, 79))
    is_labelled = np.zeros((120, 160), bool)
    is_labelled[:, :100] = True
    apart = regions(depth_m)
    assert len(apart) == 2
    none, box = np.zeros((0, 4)), np.array([[59.5, 39.5, 89.5, 79.5]])
    (found,) = labeled_regions(none, is_labelled, apart, CONFIG)
    assert found.box_px[2] < 100
    assert labeled_regions(box, is_labelled, apart, CONFIG) == []


def test_things_too_small_or_as_large_as_rooms_are_left_out() -> None:
    assert asked(wall_with((60, 40, 67, 79))) == []
    large = wall_with((20, 10, 139, 109))
    assert len(asked(large, config=replace(CONFIG, max_share=0.7))) == 1
    assert asked(large, config=replace(CONFIG, max_share=0.5)) == []


def test_missing_depth_is_no_object() -> None:
    assert asked(np.zeros((120, 160), np.float32)) == []
    depth_m = wall_with()
    depth_m[40:80, 60:90] = 0
    assert asked(depth_m) == []


def test_the_largest_come_first_and_no_more_than_the_most() -> None:
    depth_m = wall_with(THING, (10, 40, 29, 59), (110, 40, 149, 89))
    sizes = [np.count_nonzero(found.part.mask) for found in asked(depth_m)]
    assert sizes == sorted(sizes, reverse=True)
    assert len(sizes) == 3
    assert len(asked(depth_m, config=replace(CONFIG, most=2))) == 2


def test_what_is_sure_gives_way_to_what_is_to_be_asked_about() -> None:
    small, big = (10, 40, 29, 59), (60, 20, 119, 99)
    (one,) = followed(wall_with(small, big), [big], ["tv"], [0.9], config=replace(CONFIG, most=1))
    assert one.score < CONFIG.sure


def test_two_things_at_different_depths_that_overlap_are_two() -> None:
    depth_m = wall_with((40, 40, 79, 79))
    depth_m[30:90, 80:110] = 1.2
    shapes = [one.part.mask.shape for one in regions(depth_m)]
    assert shapes == [pytest.approx((58, 28), abs=3), pytest.approx((38, 38), abs=3)]


def test_two_regions_alike_are_one() -> None:
    kinds = [one.kind for one in regions(wall_with(THING))]
    assert kinds == ["apart"], "what no crease divides is convex too"


@pytest.mark.parametrize(
    "fields", [{"sure": 1.5}, {"min_side_px": 0}, {"most": 0}, {"fits_iou": -1}]
)
def test_settings_that_cannot_be_are_refused(fields: dict) -> None:
    with pytest.raises(ConfigError):
        RegionProposalConfig(**fields)
