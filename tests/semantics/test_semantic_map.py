"""Labels of the map from detections that arrive before or after their keyframes."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
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
def posed_frames(room: Sequence) -> list[tuple[RgbdFrame, np.ndarray]]:
    truth = room.truth()
    assert truth is not None
    return [(halved(halved(room[i])), truth.T_world_camera[i]) for i in FRAMES]


def build_map(posed_frames, **options) -> MapBuilder:
    builder = MapBuilder(**options)
    for keyframe, (frame, T_map_camera) in enumerate(posed_frames):
        builder.add(frame, T_map_camera, keyframe, 0)
    return builder


def detections(label: int = CHAIR) -> RegionDetections:
    """Return one detection in the left half of an image of 80x60."""
    box, scores = np.array([[5.0, 5, 40, 55]], np.float32), np.array([0.8], np.float32)
    return RegionDetections.of_detector(box, np.array([label]), scores)


def labels_after(posed_frames, order: Iterable[tuple[str, int]]) -> bytes:
    """Return the labels after events in this order: keyframe mapped ("map"), detections ("box")."""
    builder = MapBuilder()
    semantics = SemanticMap(builder, BY_BOX)
    for event, keyframe in order:
        if event == "map":
            builder.add(*posed_frames[keyframe], keyframe, 0)
            semantics.on_keyframe_mapped(keyframe)
        else:
            semantics.add_detections(keyframe, detections())
    return builder.gaussians.labels.tobytes()


def test_only_gaussians_in_the_box_get_its_label(posed_frames) -> None:
    builder = build_map(posed_frames[:1])
    semantics = SemanticMap(builder, BY_BOX)
    semantics.add_detections(0, detections())
    frame, T_map_camera = posed_frames[0]
    p_camera = se3.transform(se3.inverse(T_map_camera), builder.gaussians.means)
    u, v = frame.camera.project(p_camera).T
    inside = (u > 7) & (u < 38) & (v > 7) & (v < 53)
    outside = (u < 3) | (u > 42) | (v < 3) | (v > 57)
    top = top_labels(builder.gaussians.labels)
    assert np.mean(top[inside] == CHAIR) > 0.9
    assert np.mean(top[outside] == CHAIR) < 0.01
    assert semantics.metrics()["gaussians_labelled"] == np.count_nonzero(top)
    assert semantics.metrics()["label_disagreement_literal"] > 0


def test_gaussians_are_labelled_where_the_keyframe_has_no_depth(posed_frames) -> None:
    """The second keyframe has no depth in the box, as on a dark screen."""
    frame, T_map_camera = posed_frames[0]
    dark = frame.depth_m.copy()
    dark[5:56, 5:41] = 0
    builder = build_map([posed_frames[0], (replace(frame, depth_m=dark), T_map_camera)])
    semantics = SemanticMap(builder, BY_BOX)
    semantics.add_detections(1, detections())
    p_camera = se3.transform(se3.inverse(T_map_camera), builder.gaussians.means)
    u, v = frame.camera.project(p_camera).T
    inside = (u > 7) & (u < 38) & (v > 7) & (v < 53)
    # Gaussians behind a rendered edge differ by more than the depth test allows.
    assert np.mean(top_labels(builder.gaussians.labels)[inside] == CHAIR) > 0.6


def test_detections_before_their_keyframe_give_equal_labels(posed_frames) -> None:
    in_order = [("map", 0), ("box", 0), ("map", 1), ("box", 1)]
    early = [("box", 0), ("map", 0), ("box", 1), ("map", 1)]
    assert labels_after(posed_frames, early) == labels_after(posed_frames, in_order)


def test_repeated_detections_count_once(posed_frames) -> None:
    once = [("map", 0), ("box", 0)]
    assert labels_after(posed_frames, [*once, ("box", 0)]) == labels_after(posed_frames, once)
    assert labels_after(posed_frames, [("box", 0), ("box", 0), ("map", 0)]) == labels_after(
        posed_frames, once
    )


def test_detections_waiting_for_keyframes_are_bounded(posed_frames) -> None:
    builder = build_map(posed_frames[:1])
    semantics = SemanticMap(builder, replace(BY_BOX, max_waiting=2))
    for keyframe in (7, 8, 9):
        semantics.add_detections(keyframe, detections())
    assert semantics.metrics()["detections_too_early"] == 1
    assert [keyframe for keyframe, _ in semantics.snapshot()["waiting"]] == [8, 9]


def test_detections_of_removed_keyframe_are_counted_and_dropped(posed_frames) -> None:
    builder = build_map(posed_frames[:2])
    semantics = SemanticMap(builder, BY_BOX)
    builder.views.store.keep_only([1])
    semantics.add_detections(0, detections())
    assert semantics.metrics()["boxes_without_images"] == 1
    assert not builder.gaussians.labels.any()


def test_late_detections_label_offloaded_gaussians(posed_frames) -> None:
    frame, T_map_camera = posed_frames[0]
    far_pose = se3.exp(np.array([0, 0, 0, 50.0, 0, 0])) @ T_map_camera
    offload = OffloadConfig(max_active=100, reach_m=8.0)
    builder = MapBuilder(MapBuilderConfig(offload=offload, recent_cameras=1))
    resident = build_map([(frame, T_map_camera), (frame, far_pose)])
    semantics = SemanticMap(builder, BY_BOX)
    for keyframe, T in enumerate((T_map_camera, far_pose)):
        builder.add(frame, T, keyframe, 0)
    builder.changes(with_changed=True)
    builder.offload_excess()
    assert builder.metrics()["gaussians_offloaded"] > 100
    semantics.add_detections(0, detections())
    SemanticMap(resident, BY_BOX).add_detections(0, detections())
    assert builder.gaussians.labels.any()
    assert builder.gaussians.labels.tobytes() == resident.gaussians.labels.tobytes()


def test_only_gaussians_with_changed_labels_are_marked_changed(posed_frames) -> None:
    builder = build_map(posed_frames[:1])
    semantics = SemanticMap(builder, BY_BOX)
    builder.changes(with_changed=True)
    before = builder.gaussians.labels.copy()
    semantics.add_detections(0, detections())
    is_new = np.any(builder.gaussians.labels != before, axis=1)
    assert np.count_nonzero(is_new) > 100
    changed = builder.changes(with_changed=True).changed
    assert changed.tolist() == np.flatnonzero(is_new).tolist()


def test_labels_do_not_change_gaussian_rows(posed_frames) -> None:
    plain, labelled = MapBuilder(), MapBuilder()
    semantics = SemanticMap(labelled, BY_BOX)
    for keyframe, (frame, T_map_camera) in enumerate(posed_frames):
        for builder in (plain, labelled):
            builder.add(frame, T_map_camera, keyframe, 3)
        semantics.add_detections(keyframe, detections())
    assert labelled.gaussians.labels.any()
    assert labelled.gaussians.rows.tobytes() == plain.gaussians.rows.tobytes()


@pytest.mark.parametrize("threads", [2, 3])
def test_labels_are_bitwise_equal_for_any_thread_count(posed_frames, threads: int) -> None:
    one, many = build_map(posed_frames), build_map(posed_frames, threads=threads)
    for builder, count in ((one, 1), (many, threads)):
        semantics = SemanticMap(builder, threads=count)
        for keyframe in range(len(posed_frames)):
            semantics.add_detections(keyframe, detections())
    assert one.gaussians.labels.any()
    assert one.gaussians.labels.tobytes() == many.gaussians.labels.tobytes()


def test_restored_map_continues_with_labels_names_and_waiting_detections(
    posed_frames, tmp_path: Path
) -> None:
    builder = build_map(posed_frames[:2], folder=tmp_path)
    semantics = SemanticMap(builder, BY_BOX)
    lamp = semantics.vocabulary.index("lava lamp")
    semantics.add_detections(0, detections(lamp))
    semantics.add_detections(2, detections(TABLE))
    state = decode_state(encode_state([builder.snapshot(), semantics.snapshot()]))
    restored = MapBuilder(folder=tmp_path)
    restored_semantics = SemanticMap(restored, BY_BOX)
    restored.restore(state[0])
    restored_semantics.restore(state[1])
    for mapper, labels in ((builder, semantics), (restored, restored_semantics)):
        mapper.add(*posed_frames[2], 2, 0)
        labels.on_keyframe_mapped(2)
        labels.add_detections(0, detections())
    assert restored_semantics.vocabulary.find("lava lamp") == lamp
    assert set(top_labels(builder.gaussians.labels)) == {0, lamp, TABLE}
    assert builder.gaussians.labels.tobytes() == restored.gaussians.labels.tobytes()


def test_invalid_settings_raise_config_error() -> None:
    with pytest.raises(ConfigError, match="max_waiting"):
        SemanticMapConfig(max_waiting=-1)
    with pytest.raises(ConfigError, match="max_names"):
        SemanticMapConfig(max_names=257)
