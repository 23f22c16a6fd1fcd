"""Open-vocabulary labels of regions combined with the boxes of a detector."""

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
from ldo_service.regions.region import RegionLabel, RegionLabelResult
from ldo_service.regions.region_proposals import RegionProposal
from ldo_service.regions.region_tracker import RegionTracker
from ldo_service.regions.region_tracker_config import RegionTrackerConfig

PART = Foreground(10, 20, np.ones((30, 40), bool))
BOX = np.array([19.5, 9.5, 59.5, 39.5], np.float32)


def region(number: int | None = None, kind: str = "apart") -> RegionProposal:
    return RegionProposal(BOX, PART, "tv", 0.5, number, kind)


def detections_of(*names: str) -> tuple[RegionDetections, Vocabulary]:
    vocabulary = Vocabulary(256)
    labels = np.array([vocabulary.index(name) for name in names])
    boxes = np.tile(BOX, (len(names), 1))
    return RegionDetections.of_detector(
        boxes, labels, np.full(len(names), 0.5, np.float32)
    ), vocabulary


def test_boxes_are_matched_to_their_segmented_regions() -> None:
    found = [region(2), region(0, "flat"), region(1, ""), region(None)]
    assert match_boxes_to_regions(4, found) == (None, PART, PART, None)


def test_region_label_replaces_the_label_of_its_box() -> None:
    detections, vocabulary = detections_of("tv", "chair")
    named = add_region_labels(
        detections, [RegionLabel(region(0), "microwave", 0.9)], vocabulary, True
    )
    assert named.confidences.tolist() == [0, 0.5]
    assert named.open_labels[0] == vocabulary.index("microwave")
    assert named.open_confidences.tolist() == [np.float32(0.9), 0]
    assert detections.confidences.tolist() == [0.5, 0.5], "the input is not changed"


def test_without_box_votes_both_labels_are_kept_for_fusion() -> None:
    detections, vocabulary = detections_of("tv", "chair")
    named = add_region_labels(
        detections, [RegionLabel(region(0), "microwave", 0.9)], vocabulary, False
    )
    assert named.confidences.tolist() == [0.5, 0.5]
    assert named.labels.tolist() == detections.labels.tolist()
    assert named.open_labels[0] == vocabulary.index("microwave")
    assert named.open_confidences.tolist() == [np.float32(0.9), 0]


def test_without_box_votes_confidence_is_that_of_the_labeller() -> None:
    """A more confident box with the same label does not change this."""
    regions, camera = (
        RegionTracker(RegionTrackerConfig(boxes_vote=False)),
        Camera(160, 120, 120, 120, 80, 60),
    )
    color, depth_m = np.zeros((120, 160, 3), np.uint8), np.full((120, 160), 2.0, np.float32)
    confident_box = replace(region(0), score=0.9)
    for keyframe in (3, 4):
        place = color, depth_m, camera, {3: np.eye(4), 4: np.eye(4)}
        seen = regions.observe_keyframe(keyframe, [confident_box], *place)
        regions.answered(0, RegionLabelResult("tv", 0.4))
    (region_label,) = seen.region_labels
    assert (region_label.label, region_label.sure) == ("tv", pytest.approx(0.4))


@pytest.mark.parametrize("is_used", [True, False])
def test_labels_add_detections_only_if_used(is_used: bool) -> None:
    labeling = OpenVocabularyLabeling.unpack(
        requested(region(kind="standing")).pack(), is_fused=is_used
    )
    labeling.apply_label_result(
        0, 3, RegionLabelResult("cushion", 0.9), vocabulary := Vocabulary(256)
    )
    before = RegionDetections.none()
    color, depth_m = np.zeros((3, 120, 160), np.uint8), np.full((120, 160), 2.0, np.float32)
    camera = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
    view = TrainingView(4, camera, color, depth_m, np.eye(4))
    no_name, T = np.zeros((120, 160), bool), {3: np.eye(4), 4: np.eye(4)}
    detections, _ = labeling.observe_keyframe(view, before, vocabulary, no_name, T)
    assert bool(len(detections.boxes)) == is_used


def test_region_without_a_box_becomes_a_detection() -> None:
    detections, vocabulary = detections_of("chair")
    named = add_region_labels(detections, [RegionLabel(region(), "globe", 0.8)], vocabulary, True)
    assert len(named.boxes) == 2
    assert (named.confidences[1], named.open_confidences[1]) == (0, np.float32(0.8))
    assert named.parts == (None, PART)


def requested(
    region: RegionProposal, *, is_remembered: bool = True, boxes: int = 0
) -> OpenVocabularyLabeling:
    """Return a labeling with one open label request, for region 0 in keyframe 3."""
    regions, camera = RegionTracker(), Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
    color, depth_m = np.zeros((120, 160, 3), np.uint8), np.full((120, 160), 2.0, np.float32)
    unboxed = replace(region, label="", score=0.0)
    for proposal in (unboxed, *[region] * boxes)[: None if is_remembered else 0]:
        regions.observe_keyframe(3, [proposal], color, depth_m, camera, {3: np.eye(4)})
    request = [0, 3, region.box_px, *PART.pack(), region.label, region.score, region.kind]
    labeling = OpenVocabularyLabeling.unpack({"regions": regions.pack(), "open": [request]})
    assert labeling.pack()["open"][0][-3:] == [region.label, region.score, region.kind]
    return labeling


@pytest.mark.parametrize(
    ("kind", "confidence", "of", "replaces_labels"),
    [
        ("standing", 0.6, {}, True),
        ("standing", 0.59, {}, False),
        ("apart", 0.9, {}, False),
        ("standing", 0.9, {"boxes": 1}, False),
        ("standing", 0.9, {"is_remembered": False}, False),
    ],
)
def test_confident_label_of_a_standing_region_replaces_earlier_labels(
    kind: str, confidence: float, of: dict, replaces_labels: bool
) -> None:
    """A confident first label result of a standing region replaces the earlier labels."""
    labeling, vocabulary = requested(region(kind=kind), **of), Vocabulary(256)
    detections = labeling.apply_label_result(
        0, 3, RegionLabelResult("cushion", confidence), vocabulary
    )
    assert detections is not None
    assert detections.replaces_labels == replaces_labels
    assert detections.open_labels.tolist() == [vocabulary.index("cushion")]
    (part,) = detections.parts
    assert part is not None
    assert np.array_equal(part.mask, PART.mask)
    assert detections.where(np.array([True])).replaces_labels == replaces_labels
    repeated = labeling.apply_label_result(
        0, 3, RegionLabelResult("cushion", confidence), vocabulary
    )
    assert repeated is None, "the request is closed"


@pytest.mark.parametrize(
    ("result", "expected"),
    [
        (RegionLabelResult("clock", 0.5, (("wall", 0.3), ("fan", 0.2))), ("clock", "fan")),
        (RegionLabelResult("Wall", 0.9, (("fan", 0.1),)), ()),
        (RegionLabelResult("clock", 0.29, (("fan", 0.2),)), ()),
    ],
)
def test_structure_names_and_uncertain_names_are_ignored(
    result: RegionLabelResult, expected: tuple[str, ...]
) -> None:
    labeling = requested(RegionProposal(BOX, PART))
    detections = labeling.apply_label_result(0, 3, result, Vocabulary(256))
    assert (detections is not None) == bool(expected)
    (row,) = labeling.pack()["regions"]["regions"]
    assert tuple(name for name, *_ in row["votes"]) == expected


@pytest.mark.parametrize(
    ("second_result", "is_named"),
    [(RegionLabelResult("clock", 0.29), True), (RegionLabelResult("wall", 0.6), False)],
)
def test_structure_result_removes_a_name_but_uncertain_result_keeps_it(
    second_result: RegionLabelResult, is_named: bool
) -> None:
    labeling = requested(RegionProposal(BOX, PART))
    open_requests, vocabulary = labeling.pack()["open"], Vocabulary(256)
    labeling.apply_label_result(0, 3, RegionLabelResult("clock", 0.5), vocabulary)
    labeling = OpenVocabularyLabeling.unpack({**labeling.pack(), "open": open_requests})
    labeling.apply_label_result(0, 3, second_result, vocabulary)
    (row,) = labeling.pack()["regions"]["regions"]
    label, _, others = row["answer"]
    assert (label == "clock", len(others)) == (is_named, 0)
