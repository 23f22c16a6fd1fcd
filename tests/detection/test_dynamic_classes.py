"""Who may walk away is left out of the map, though nobody saw them move."""

import numpy as np
import pytest

from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.geometry import RgbdFrame
from ldo_service.regions.foreground import RegionDetections
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.semantics.semantic_map import SemanticMap
from ldo_service.synthetic import SyntheticConfig, SyntheticSequence

MIDWAY = 70  # the frame in which the person is in the middle of the way
PERSON = Vocabulary().index("person")


def sequence(person: bool) -> SyntheticSequence:
    size = {"frames": 240, "width_px": 160, "height_px": 120}
    return SyntheticSequence(SyntheticConfig(**size, path="linger", person=person))


@pytest.fixture(scope="module")
def person() -> np.ndarray:
    """[H, W] bool."""
    return sequence(person=True).person(MIDWAY)


@pytest.fixture(scope="module")
def frame() -> RgbdFrame:
    return sequence(person=True)[MIDWAY]


@pytest.fixture(scope="module")
def empty() -> RgbdFrame:
    """What the camera would see there of the room alone."""
    return sequence(person=False)[MIDWAY]


def around(mask: np.ndarray, confidence: float) -> RegionDetections:
    v, u = np.nonzero(mask)
    box = np.array([[u.min(), v.min(), u.max(), v.max()]], np.float32)
    return RegionDetections.of_detector(box, np.array([PERSON]), np.array([confidence], np.float32))


def test_a_person_who_stands_there_leaves_no_trace(frame, empty, person) -> None:
    builder = MapBuilder()
    semantics = SemanticMap(builder)
    builder.add(frame, np.eye(4), 0, 5)
    assert np.mean(builder.render_keyframe(0).opacity[person]) > 0.9
    semantics.add_detections(0, around(person, 0.8))
    assert (
        np.mean(builder.render_keyframe(0).opacity[person]) < 0.4
    )  # splats beside reach a pixel or two in
    assert not np.any(top_labels(builder.gaussians.labels) == PERSON)
    assert not len(semantics.objects)
    # the room behind comes when it is seen, and the old image does not draw the person again
    builder.add(empty, np.eye(4), 1, 10)
    off_m = np.abs(builder.render_keyframe(1).median_depth_m - empty.depth_m)[person]
    assert np.median(off_m) < 0.02
    assert np.mean(off_m < 0.1) > 0.9


def test_the_rest_of_the_image_stays(frame, person) -> None:
    builder, untouched = MapBuilder(), MapBuilder()
    for one in (builder, untouched):
        one.add(frame, np.eye(4), 0, 5)
    SemanticMap(builder).add_detections(0, around(person, 0.8))
    far = np.ones(person.shape, bool)
    v, u = np.nonzero(person)
    far[v.min() - 5 : v.max() + 6, u.min() - 5 : u.max() + 6] = False
    assert np.count_nonzero(far) > 10_000
    change = np.abs(builder.render_keyframe(0).color - untouched.render_keyframe(0).color)[far]
    assert np.quantile(change, 0.999) < 0.02


def test_boxes_that_come_first_leave_the_same_map(frame, person) -> None:
    maps = []
    for is_early in (False, True):
        builder = MapBuilder()
        semantics = SemanticMap(builder)
        if is_early:
            semantics.add_detections(0, around(person, 0.8))
        builder.add(frame, np.eye(4), 0, 5)
        if is_early:
            semantics.on_keyframe_mapped(0)
        else:
            semantics.add_detections(0, around(person, 0.8))
        assert semantics.metrics()["gaussians_dynamic_removed"] > 100
        maps.append(builder.gaussians.rows.tobytes())
    assert maps[0] == maps[1]


def test_a_doubtful_box_makes_no_hole(frame, person) -> None:
    builder = MapBuilder()
    builder.add(frame, np.eye(4), 0, 5)
    before = builder.gaussians.rows.tobytes()
    SemanticMap(builder).add_detections(0, around(person, 0.4))
    assert builder.gaussians.rows.tobytes() == before
    assert np.any(top_labels(builder.gaussians.labels) == PERSON)
