"""Semantic fusion on a wall with an object in front, with one Gaussian per pixel."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.gaussians import render
from ldo_service.gaussians.rows import aligned_rows
from ldo_service.geometry import Camera
from ldo_service.regions.foreground import Foreground, RegionDetections
from ldo_service.semantics.gaussian_labels import LabelConfig, fields, new_labels, top_labels
from ldo_service.semantics.label_assignment import AssignmentConfig, Regions
from ldo_service.semantics.semantic_fusion import (
    FusionConfig,
    SemanticFusionConfig,
    fuse_detections,
    label_image,
    regions_of,
    reliable_label_mask,
)

from .scenes import NO_DETECTIONS

CAMERA = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
OBJECT = slice(20, 44), slice(36, 60)
BOX = np.array([[30.0, 14.0, 66.0, 50.0]])  # Six pixels larger on each side.
CHAIR, LAMP = 58, 90


def depth_image() -> np.ndarray:
    depth_m = np.full((64, 96), 2.0, np.float32)
    depth_m[OBJECT] = 1.2
    return depth_m


def pixel_gaussians() -> np.ndarray:
    """Return the rows of one small, opaque Gaussian per pixel."""
    depth_m = depth_image()
    rows = aligned_rows(depth_m.size)
    rows[:] = 0
    rows[:, :3] = CAMERA.backproject(depth_m).reshape(-1, 3)
    rows[:, 3:6] = np.log(0.5 * depth_m.reshape(-1, 1) / CAMERA.fx)
    rows[:, 6], rows[:, 10] = 1, 3
    return rows


def object_mask() -> np.ndarray:
    out = np.zeros((64, 96), bool)
    out[OBJECT] = True
    return out


def detections(detector: float = 0.8, labeller: float = 0.0) -> RegionDetections:
    labels = np.array([CHAIR]), np.array([detector], np.float32)
    return RegionDetections(BOX, *labels, np.array([LAMP]), np.array([labeller], np.float32))


def labelled(
    config: SemanticFusionConfig, *batches: RegionDetections, late: RegionDetections | None = None
) -> tuple[np.ndarray, np.ndarray]:
    rows = pixel_gaussians()
    labels, indices = new_labels(len(rows)), np.arange(len(rows), dtype=np.uint32)
    view = CAMERA, np.eye(4), depth_image()
    for batch in batches:
        fuse_detections(rows, labels, indices, *view, batch, config)
    if late is not None:
        fuse_detections(rows, labels, indices, *view, late, config, is_late=True)
    return rows, labels


def test_foreground_gets_label_and_wall_in_the_box_does_not() -> None:
    _, labels = labelled(SemanticFusionConfig(), detections())
    got = (top_labels(labels) == CHAIR).reshape(64, 96)
    assert np.mean(got[object_mask()]) > 0.95
    assert np.count_nonzero(got & ~object_mask()) < 0.02 * np.count_nonzero(object_mask())


def test_replacing_label_result_overrides_earlier_detections() -> None:
    """Ten detections of a chair, then a label result for an object on it."""
    before = [detections()] * 10
    late = detections(0, 0.9)
    for replaces_labels, label, weight in ((False, CHAIR, 0.15), (True, LAMP, 1.0)):
        _, labels = labelled(
            SemanticFusionConfig(), *before, late=replace(late, replaces_labels=replaces_labels)
        )
        before_late = fields(labelled(SemanticFusionConfig(), *before)[1])
        of_object = fields(labels)[object_mask().ravel()]
        assert np.mean(top_labels(labels)[object_mask().ravel()] == label) > 0.95
        weights = np.where(of_object["ids"] == LAMP, of_object["weights"], 0).sum(axis=1)
        assert np.median(weights) == pytest.approx(weight, abs=0.05)
        # The labels of the wall stay.
        wall = ~object_mask().ravel() & (top_labels(labels) != LAMP)
        assert np.array_equal(fields(labels)["weights"][wall], before_late["weights"][wall])


def test_box_region_labels_the_wall_too() -> None:
    _, labels = labelled(SemanticFusionConfig(region="box"), detections())
    got = (top_labels(labels) == CHAIR).reshape(64, 96)
    assert np.count_nonzero(got) > 2 * np.count_nonzero(object_mask())


def test_iou_rule_labels_no_small_gaussians() -> None:
    config = SemanticFusionConfig(assignment=AssignmentConfig("iou"))
    _, labels = labelled(config, detections())
    assert not top_labels(labels).any()


@pytest.mark.parametrize(("rule", "expected"), [("adaptive", LAMP), ("detector", CHAIR)])
def test_labeller_overrides_detector_only_with_adaptive_rule(rule, expected) -> None:
    config = SemanticFusionConfig(fusion=FusionConfig(rule=rule))
    _, labels = labelled(config, detections(detector=0.3, labeller=0.9))
    assert np.median(top_labels(labels).reshape(64, 96)[OBJECT]) == expected


def test_late_label_result_labels_object_without_counting_misses() -> None:
    _, once = labelled(SemanticFusionConfig(), detections(detector=0.3))
    _, labels = labelled(
        SemanticFusionConfig(),
        detections(detector=0.3),
        late=detections(detector=0.0, labeller=0.9),
    )
    assert np.median(top_labels(labels).reshape(64, 96)[OBJECT]) == LAMP
    outside = ~object_mask().ravel()
    np.testing.assert_array_equal(
        fields(labels)["misses"][outside], fields(once)["misses"][outside]
    )


def test_late_label_result_below_detector_weight_changes_nothing() -> None:
    confident, uncertain = detections(detector=0.9), detections(detector=0.9, labeller=0.3)
    _, once = labelled(SemanticFusionConfig(), confident)
    _, labels = labelled(SemanticFusionConfig(), confident, late=uncertain)
    np.testing.assert_array_equal(labels, once)


def test_only_requested_pixels_are_labelled() -> None:
    upper = Foreground(20, 36, np.ones((10, 24), bool))
    _, labels = labelled(SemanticFusionConfig(), replace(detections(0, 0.9), parts=(upper,)))
    got = (top_labels(labels) == LAMP).reshape(64, 96)
    assert np.mean(got[20:30, 36:60]) > 0.9
    assert not got[32:].any()


def test_detector_rule_ignores_regions_of_the_labeller() -> None:
    rule, ema = FusionConfig(rule="detector"), LabelConfig(ema="paper")
    _, labels = labelled(SemanticFusionConfig(fusion=rule, labels=ema), detections(0, 0.9))
    assert not labels[object_mask().ravel()].any()


def test_labels_unknown_to_the_detector_are_not_missed() -> None:
    config = SemanticFusionConfig(labels=LabelConfig(min_px=20))
    rows, labels = labelled(config, late=detections(0, 0.9))
    at = np.arange(len(rows), dtype=np.uint32), CAMERA, np.eye(4), depth_image()
    lamps, undetectable = labels.copy(), np.zeros(256, bool)
    undetectable[LAMP] = True
    for _ in range(9):
        fuse_detections(rows, lamps, *at, NO_DETECTIONS, config, undetectable=undetectable)
        fuse_detections(rows, labels, *at, NO_DETECTIONS, config)
    assert np.mean(top_labels(lamps).reshape(64, 96)[object_mask()] == LAMP) > 0.9
    assert not top_labels(labels).any(), "a class that the detector knows can be missed"


def test_reliable_label_mask_follows_weight_of_front_gaussian() -> None:
    labels, top = new_labels(3), np.array([[0, 1], [2, -1]])
    fields(labels)["weights"][:2, 0], fields(labels)["ids"][:2, 0] = [0.7, 0.5], CHAIR
    assert reliable_label_mask(labels, top, 0.6).tolist() == [[True, False], [False, False]]


def test_keyframe_without_detections_counts_misses_in_view() -> None:
    _, labels = labelled(SemanticFusionConfig(), NO_DETECTIONS)
    assert np.all(fields(labels)["misses"] == 1)


def test_non_finite_gaussians_are_not_labelled() -> None:
    rows, config = pixel_gaussians(), SemanticFusionConfig()
    broken = np.flatnonzero(object_mask())[::7]
    rows[broken, 2] = np.nan
    labels, indices = new_labels(len(rows)), np.arange(len(rows), dtype=np.uint32)
    fuse_detections(rows, labels, indices, CAMERA, np.eye(4), depth_image(), detections(), config)
    is_chair = top_labels(labels) == CHAIR
    assert not is_chair[broken].any()
    assert np.mean(is_chair[np.setdiff1d(np.flatnonzero(object_mask()), broken)]) > 0.95


def test_label_image_shows_the_object() -> None:
    rows, labels = labelled(SemanticFusionConfig(), detections())
    shown = render(rows, CAMERA, np.eye(4), contributions=True)
    image = label_image(rows, labels, shown, CAMERA, np.eye(4))
    agreement = np.count_nonzero((image == CHAIR) & object_mask())
    # Gaussians cover one pixel beyond the edge.
    assert agreement > 0.8 * np.count_nonzero((image == CHAIR) | object_mask())


def test_label_image_uses_largest_weight_sum_not_nearest_gaussian() -> None:
    """Three Gaussians on a ray, each with a fourth to a third of the weight; the last two agree."""
    rows, labels = aligned_rows(3), new_labels(3)
    rows[:] = 0
    rows[:, 2], rows[:, 3:6], rows[:, 6] = [1, 1.1, 1.2], -1, 1
    alphas = np.array([0.3, 0.35, 0.5])  # Blending weights 0.3, 0.245 and 0.2275.
    rows[:, 10] = np.log(alphas / (1 - alphas))
    fields(labels)["weights"][:, 0], fields(labels)["ids"][:, 0] = 1, [CHAIR, LAMP, LAMP]
    shown = render(rows, CAMERA, np.eye(4), contributions=True)
    assert shown.contributions is not None
    assert shown.contributions.top[31, 47] == 0, "the chair"
    assert label_image(rows, labels, shown, CAMERA, np.eye(4))[31, 47] == LAMP


def test_earlier_misses_do_not_delay_a_label_unknown_to_the_detector() -> None:
    """Ten keyframes of misses have the weight of two label results of 0.9."""
    config = SemanticFusionConfig(labels=LabelConfig(min_px=1))
    rows, labels = labelled(config, *[NO_DETECTIONS] * 10)
    view = np.arange(len(rows), dtype=np.uint32), CAMERA, np.eye(4), depth_image()
    undetectable, known = np.zeros(256, bool), labels.copy()
    undetectable[LAMP] = True
    for undetectable_labels, fused in ((undetectable, labels), (None, known)):
        late = detections(0, 0.9)
        fuse_detections(
            rows, fused, *view, late, config, is_late=True, undetectable=undetectable_labels
        )
    assert np.mean(top_labels(labels).reshape(64, 96)[object_mask()] == LAMP) > 0.9
    assert not top_labels(known).any(), "a class that the detector knows was missed"


def test_nested_object_is_cut_from_the_region_below_it() -> None:
    table, cup = (Foreground(20, 36, np.ones(shape, bool)) for shape in ((24, 24), (6, 6)))
    boxes = np.array([[35.5, 19.5, 59.5, 43.5], [35.5, 19.5, 41.5, 25.5]])
    both = RegionDetections.of_detector(
        boxes, np.array([CHAIR, LAMP]), np.array([0.9, 0.7], np.float32)
    )
    regions = regions_of(
        replace(both, parts=(table, cup)), depth_image(), CAMERA, SemanticFusionConfig()
    )
    table.mask[:6, :6] = False
    expected = Regions.of_foregrounds(boxes, both.scores(), (table, cup))
    np.testing.assert_array_equal(regions.sums, expected.sums)
