"""Removal of dynamic classes from the map, also while they stand still."""

import numpy as np
import pytest

from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.geometry import RgbdFrame
from ldo_service.regions.foreground import RegionDetections
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.semantics.semantic_map import SemanticMap
from ldo_service.synthetic import SyntheticConfig, SyntheticSequence

MIDWAY = 70  # Index of the frame with the person in the middle of the path.
PERSON = Vocabulary().index("person")


def sequence(person: bool) -> SyntheticSequence:
    size = {"frames": 240, "width_px": 160, "height_px": 120}
    return SyntheticSequence(SyntheticConfig(**size, path="linger", person=person))


@pytest.fixture(scope="module")
def person() -> np.ndarray:
    """Return the mask [H, W] of the person."""
    return sequence(person=True).person(MIDWAY)


@pytest.fixture(scope="module")
def frame() -> RgbdFrame:
    return sequence(person=True)[MIDWAY]


@pytest.fixture(scope="module")
def empty_frame() -> RgbdFrame:
    """Return the same frame of the room without the person."""
    return sequence(person=False)[MIDWAY]


def detection_of(mask: np.ndarray, confidence: float) -> RegionDetections:
    v, u = np.nonzero(mask)
    box = np.array([[u.min(), v.min(), u.max(), v.max()]], np.float32)
    return RegionDetections.of_detector(box, np.array([PERSON]), np.array([confidence], np.float32))


def test_standing_person_is_removed_from_the_map(frame, empty_frame, person) -> None:
    builder = MapBuilder()
    semantics = SemanticMap(builder)
    builder.add(frame, np.eye(4), 0, 5)
    assert np.mean(builder.render_keyframe(0).opacity[person]) > 0.9
    semantics.add_detections(0, detection_of(person, 0.8))
    # Neighboring Gaussians extend one or two pixels into the mask.
    assert np.mean(builder.render_keyframe(0).opacity[person]) < 0.4
    assert not np.any(top_labels(builder.gaussians.labels) == PERSON)
    assert not len(semantics.objects)
    # The next keyframe maps the room behind, and the first image does not restore the person.
    builder.add(empty_frame, np.eye(4), 1, 10)
    off_m = np.abs(builder.render_keyframe(1).median_depth_m - empty_frame.depth_m)[person]
    assert np.median(off_m) < 0.02
    assert np.mean(off_m < 0.1) > 0.9


def test_removal_keeps_the_rest_of_the_image(frame, person) -> None:
    builder, untouched = MapBuilder(), MapBuilder()
    for mapper in (builder, untouched):
        mapper.add(frame, np.eye(4), 0, 5)
    SemanticMap(builder).add_detections(0, detection_of(person, 0.8))
    is_far = np.ones(person.shape, bool)
    v, u = np.nonzero(person)
    is_far[v.min() - 5 : v.max() + 6, u.min() - 5 : u.max() + 6] = False
    assert np.count_nonzero(is_far) > 10_000
    change = np.abs(builder.render_keyframe(0).color - untouched.render_keyframe(0).color)[is_far]
    assert np.quantile(change, 0.999) < 0.02


def test_detections_before_the_keyframe_give_an_equal_map(frame, person) -> None:
    maps = []
    for is_early in (False, True):
        builder = MapBuilder()
        semantics = SemanticMap(builder)
        if is_early:
            semantics.add_detections(0, detection_of(person, 0.8))
        builder.add(frame, np.eye(4), 0, 5)
        if is_early:
            semantics.on_keyframe_mapped(0)
        else:
            semantics.add_detections(0, detection_of(person, 0.8))
        assert semantics.metrics()["gaussians_dynamic_removed"] > 100
        maps.append(builder.gaussians.rows.tobytes())
    assert maps[0] == maps[1]


def test_uncertain_detection_removes_nothing(frame, person) -> None:
    builder = MapBuilder()
    builder.add(frame, np.eye(4), 0, 5)
    before = builder.gaussians.rows.tobytes()
    SemanticMap(builder).add_detections(0, detection_of(person, 0.4))
    assert builder.gaussians.rows.tobytes() == before
    assert np.any(top_labels(builder.gaussians.labels) == PERSON)
