"""Tests of the scene made from the messages of a service."""

import msgspec
import numpy as np
import pytest

from ldo_service.conversions.frames import camera_from_message
from ldo_service.conversions.poses import correction_to_message, pose_to_message
from ldo_service.geometry import se3
from ldo_service.schemas import (
    Detection,
    DetectionBoxes,
    GraphCorrection,
    Health,
    Keyframe,
    LoopClosure,
    MapObjects,
    Message,
    ObjectView,
    TrackedPose,
)
from ldo_service.viewer.live import MAX_ACTORS, TEXT_INTERVAL_S, LiveScene
from ldo_service.viewer.view_config import ViewerConfig
from tests.maps.streams import ChangingMap
from tests.schemas.examples import EXAMPLES


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def live(clock: Clock) -> LiveScene:
    live = LiveScene(ViewerConfig(), clock)
    live.update()
    return live


def pose_at(x_m: float) -> np.ndarray:
    T = se3.exp(np.array([0.1, 0.2, 0.3, 0, 0, 0]))
    T[0, 3] = x_m
    return T


def tracked_pose(frame: int, x_m: float, reference: int | None, **fields: object) -> TrackedPose:
    """Return the tracked pose of a camera at x; keyframe n is at x = n."""
    T_reference_camera = (
        np.eye(4) if reference is None else se3.inverse(pose_at(reference)) @ pose_at(x_m)
    )
    defaults = {
        "frame": frame,
        "status": "OK",
        "reference": reference,
        "T_odom_camera": pose_to_message(pose_at(x_m)),
        "T_map_odom": pose_to_message(np.eye(4)),
        "T_reference_camera": pose_to_message(T_reference_camera),
        "keyframe": None,
        "submap": 0,
    }
    return msgspec.structs.replace(EXAMPLES["tracked_pose"], **{**defaults, **fields})


def correction(version: int, x_m: dict[int, float], **fields: object) -> GraphCorrection:
    message = correction_to_message(0, version, {k: pose_at(x) for k, x in x_m.items()})
    return msgspec.structs.replace(message, **fields)


def closure(reference: int, keyframe: int) -> LoopClosure:
    example = EXAMPLES["loop_closure"]
    assert isinstance(example, LoopClosure)
    measured = msgspec.structs.replace(example.pose, reference=reference, keyframe=keyframe)
    return msgspec.structs.replace(example, pose=measured)


def changed_by(live: LiveScene, *messages: Message) -> set[str]:
    """Return the layers that change with the messages."""
    for message in messages:
        live.take(message)
    return set(live.update())


WALK = (
    tracked_pose(0, 0.0, None, keyframe=0),
    tracked_pose(1, 0.5, 0),
    tracked_pose(2, 1.0, 0, keyframe=1),
    tracked_pose(3, 1.5, 1),
)


def test_tracked_poses_give_the_paths_and_the_keyframes(live: LiveScene) -> None:
    assert changed_by(live, *WALK) >= {"online", "final", "keyframes"}
    np.testing.assert_allclose(live.scene.online[:, 0], [0, 0.5, 1, 1.5], atol=1e-9)
    np.testing.assert_allclose(live.scene.final[:, 0], [0.5, 1, 1.5], atol=1e-9)
    assert list(live.scene.keyframes) == [0, 1]
    np.testing.assert_allclose(live.scene.keyframes[1], pose_at(1.0), atol=1e-9)
    assert live.scene.T_map_camera is not None
    np.testing.assert_allclose(live.scene.T_map_camera, pose_at(1.5), atol=1e-9)
    assert changed_by(live) <= {"facts"}


def test_correction_moves_the_final_path_and_not_the_online_path(live: LiveScene) -> None:
    changed_by(live, *WALK)
    assert changed_by(live, correction(1, {0: 0.0, 1: 3.0})) >= {"final", "keyframes"}
    np.testing.assert_allclose(live.scene.online[:, 0], [0, 0.5, 1, 1.5], atol=1e-9)
    np.testing.assert_allclose(live.scene.final[:, 0], [0.5, 1, 3.5], atol=1e-9)
    np.testing.assert_allclose(live.scene.keyframes[1], pose_at(3.0), atol=1e-9)


def test_keyframes_newer_than_a_correction_move_with_their_references(live: LiveScene) -> None:
    changed_by(
        live, *WALK, tracked_pose(4, 2.0, 1, keyframe=2), tracked_pose(5, 3.0, 2, keyframe=3)
    )
    changed_by(live, correction(1, {0: 0.0, 1: 3.0}))
    np.testing.assert_allclose(live.scene.keyframes[3], pose_at(5.0), atol=1e-9)
    changed_by(live, correction(2, {0: 0.0, 1: 3.0, 2: 3.9, 3: 4.8}))
    np.testing.assert_allclose(live.scene.keyframes[3], pose_at(4.8), atol=1e-9)


def test_older_correction_is_ignored(live: LiveScene) -> None:
    changed_by(live, *WALK, correction(2, {0: 0.0, 1: 3.0}))
    assert "keyframes" not in changed_by(live, correction(1, {0: 0.0, 1: 9.0}))
    np.testing.assert_allclose(live.scene.keyframes[1], pose_at(3.0), atol=1e-9)


def test_late_viewer_has_all_keyframes_of_the_correction(live: LiveScene) -> None:
    changed_by(live, correction(7, {k: float(k) for k in range(5)}), tracked_pose(90, 4.5, 4))
    assert list(live.scene.keyframes) == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(live.scene.final[:, 0], [4.5], atol=1e-9)


def test_lost_pose_is_not_in_the_path(live: LiveScene) -> None:
    assert changed_by(live, tracked_pose(0, 0.0, None, status="LOST")) <= {"facts"}
    assert len(live.scene.online) == 0


def test_unmerged_submap_leaves_a_gap_in_the_online_path(live: LiveScene) -> None:
    changed_by(live, *WALK, tracked_pose(9, 50.0, None, submap=1))
    np.testing.assert_array_equal(np.isnan(live.scene.online[:, 0]), [False] * 4 + [True])


def test_long_path_is_thinned_evenly_up_to_its_end(clock: Clock) -> None:
    max_poses = 100
    live = LiveScene(ViewerConfig(max_poses=max_poses), clock)
    for frame in range(1000):
        live.take(tracked_pose(frame, 0.01 * frame, 0, keyframe=0 if frame == 0 else None))
    live.update()
    x = live.scene.online[:, 0]
    assert max_poses / 2 <= len(x) <= max_poses
    assert x[0] < 0.2
    assert x[-1] > 9.8
    np.testing.assert_allclose(np.diff(x), np.diff(x)[0], atol=1e-9)


def test_camera_comes_from_a_keyframe(live: LiveScene) -> None:
    keyframe = EXAMPLES["keyframe"]
    assert isinstance(keyframe, Keyframe)
    assert not live.has_camera
    changed_by(live, keyframe)
    assert live.scene.camera == camera_from_message(keyframe.camera)


def test_detections_are_kept_for_the_newest_keyframes(clock: Clock) -> None:
    live = LiveScene(ViewerConfig(max_keyframes=3), clock)
    cup = Detection(label="cup", score=0.9, box_px=(1.0, 2.0, 3.0, 4.0))
    for keyframe in range(5):
        boxes = DetectionBoxes(
            stamp_ns=0, keyframe=keyframe, width=64, height=48, detections=(cup,), network="n"
        )
        assert "keyframes" in changed_by(live, boxes)
    assert list(live.scene.detections) == [2, 3, 4]
    (detection,) = live.scene.detections[4]
    assert (detection.name, detection.box_px) == ("cup", (1.0, 2.0, 3.0, 4.0))


def test_late_viewer_takes_missing_boxes_from_the_first_objects(live: LiveScene) -> None:
    cup = Detection(label="cup", score=0.9, box_px=(1.0, 2.0, 3.0, 4.0))
    boxes = DetectionBoxes(
        stamp_ns=0, keyframe=1, width=64, height=48, detections=(cup,), network="n"
    )
    assert "keyframes" in changed_by(live, boxes, objects_seen_in(1, 5))
    assert [detection.name for detection in live.scene.detections[1]] == ["cup"], (
        "received boxes take precedence"
    )
    (detection,) = live.scene.detections[5]
    assert detection.box_px == (5.0, 6.0, 7.0, 8.0)
    assert "keyframes" not in changed_by(live, objects_seen_in(9)), "later objects add no boxes"


def objects_seen_in(*keyframes: int) -> MapObjects:
    example = EXAMPLES["map_objects"]
    assert isinstance(example, MapObjects)
    views = tuple(ObjectView(keyframe=k, box_px=(5.0, 6.0, 7.0, 8.0)) for k in keyframes)
    map_object = msgspec.structs.replace(example.objects[0], views=views)
    return msgspec.structs.replace(example, objects=(map_object,))


def test_loops_are_those_that_the_optimizer_accepts(live: LiveScene) -> None:
    changed_by(live, closure(1, 8), closure(2, 9))
    assert live.scene.loops == ((1, 8), (2, 9))
    accepted = correction(
        1, {0: 0.0}, accepted_closures=((0, 7), (1, 8)), rejected_closures=((2, 9),)
    )
    assert "loops" in changed_by(live, accepted)
    assert set(live.scene.loops) == {(1, 8), (0, 7)}
    changed_by(
        live,
        correction(2, {0: 0.0}, accepted_closures=((0, 7), (1, 8)), rejected_closures=((3, 10),)),
    )
    assert set(live.scene.loops) == {(1, 8), (0, 7)}, (
        "a correction lists only the newest rejected closures"
    )


def test_map_grows_and_a_reset_clears_the_scene(live: LiveScene) -> None:
    published = ChangingMap(1)
    assert "gaussians" in changed_by(
        live, *WALK, published.delta(), published.delta(), closure(1, 8)
    )
    np.testing.assert_array_equal(live.scene.rows, published.map.rows)
    changed_by(live, EXAMPLES["map_objects"])
    after_reset = ChangingMap(2)
    assert changed_by(live, after_reset.delta()) >= {
        "online",
        "final",
        "keyframes",
        "objects",
        "loops",
    }
    np.testing.assert_array_equal(live.scene.rows, after_reset.map.rows)
    scene = live.scene
    assert len(scene.online) == len(scene.keyframes) == len(scene.loops) == 0
    assert scene.objects is None


def test_scene_has_the_newest_objects(live: LiveScene) -> None:
    example = EXAMPLES["map_objects"]
    assert isinstance(example, MapObjects)
    assert "objects" in changed_by(live, example)
    assert live.scene.objects is example


def test_facts_show_health_and_rates(live: LiveScene, clock: Clock) -> None:
    health = EXAMPLES["health"]
    assert isinstance(health, Health)
    for heartbeat in range(11):
        clock.now_s += 0.5
        steps = 100 + 10 * heartbeat
        live.take(msgspec.structs.replace(health, actor="tracker", steps=steps, paused=False))
        changed_by(live, tracked_pose(heartbeat, 0.0, None))
    (row,) = [line for line in live.scene.facts.splitlines() if line.startswith("| tracker")]
    assert "| 20.0 |" in row
    assert "**OK** at frame 9, 2.0 poses/s" in live.scene.facts
    for _ in range(7):
        clock.now_s += 1
        changed_by(live)
    assert "**silent 7 s**" in live.scene.facts
    assert "**no pose for 7 s**; the last was OK at frame 10" in live.scene.facts
    assert "poses/s" not in live.scene.facts


def test_facts_change_at_most_once_per_interval(live: LiveScene, clock: Clock) -> None:
    clock.now_s += TEXT_INTERVAL_S
    assert changed_by(live) == {"facts"}
    clock.now_s += TEXT_INTERVAL_S / 2
    assert changed_by(live) == set()


def test_number_of_actors_in_the_facts_is_bounded(live: LiveScene, clock: Clock) -> None:
    health = EXAMPLES["health"]
    assert isinstance(health, Health)
    for number in range(2 * MAX_ACTORS):
        live.take(msgspec.structs.replace(health, actor=f"a{number}"))
    clock.now_s += TEXT_INTERVAL_S
    live.update()
    assert live.scene.facts.count("\n| a") == MAX_ACTORS + 1  # The header of the table counts too.


def test_facts_report_missing_health_messages(live: LiveScene, clock: Clock) -> None:
    clock.now_s += TEXT_INTERVAL_S
    live.update()
    assert "No heartbeat yet" in live.scene.facts
