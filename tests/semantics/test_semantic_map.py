"""Boxes become labels of the map once their keyframe is there: once, and in any order."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError
from ldo_service.gaussians.map_builder import MapBuilder, MapBuilderConfig
from ldo_service.gaussians.visibility import OffloadConfig
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.regions.foreground import RegionDetections
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.semantics.semantic_fusion import SemanticFusionConfig
from ldo_service.semantics.semantic_map import SemanticMap, SemanticMapConfig
from ldo_service.storage.state_codec import decode_state, encode_state
from tests.gaussians.conftest import halved

FRAMES = (0, 6, 12, 18)
BY_BOX = SemanticMapConfig(SemanticFusionConfig(region="box"))
CHAIR, TABLE = 58, 62


@pytest.fixture(scope="module")
def posed(room: Sequence) -> list[tuple[RgbdFrame, np.ndarray]]:
    truth = room.truth()
    assert truth is not None
    return [(halved(halved(room[i])), truth.T_world_camera[i]) for i in FRAMES]


def built(posed, **options) -> MapBuilder:
    builder = MapBuilder(**options)
    for keyframe, (frame, T_map_camera) in enumerate(posed):
        builder.add(frame, T_map_camera, keyframe, 0)
    return builder


def claims(label: int = CHAIR) -> RegionDetections:
    """In the left half of an image of 80x60."""
    box, sure = np.array([[5.0, 5, 40, 55]], np.float32), np.array([0.8], np.float32)
    return RegionDetections.of_detector(box, np.array([label]), sure)


def labels_after(posed, order: Iterable[tuple[str, int]]) -> bytes:
    """Of the map, after keyframes were mapped ("map") and boxes came ("box") in that order."""
    builder = MapBuilder()
    semantics = SemanticMap(builder, BY_BOX)
    for what, keyframe in order:
        if what == "map":
            builder.add(*posed[keyframe], keyframe, 0)
            semantics.on_keyframe_mapped(keyframe)
        else:
            semantics.add_detections(keyframe, claims())
    return builder.gaussians.labels.tobytes()


def test_what_is_in_a_box_gets_its_label_and_the_rest_does_not(posed) -> None:
    builder = built(posed[:1])
    semantics = SemanticMap(builder, BY_BOX)
    semantics.add_detections(0, claims())
    frame, T_map_camera = posed[0]
    p_camera = se3.transform(se3.inverse(T_map_camera), builder.gaussians.means)
    u, v = frame.camera.project(p_camera).T
    inside = (u > 7) & (u < 38) & (v > 7) & (v < 53)
    outside = (u < 3) | (u > 42) | (v < 3) | (v > 57)
    top = top_labels(builder.gaussians.labels)
    assert np.mean(top[inside] == CHAIR) > 0.9
    assert np.mean(top[outside] == CHAIR) < 0.01
    assert semantics.metrics()["gaussians_labelled"] == np.count_nonzero(top)
    assert semantics.metrics()["label_disagreement_literal"] > 0


def test_where_depth_is_missing_the_map_knows_it(posed) -> None:
    """A dark screen that the second keyframe did not measure is labelled all the same."""
    frame, T_map_camera = posed[0]
    dark = frame.depth_m.copy()
    dark[5:56, 5:41] = 0
    builder = built([posed[0], (replace(frame, depth_m=dark), T_map_camera)])
    semantics = SemanticMap(builder, BY_BOX)
    semantics.add_detections(1, claims())
    p_camera = se3.transform(se3.inverse(T_map_camera), builder.gaussians.means)
    u, v = frame.camera.project(p_camera).T
    inside = (u > 7) & (u < 38) & (v > 7) & (v < 53)
    # what lies behind a rendered edge is off by more than the depth test allows
    assert np.mean(top_labels(builder.gaussians.labels)[inside] == CHAIR) > 0.6


def test_boxes_may_come_before_their_keyframe(posed) -> None:
    usual = [("map", 0), ("box", 0), ("map", 1), ("box", 1)]
    early = [("box", 0), ("map", 0), ("box", 1), ("map", 1)]
    assert labels_after(posed, early) == labels_after(posed, usual)


def test_boxes_that_come_again_count_once(posed) -> None:
    once = [("map", 0), ("box", 0)]
    assert labels_after(posed, [*once, ("box", 0)]) == labels_after(posed, once)
    assert labels_after(posed, [("box", 0), ("box", 0), ("map", 0)]) == labels_after(posed, once)


def test_few_boxes_wait_for_keyframes_that_never_come(posed) -> None:
    builder = built(posed[:1])
    semantics = SemanticMap(builder, replace(BY_BOX, most_waiting=2))
    for keyframe in (7, 8, 9):
        semantics.add_detections(keyframe, claims())
    assert semantics.metrics()["detections_too_early"] == 1
    assert [keyframe for keyframe, _ in semantics.snapshot()["waiting"]] == [8, 9]


def test_boxes_of_a_forgotten_keyframe_are_counted_and_left_out(posed) -> None:
    builder = built(posed[:2])
    semantics = SemanticMap(builder, BY_BOX)
    builder.views.store.keep_only([1])
    semantics.add_detections(0, claims())
    assert semantics.metrics()["boxes_without_images"] == 1
    assert not builder.gaussians.labels.any()


def test_late_boxes_find_gaussians_that_sleep(posed) -> None:
    frame, T_map_camera = posed[0]
    far = se3.exp(np.array([0, 0, 0, 50.0, 0, 0])) @ T_map_camera
    sleep = OffloadConfig(max_active=100, reach_m=8.0)
    builder = MapBuilder(MapBuilderConfig(sleep=sleep, recent_cameras=1))
    awake, semantics = built([(frame, T_map_camera), (frame, far)]), SemanticMap(builder, BY_BOX)
    for keyframe, T in enumerate((T_map_camera, far)):
        builder.add(frame, T, keyframe, 0)
    builder.changes(with_changed=True)
    builder.offload_excess()
    assert builder.metrics()["gaussians_offloaded"] > 100
    semantics.add_detections(0, claims())
    SemanticMap(awake, BY_BOX).add_detections(0, claims())
    assert builder.gaussians.labels.any()
    assert builder.gaussians.labels.tobytes() == awake.gaussians.labels.tobytes()


def test_only_gaussians_with_other_labels_are_told_again(posed) -> None:
    builder = built(posed[:1])
    semantics = SemanticMap(builder, BY_BOX)
    builder.changes(with_changed=True)
    before = builder.gaussians.labels.copy()
    semantics.add_detections(0, claims())
    is_new = np.any(builder.gaussians.labels != before, axis=1)
    assert np.count_nonzero(is_new) > 100
    changed = builder.changes(with_changed=True).changed
    assert changed.tolist() == np.flatnonzero(is_new).tolist()


def test_labels_leave_what_the_map_looks_like(posed) -> None:
    plain, labelled = MapBuilder(), MapBuilder()
    semantics = SemanticMap(labelled, BY_BOX)
    for keyframe, (frame, T_map_camera) in enumerate(posed):
        for builder in (plain, labelled):
            builder.add(frame, T_map_camera, keyframe, 3)
        semantics.add_detections(keyframe, claims())
    assert labelled.gaussians.labels.any()
    assert labelled.gaussians.rows.tobytes() == plain.gaussians.rows.tobytes()


@pytest.mark.parametrize("threads", [2, 3])
def test_any_number_of_threads_gives_the_same_bits(posed, threads: int) -> None:
    one, many = built(posed), built(posed, threads=threads)
    for builder, count in ((one, 1), (many, threads)):
        semantics = SemanticMap(builder, threads=count)
        for keyframe in range(len(posed)):
            semantics.add_detections(keyframe, claims())
    assert one.gaussians.labels.any()
    assert one.gaussians.labels.tobytes() == many.gaussians.labels.tobytes()


def test_a_successor_goes_on_with_labels_names_and_what_waits(posed, tmp_path: Path) -> None:
    builder = built(posed[:2], folder=tmp_path)
    semantics = SemanticMap(builder, BY_BOX)
    lamp = semantics.vocabulary.index("lava lamp")
    semantics.add_detections(0, claims(lamp))
    semantics.add_detections(2, claims(TABLE))
    state = decode_state(encode_state([builder.snapshot(), semantics.snapshot()]))
    successor = MapBuilder(folder=tmp_path)
    its_semantics = SemanticMap(successor, BY_BOX)
    successor.restore(state[0])
    its_semantics.restore(state[1])
    for one, labels in ((builder, semantics), (successor, its_semantics)):
        one.add(*posed[2], 2, 0)
        labels.on_keyframe_mapped(2)
        labels.add_detections(0, claims())
    assert its_semantics.vocabulary.find("lava lamp") == lamp
    assert set(top_labels(builder.gaussians.labels)) == {0, lamp, TABLE}
    assert builder.gaussians.labels.tobytes() == successor.gaussians.labels.tobytes()


def test_settings_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ConfigError, match="most_waiting"):
        SemanticMapConfig(most_waiting=-1)
    with pytest.raises(ConfigError, match="most_names"):
        SemanticMapConfig(most_names=257)
