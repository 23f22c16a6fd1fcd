"""What boxes of a detector become beside the names of regions."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.gaussians.training_views import TrainingView
from ldo_service.geometry import Camera
from ldo_service.regions.foreground import Foreground, RegionDetections
from ldo_service.regions.open_vocabulary import (
    OpenVocabularyLabeling,
    add_region_labels,
    match_boxes_to_regions,
)
from ldo_service.regions.region import RegionLabelResult
from ldo_service.regions.region_proposals import RegionProposal
from ldo_service.regions.region_tracker import RegionLabel, RegionTracker, RegionTrackerConfig

PART = Foreground(10, 20, np.ones((30, 40), bool))
BOX = np.array([19.5, 9.5, 59.5, 39.5], np.float32)


def region(number: int | None = None, kind: str = "apart") -> RegionProposal:
    return RegionProposal(BOX, PART, "tv", 0.5, number, kind)


def boxed(*names: str) -> tuple[RegionDetections, Vocabulary]:
    vocabulary = Vocabulary(256)
    labels = np.array([vocabulary.index(name) for name in names])
    boxes = np.tile(BOX, (len(names), 1))
    return RegionDetections.of_detector(
        boxes, labels, np.full(len(names), 0.5, np.float32)
    ), vocabulary


def test_a_box_is_the_thing_that_fits_it() -> None:
    found = [region(2), region(0, "flat"), region(1, ""), region(None)]
    assert match_boxes_to_regions(4, found) == (None, PART, PART, None)


def test_the_name_of_a_region_stands_in_place_of_a_box_s_label() -> None:
    claims, vocabulary = boxed("tv", "chair")
    named = add_region_labels(claims, [RegionLabel(region(0), "microwave", 0.9)], vocabulary, True)
    assert named.confidences.tolist() == [0, 0.5]
    assert named.open_labels[0] == vocabulary.index("microwave")
    assert named.open_confidences.tolist() == [np.float32(0.9), 0]
    assert claims.confidences.tolist() == [0.5, 0.5], "as it was"


def test_where_boxes_have_no_vote_both_words_are_weighed() -> None:
    claims, vocabulary = boxed("tv", "chair")
    named = add_region_labels(claims, [RegionLabel(region(0), "microwave", 0.9)], vocabulary, False)
    assert named.confidences.tolist() == [0.5, 0.5]
    assert named.labels.tolist() == claims.labels.tolist()
    assert named.open_labels[0] == vocabulary.index("microwave")
    assert named.open_confidences.tolist() == [np.float32(0.9), 0]


def test_a_region_whose_boxes_have_no_vote_is_as_sure_as_the_labeller_is() -> None:
    """Also where a box says the same, and was surer of it."""
    regions, camera = (
        RegionTracker(RegionTrackerConfig(boxes_vote=False)),
        Camera(160, 120, 120, 120, 80, 60),
    )
    color, depth_m = np.zeros((120, 160, 3), np.uint8), np.full((120, 160), 2.0, np.float32)
    sure = replace(region(0), score=0.9)
    for keyframe in (3, 4):
        place = color, depth_m, camera, {3: np.eye(4), 4: np.eye(4)}
        seen = regions.observe_keyframe(keyframe, [sure], *place)
        regions.answered(0, RegionLabelResult("tv", 0.4))
    (opinion,) = seen.opinions
    assert (opinion.label, opinion.sure) == ("tv", pytest.approx(0.4))


@pytest.mark.parametrize("is_heard", [True, False])
def test_who_is_not_heard_changes_nothing_about_boxes(is_heard: bool) -> None:
    naming = OpenVocabularyLabeling.unpack(
        asked_about(region(kind="standing")).pack(), is_heard=is_heard
    )
    naming.apply_label_result(
        0, 3, RegionLabelResult("cushion", 0.9), vocabulary := Vocabulary(256)
    )
    before = RegionDetections.none()
    color, depth_m = np.zeros((3, 120, 160), np.uint8), np.full((120, 160), 2.0, np.float32)
    camera = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
    view = TrainingView(4, camera, color, depth_m, np.eye(4))
    no_name, T = np.zeros((120, 160), bool), {3: np.eye(4), 4: np.eye(4)}
    claims, _ = naming.observe_keyframe(view, before, vocabulary, no_name, T)
    assert bool(len(claims.boxes)) == is_heard


def test_a_region_without_a_box_is_a_claim_of_its_own() -> None:
    claims, vocabulary = boxed("chair")
    named = add_region_labels(claims, [RegionLabel(region(), "globe", 0.8)], vocabulary, True)
    assert len(named.boxes) == 2
    assert (named.confidences[1], named.open_confidences[1]) == (0, np.float32(0.8))
    assert named.parts == (None, PART)


def asked_about(
    region: RegionProposal, *, is_remembered: bool = True, boxes: int = 0
) -> OpenVocabularyLabeling:
    """One question, of region 0 in keyframe 3, after a labeller was asked of it."""
    regions, camera = RegionTracker(), Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
    color, depth_m = np.zeros((120, 160, 3), np.uint8), np.full((120, 160), 2.0, np.float32)
    unboxed = replace(region, label="", score=0.0)
    for one in (unboxed, *[region] * boxes)[: None if is_remembered else 0]:
        regions.observe_keyframe(3, [one], color, depth_m, camera, {3: np.eye(4)})
    asked = [0, 3, region.box_px, *PART.pack(), region.label, region.score, region.kind]
    naming = OpenVocabularyLabeling.unpack({"regions": regions.pack(), "open": [asked]})
    assert naming.pack()["open"][0][-3:] == [region.label, region.score, region.kind]
    return naming


@pytest.mark.parametrize(
    ("kind", "sure", "of", "is_anew"),
    [
        ("standing", 0.6, {}, True),
        ("standing", 0.59, {}, False),
        ("apart", 0.9, {}, False),
        ("standing", 0.9, {"boxes": 1}, False),
        ("standing", 0.9, {"is_remembered": False}, False),
    ],
)
def test_what_stands_on_a_thing_was_taken_for_that_thing_before(
    kind: str, sure: float, of: dict, is_anew: bool
) -> None:
    """An answer that needs no second one tells it, where nothing was said of it before."""
    naming, vocabulary = asked_about(region(kind=kind), **of), Vocabulary(256)
    claims = naming.apply_label_result(0, 3, RegionLabelResult("cushion", sure), vocabulary)
    assert claims is not None
    assert claims.replaces_labels == is_anew
    assert claims.open_labels.tolist() == [vocabulary.index("cushion")]
    (part,) = claims.parts
    assert part is not None
    assert np.array_equal(part.mask, PART.mask)
    assert claims.where(np.array([True])).replaces_labels == is_anew
    again = naming.apply_label_result(0, 3, RegionLabelResult("cushion", sure), vocabulary)
    assert again is None, "nobody asks any more"


@pytest.mark.parametrize(
    ("answer", "known"),
    [
        (RegionLabelResult("clock", 0.5, (("wall", 0.3), ("fan", 0.2))), ("clock", "fan")),
        (RegionLabelResult("Wall", 0.9, (("fan", 0.1),)), ()),
        (RegionLabelResult("clock", 0.29, (("fan", 0.2),)), ()),
    ],
)
def test_what_is_no_object_is_no_name_and_what_is_said_unsurely_neither(
    answer: RegionLabelResult, known: tuple[str, ...]
) -> None:
    naming = asked_about(RegionProposal(BOX, PART))
    claims = naming.apply_label_result(0, 3, answer, Vocabulary(256))
    assert (claims is not None) == bool(known)
    (row,) = naming.pack()["regions"]["regions"]
    assert tuple(name for name, *_ in row["votes"]) == known


@pytest.mark.parametrize(
    ("second", "is_named"),
    [(RegionLabelResult("clock", 0.29), True), (RegionLabelResult("wall", 0.6), False)],
)
def test_an_unsure_answer_takes_no_name_away_and_that_it_is_no_object_does(
    second: RegionLabelResult, is_named: bool
) -> None:
    naming = asked_about(RegionProposal(BOX, PART))
    asked, vocabulary = naming.pack()["open"], Vocabulary(256)
    naming.apply_label_result(0, 3, RegionLabelResult("clock", 0.5), vocabulary)
    naming = OpenVocabularyLabeling.unpack({**naming.pack(), "open": asked})
    naming.apply_label_result(0, 3, second, vocabulary)
    (row,) = naming.pack()["regions"]["regions"]
    label, _, others = row["answer"]
    assert (label == "clock", len(others)) == (is_named, 0)
