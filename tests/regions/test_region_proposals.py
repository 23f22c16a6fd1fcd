"""Region proposals from boxes and geometric segments."""

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
NO_LABELS = np.zeros((120, 160), bool)


def wall_with(*boxes: tuple[int, int, int, int]) -> np.ndarray:
    """Return depth of a wall with boxes in front: left, top, right and bottom, inclusive."""
    depth_m = np.full((120, 160), WALL_M, np.float32)
    for left, top, right, bottom in boxes:
        depth_m[top : bottom + 1, left : right + 1] = NEAR_M
    return depth_m


def unlabelled_proposals(*args, **kwargs) -> list[RegionProposal]:
    """Return the proposals that need a label; those with a confident detection need none."""
    return [proposal for proposal in proposals(*args, **kwargs) if proposal.score < CONFIG.sure]


def proposals(depth_m, boxes=(), labels=(), scores=(), is_labelled=NO_LABELS, config=CONFIG):
    boxes = np.reshape(np.array(boxes, float), (-1, 4))
    found = segments(depth_m, config)
    scores = np.array(scores)
    return propose_regions(boxes, labels, scores, depth_m, CAMERA, is_labelled, found, [], config)


def segments(depth_m: np.ndarray, config: RegionProposalConfig = CONFIG) -> list[RegionProposal]:
    found = segment_geometry(GRAY, depth_m, CAMERA, config.segments)
    return regions_of_image(found, depth_m.shape, config)


OBJECT = (60, 40, 89, 79)


@pytest.mark.parametrize("module", [region_proposals, region_views])
def test_docstring_examples_pass(module) -> None:
    names = {name: getattr(module, name) for name in dir(module)}
    result = doctest.testmod(module, extraglobs=names)
    assert (result.attempted > 0, result.failed) == (True, 0)


def test_object_in_front_of_a_wall_is_proposed_and_the_wall_is_not() -> None:
    (found,) = unlabelled_proposals(wall_with(OBJECT))
    assert found.box_px == pytest.approx(np.array([59.5, 39.5, 89.5, 79.5]), abs=3)
    assert (found.label, found.score) == ("", 0)
    mask = found.part.image((120, 160))
    truth = wall_with(OBJECT) == NEAR_M
    assert np.count_nonzero(mask & truth) > 0.8 * np.count_nonzero(truth)
    assert not np.any(mask & ~truth)
    assert unlabelled_proposals(wall_with()) == []


@pytest.mark.parametrize(("score", "count"), [(0.61, 0), (0.6, 0), (0.59, 1), (0.1, 1)])
def test_box_is_proposed_only_below_the_score_of_the_paper(score: float, count: int) -> None:
    box = (59.5, 39.5, 89.5, 79.5)
    found = unlabelled_proposals(wall_with(OBJECT), [box], ["vase"], [score])
    assert len(found) == count, "the segment in the box is not proposed a second time"
    assert len(proposals(wall_with(OBJECT), [box], ["vase"], [score])) == 1
    for proposal in found:
        assert (proposal.label, proposal.score) == ("vase", score)
        assert proposal.box_px == pytest.approx(np.array(box), abs=3), "the box of the object"


def test_box_without_a_segment_is_proposed_unchanged() -> None:
    box = (10.5, 10.5, 50.5, 60.5)
    (found,) = unlabelled_proposals(
        wall_with((10, 10, 28, 60)), [box], ["vase"], [0.3], config=LOOSE
    )
    assert found.box_px.tolist() == list(box)


def test_wall_visible_through_an_object_is_removed_from_its_mask() -> None:
    """A trellis 0.3 m in front of a wall; the wall between its bars lies in the box."""
    bars = [(left, 30, left + 5, 89) for left in (60, 72, 84, 96)]
    is_bar = wall_with(*bars, (60, 30, 101, 35), (60, 84, 101, 89)) == NEAR_M
    depth_m = np.where(is_bar, WALL_M - 0.3, WALL_M).astype(np.float32)
    box = np.array([(60, 30, 101, 89)], float)
    arguments = box, ["tv"], np.array([0.9]), depth_m, CAMERA, NO_LABELS
    wall = Foreground(0, 0, ~is_bar)
    (whole,), (cut,) = (propose_regions(*arguments, [], room, CONFIG) for room in ([], [wall]))
    whole_mask, cut_mask = (proposal.part.image(is_bar.shape) for proposal in (whole, cut))
    assert np.mean(whole_mask[is_bar]) > 0.95
    assert np.count_nonzero(whole_mask & ~is_bar) > 100, "the test needs such pixels"
    assert np.array_equal(cut_mask, whole_mask & is_bar)


def test_wall_stays_in_the_mask_if_too_little_would_remain() -> None:
    box = (50, 30, 109, 109)
    is_bar = wall_with((78, 30, 81, 109), (50, 30, 109, 33), (50, 106, 109, 109)) == NEAR_M
    depth_m = np.where(is_bar, WALL_M - 0.3, WALL_M).astype(np.float32)
    arguments = np.array([box], float), ["tv"], np.array([0.4]), depth_m, CAMERA, NO_LABELS
    wall = ~is_bar
    wall[96:] = False
    (found,) = propose_regions(*arguments, [], [Foreground(0, 0, wall)], CONFIG)
    assert np.count_nonzero(found.part.mask) > 1.2 * CONFIG.min_fill * 59 * 79
    assert np.count_nonzero(found.part.image(wall.shape) & wall) > 100


def test_flat_object_on_a_wall_stays_whole() -> None:
    clock, wall = Foreground(40, 60, np.ones((30, 30), bool)), np.ones((120, 160), bool)
    assert remove_structure(clock, [Foreground(0, 0, wall)], 0.5) is clock


def test_uncertain_box_over_a_confident_one_is_not_proposed() -> None:
    boxes = [(59.5, 39.5, 89.5, 79.5), (58.5, 39.5, 89.5, 78.5)]
    assert unlabelled_proposals(wall_with(OBJECT), boxes, ["chair", "bench"], [0.9, 0.5]) == []


def test_labelled_segments_are_not_proposed() -> None:
    depth_m = wall_with(OBJECT, (110, 40, 139, 79))
    assert len(unlabelled_proposals(depth_m)) == 2
    is_labelled = np.zeros((120, 160), bool)
    is_labelled[:, :100] = True
    (found,) = unlabelled_proposals(depth_m, is_labelled=is_labelled)
    assert found.box_px[0] > 100


def test_standing_segment_on_a_labelled_object_is_proposed() -> None:
    """The label of the map there belongs to the object below."""
    standing = RegionProposal(
        np.array([20, 20, 59, 59]) - 0.5, Foreground(20, 20, np.ones((39, 39), bool))
    )
    depth_m, is_labelled = wall_with(), np.ones((120, 160), bool)
    none = np.zeros((0, 4)), [], np.zeros(0), depth_m, CAMERA, is_labelled
    for kind, count in (("standing", 1), ("convex", 0), ("apart", 0), ("flat", 0)):
        assert len(propose_regions(*none, [replace(standing, kind=kind)], [], CONFIG)) == count
    # A detection of the region replaces the proposal.
    box = standing.box_px[None], ["cup"], np.array([0.9]), depth_m, CAMERA, is_labelled
    (found,) = propose_regions(*box, [replace(standing, kind="standing")], [], CONFIG)
    assert found.number == 0


def test_labeled_regions_are_labelled_segments_without_a_box() -> None:
    depth_m = wall_with(OBJECT, (110, 40, 139, 79))
    is_labelled = np.zeros((120, 160), bool)
    is_labelled[:, :100] = True
    segmented = segments(depth_m)
    assert len(segmented) == 2
    none, box = np.zeros((0, 4)), np.array([[59.5, 39.5, 89.5, 79.5]])
    (found,) = labeled_regions(none, is_labelled, segmented, CONFIG)
    assert found.box_px[2] < 100
    assert labeled_regions(box, is_labelled, segmented, CONFIG) == []


def test_too_small_and_too_large_segments_are_not_proposed() -> None:
    assert unlabelled_proposals(wall_with((60, 40, 67, 79))) == []
    large = wall_with((20, 10, 139, 109))
    assert len(unlabelled_proposals(large, config=replace(CONFIG, max_share=0.7))) == 1
    assert unlabelled_proposals(large, config=replace(CONFIG, max_share=0.5)) == []


def test_missing_depth_gives_no_proposals() -> None:
    assert unlabelled_proposals(np.zeros((120, 160), np.float32)) == []
    depth_m = wall_with()
    depth_m[40:80, 60:90] = 0
    assert unlabelled_proposals(depth_m) == []


def test_proposals_are_sorted_by_size_and_limited() -> None:
    depth_m = wall_with(OBJECT, (10, 40, 29, 59), (110, 40, 149, 89))
    sizes = [np.count_nonzero(found.part.mask) for found in unlabelled_proposals(depth_m)]
    assert sizes == sorted(sizes, reverse=True)
    assert len(sizes) == 3
    assert len(unlabelled_proposals(depth_m, config=replace(CONFIG, most=2))) == 2


def test_unlabelled_proposals_precede_confident_detections() -> None:
    small, large = (10, 40, 29, 59), (60, 20, 119, 99)
    (proposal,) = proposals(
        wall_with(small, large), [large], ["tv"], [0.9], config=replace(CONFIG, most=1)
    )
    assert proposal.score < CONFIG.sure


def test_overlapping_objects_at_different_depths_are_separate() -> None:
    depth_m = wall_with((40, 40, 79, 79))
    depth_m[30:90, 80:110] = 1.2
    shapes = [proposal.part.mask.shape for proposal in segments(depth_m)]
    assert shapes == [pytest.approx((58, 28), abs=3), pytest.approx((38, 38), abs=3)]


def test_duplicate_segments_are_merged() -> None:
    kinds = [proposal.kind for proposal in segments(wall_with(OBJECT))]
    assert kinds == ["apart"], "an object without creases would be a convex segment too"


@pytest.mark.parametrize(
    "fields", [{"sure": 1.5}, {"min_side_px": 0}, {"most": 0}, {"fits_iou": -1}]
)
def test_invalid_settings_raise_config_error(fields: dict) -> None:
    with pytest.raises(ConfigError):
        RegionProposalConfig(**fields)
