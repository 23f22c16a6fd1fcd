"""A wall with a thing before it, as Gaussians of one pixel each."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.gaussians import render
from ldo_service.gaussians.model import aligned_rows
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

CAMERA = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
THING = slice(20, 44), slice(36, 60)
BOX = np.array([[30.0, 14.0, 66.0, 50.0]])  # six pixels larger on each side
CHAIR, LAMP = 58, 90


def depth_image() -> np.ndarray:
    depth_m = np.full((64, 96), 2.0, np.float32)
    depth_m[THING] = 1.2
    return depth_m


def surfels() -> np.ndarray:
    """One per pixel, sharp and opaque."""
    depth_m = depth_image()
    rows = aligned_rows(depth_m.size)
    rows[:] = 0
    rows[:, :3] = CAMERA.backproject(depth_m).reshape(-1, 3)
    rows[:, 3:6] = np.log(0.5 * depth_m.reshape(-1, 1) / CAMERA.fx)
    rows[:, 6], rows[:, 10] = 1, 3
    return rows


def thing() -> np.ndarray:
    out = np.zeros((64, 96), bool)
    out[THING] = True
    return out


def claims(detector: float = 0.8, labeller: float = 0.0) -> RegionDetections:
    labels = np.array([CHAIR]), np.array([detector], np.float32)
    return RegionDetections(BOX, *labels, np.array([LAMP]), np.array([labeller], np.float32))


def labelled(
    config: SemanticFusionConfig, *what: RegionDetections, late: RegionDetections | None = None
) -> tuple[np.ndarray, np.ndarray]:
    rows = surfels()
    labels, indices = new_labels(len(rows)), np.arange(len(rows), dtype=np.uint32)
    view = CAMERA, np.eye(4), depth_image()
    for claim in what:
        fuse_detections(rows, labels, indices, *view, claim, config)
    if late is not None:
        fuse_detections(rows, labels, indices, *view, late, config, is_late=True)
    return rows, labels


def test_the_thing_gets_the_label_and_the_wall_in_its_box_does_not() -> None:
    _, labels = labelled(SemanticFusionConfig(), claims())
    got = (top_labels(labels) == CHAIR).reshape(64, 96)
    assert np.mean(got[thing()]) > 0.95
    assert np.count_nonzero(got & ~thing()) < 0.02 * np.count_nonzero(thing())


def test_what_is_said_anew_stands_alone() -> None:
    """Ten boxes of a chair, and an answer about what stands on it."""
    before = [claims()] * 10
    late = claims(0, 0.9)
    for anew, label, share in ((False, CHAIR, 0.15), (True, LAMP, 1.0)):
        _, labels = labelled(
            SemanticFusionConfig(), *before, late=replace(late, replaces_labels=anew)
        )
        was = fields(labelled(SemanticFusionConfig(), *before)[1])
        of_thing = fields(labels)[thing().ravel()]
        assert np.mean(top_labels(labels)[thing().ravel()] == label) > 0.95
        shares = np.where(of_thing["ids"] == LAMP, of_thing["weights"], 0).sum(axis=1)
        assert np.median(shares) == pytest.approx(share, abs=0.05)
        # the wall keeps what it had
        wall = ~thing().ravel() & (top_labels(labels) != LAMP)
        assert np.array_equal(fields(labels)["weights"][wall], was["weights"][wall])


def test_by_box_the_wall_becomes_chair_too() -> None:
    _, labels = labelled(SemanticFusionConfig(region="box"), claims())
    got = (top_labels(labels) == CHAIR).reshape(64, 96)
    assert np.count_nonzero(got) > 2 * np.count_nonzero(thing())


def test_the_literal_rule_labels_nothing_here() -> None:
    config = SemanticFusionConfig(assignment=AssignmentConfig("iou"))
    _, labels = labelled(config, claims())
    assert not top_labels(labels).any()


@pytest.mark.parametrize(("rule", "wins"), [("adaptive", LAMP), ("detector", CHAIR)])
def test_a_surer_labeller_overrules_the_detector_where_it_is_heard(rule, wins) -> None:
    config = SemanticFusionConfig(fusion=FusionConfig(rule=rule))
    _, labels = labelled(config, claims(detector=0.3, labeller=0.9))
    assert np.median(top_labels(labels).reshape(64, 96)[THING]) == wins


def test_a_late_answer_lands_on_the_thing_and_misses_nothing_else() -> None:
    _, once = labelled(SemanticFusionConfig(), claims(detector=0.3))
    _, labels = labelled(
        SemanticFusionConfig(), claims(detector=0.3), late=claims(detector=0.0, labeller=0.9)
    )
    assert np.median(top_labels(labels).reshape(64, 96)[THING]) == LAMP
    outside = ~thing().ravel()
    np.testing.assert_array_equal(
        fields(labels)["misses"][outside], fields(once)["misses"][outside]
    )


def test_a_late_answer_that_the_detector_outweighs_is_not_counted_again() -> None:
    sure, doubt = claims(detector=0.9), claims(detector=0.9, labeller=0.3)
    _, once = labelled(SemanticFusionConfig(), sure)
    _, labels = labelled(SemanticFusionConfig(), sure, late=doubt)
    np.testing.assert_array_equal(labels, once)


def test_pixels_that_were_asked_about_are_labelled_whatever_else_is_in_the_box() -> None:
    upper = Foreground(20, 36, np.ones((10, 24), bool))
    _, labels = labelled(SemanticFusionConfig(), replace(claims(0, 0.9), parts=(upper,)))
    got = (top_labels(labels) == LAMP).reshape(64, 96)
    assert np.mean(got[20:30, 36:60]) > 0.9
    assert not got[32:].any()


def test_by_the_detector_alone_what_only_the_labeller_says_is_not_heard() -> None:
    rule, ema = FusionConfig(rule="detector"), LabelConfig(ema="paper")
    _, labels = labelled(SemanticFusionConfig(fusion=rule, labels=ema), claims(0, 0.9))
    assert not labels[thing().ravel()].any()


def test_a_detector_cannot_miss_what_it_does_not_know() -> None:
    config = SemanticFusionConfig(labels=LabelConfig(least_px=20))
    rows, labels = labelled(config, late=claims(0, 0.9))
    at = np.arange(len(rows), dtype=np.uint32), CAMERA, np.eye(4), depth_image()
    nothing = RegionDetections.of_detector(
        np.zeros((0, 4)), np.zeros(0, int), np.zeros(0, np.float32)
    )
    lamps, spared = labels.copy(), np.zeros(256, bool)
    spared[LAMP] = True
    for _ in range(9):
        fuse_detections(rows, lamps, *at, nothing, config, spared=spared)
        fuse_detections(rows, labels, *at, nothing, config)
    assert np.mean(top_labels(lamps).reshape(64, 96)[thing()] == LAMP) > 0.9
    assert not top_labels(labels).any(), "what it knows, it can miss"


def test_a_pixel_has_a_reliable_name_where_its_gaussian_has() -> None:
    labels, top = new_labels(3), np.array([[0, 1], [2, -1]])
    fields(labels)["weights"][:2, 0], fields(labels)["ids"][:2, 0] = [0.7, 0.5], CHAIR
    assert reliable_label_mask(labels, top, 0.6).tolist() == [[True, False], [False, False]]


def test_a_keyframe_without_claims_counts_misses_of_what_is_in_view() -> None:
    none = RegionDetections.of_detector(np.zeros((0, 4)), np.zeros(0, int), np.zeros(0, np.float32))
    _, labels = labelled(SemanticFusionConfig(), none)
    assert np.all(fields(labels)["misses"] == 1)


def test_gaussians_that_are_not_finite_stay_without_a_label() -> None:
    rows, config = surfels(), SemanticFusionConfig()
    broken = np.flatnonzero(thing())[::7]
    rows[broken, 2] = np.nan
    labels, indices = new_labels(len(rows)), np.arange(len(rows), dtype=np.uint32)
    fuse_detections(rows, labels, indices, CAMERA, np.eye(4), depth_image(), claims(), config)
    is_chair = top_labels(labels) == CHAIR
    assert not is_chair[broken].any()
    assert np.mean(is_chair[np.setdiff1d(np.flatnonzero(thing()), broken)]) > 0.95


def test_an_image_of_labels_shows_the_thing() -> None:
    rows, labels = labelled(SemanticFusionConfig(), claims())
    shown = render(rows, CAMERA, np.eye(4), contributions=True)
    image = label_image(rows, labels, shown, CAMERA, np.eye(4))
    agreement = np.count_nonzero((image == CHAIR) & thing())
    # splats reach a pixel over the edge
    assert agreement > 0.8 * np.count_nonzero((image == CHAIR) | thing())


def test_an_image_of_labels_is_of_the_largest_sum_not_of_the_nearest_gaussian() -> None:
    """Three in a row, each of a fourth to a third of the pixel; the two behind agree."""
    rows, labels = aligned_rows(3), new_labels(3)
    rows[:] = 0
    rows[:, 2], rows[:, 3:6], rows[:, 6] = [1, 1.1, 1.2], -1, 1
    alphas = np.array([0.3, 0.35, 0.5])  # weights 0.3, 0.245, 0.2275
    rows[:, 10] = np.log(alphas / (1 - alphas))
    fields(labels)["weights"][:, 0], fields(labels)["ids"][:, 0] = 1, [CHAIR, LAMP, LAMP]
    shown = render(rows, CAMERA, np.eye(4), contributions=True)
    assert shown.contributions is not None
    assert shown.contributions.top[31, 47] == 0, "the chair"
    assert label_image(rows, labels, shown, CAMERA, np.eye(4))[31, 47] == LAMP


def test_a_name_the_detector_cannot_know_is_not_held_back_by_what_it_missed() -> None:
    """Ten keyframes of misses are worth 2 answers of 0.9."""
    nothing = RegionDetections.of_detector(
        np.zeros((0, 4)), np.zeros(0, int), np.zeros(0, np.float32)
    )
    config = SemanticFusionConfig(labels=LabelConfig(least_px=1))
    rows, labels = labelled(config, *[nothing] * 10)
    view = np.arange(len(rows), dtype=np.uint32), CAMERA, np.eye(4), depth_image()
    spared, known = np.zeros(256, bool), labels.copy()
    spared[LAMP] = True
    for told, which in ((spared, labels), (None, known)):
        said = claims(0, 0.9)
        fuse_detections(rows, which, *view, said, config, is_late=True, spared=told)
    assert np.mean(top_labels(labels).reshape(64, 96)[thing()] == LAMP) > 0.9
    assert not top_labels(known).any(), "what it knows, it did miss"


def test_what_lies_on_a_thing_is_no_part_of_its_region() -> None:
    table, cup = (Foreground(20, 36, np.ones(shape, bool)) for shape in ((24, 24), (6, 6)))
    boxes = np.array([[35.5, 19.5, 59.5, 43.5], [35.5, 19.5, 41.5, 25.5]])
    told = RegionDetections.of_detector(
        boxes, np.array([CHAIR, LAMP]), np.array([0.9, 0.7], np.float32)
    )
    regions = regions_of(
        replace(told, parts=(table, cup)), depth_image(), CAMERA, SemanticFusionConfig()
    )
    table.mask[:6, :6] = False
    expected = Regions.of_foregrounds(boxes, told.scores(), (table, cup))
    np.testing.assert_array_equal(regions.sums, expected.sums)
