"""What a service says, as a scene."""

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
from ldo_service.viewer.live import FACTS_EVERY_S, MAX_ACTORS, LiveScene
from ldo_service.viewer.view_config import ViewerConfig
from tests.maps.streams import ChangingMap
from tests.schemas.examples import EXAMPLES


class Clock:
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


def at(x_m: float) -> np.ndarray:
    T = se3.exp(np.array([0.1, 0.2, 0.3, 0, 0, 0]))
    T[0, 3] = x_m
    return T


def pose(frame: int, x_m: float, reference: int | None, **fields: object) -> TrackedPose:
    """Of a camera at x; keyframe n is made at x = n."""
    T_reference_camera = np.eye(4) if reference is None else se3.inverse(at(reference)) @ at(x_m)
    plain = {
        "frame": frame,
        "status": "OK",
        "reference": reference,
        "T_odom_camera": pose_to_message(at(x_m)),
        "T_map_odom": pose_to_message(np.eye(4)),
        "T_reference_camera": pose_to_message(T_reference_camera),
        "keyframe": None,
        "submap": 0,
    }
    return msgspec.structs.replace(EXAMPLES["tracked_pose"], **{**plain, **fields})


def correction(version: int, x_m: dict[int, float], **fields: object) -> GraphCorrection:
    message = correction_to_message(0, version, {k: at(x) for k, x in x_m.items()})
    return msgspec.structs.replace(message, **fields)


def closure(reference: int, keyframe: int) -> LoopClosure:
    example = EXAMPLES["loop_closure"]
    assert isinstance(example, LoopClosure)
    measured = msgspec.structs.replace(example.pose, reference=reference, keyframe=keyframe)
    return msgspec.structs.replace(example, pose=measured)


def taken(live: LiveScene, *messages: Message) -> set[str]:
    for message in messages:
        live.take(message)
    return set(live.update())


WALK = (
    pose(0, 0.0, None, keyframe=0),
    pose(1, 0.5, 0),
    pose(2, 1.0, 0, keyframe=1),
    pose(3, 1.5, 1),
)


def test_poses_are_a_path_and_keyframes(live: LiveScene) -> None:
    assert taken(live, *WALK) >= {"online", "final", "keyframes"}
    np.testing.assert_allclose(live.scene.online[:, 0], [0, 0.5, 1, 1.5], atol=1e-9)
    np.testing.assert_allclose(live.scene.final[:, 0], [0.5, 1, 1.5], atol=1e-9)
    assert list(live.scene.keyframes) == [0, 1]
    np.testing.assert_allclose(live.scene.keyframes[1], at(1.0), atol=1e-9)
    assert live.scene.T_map_camera is not None
    np.testing.assert_allclose(live.scene.T_map_camera, at(1.5), atol=1e-9)
    assert taken(live) <= {"facts"}


def test_a_correction_moves_the_final_path_and_not_the_published_one(live: LiveScene) -> None:
    taken(live, *WALK)
    assert taken(live, correction(1, {0: 0.0, 1: 3.0})) >= {"final", "keyframes"}
    np.testing.assert_allclose(live.scene.online[:, 0], [0, 0.5, 1, 1.5], atol=1e-9)
    np.testing.assert_allclose(live.scene.final[:, 0], [0.5, 1, 3.5], atol=1e-9)
    np.testing.assert_allclose(live.scene.keyframes[1], at(3.0), atol=1e-9)


def test_keyframes_newer_than_a_correction_hang_on_their_references(live: LiveScene) -> None:
    taken(live, *WALK, pose(4, 2.0, 1, keyframe=2), pose(5, 3.0, 2, keyframe=3))
    taken(live, correction(1, {0: 0.0, 1: 3.0}))
    np.testing.assert_allclose(live.scene.keyframes[3], at(5.0), atol=1e-9)
    taken(live, correction(2, {0: 0.0, 1: 3.0, 2: 3.9, 3: 4.8}))
    np.testing.assert_allclose(live.scene.keyframes[3], at(4.8), atol=1e-9)


def test_an_older_correction_changes_nothing(live: LiveScene) -> None:
    taken(live, *WALK, correction(2, {0: 0.0, 1: 3.0}))
    assert "keyframes" not in taken(live, correction(1, {0: 0.0, 1: 9.0}))
    np.testing.assert_allclose(live.scene.keyframes[1], at(3.0), atol=1e-9)


def test_who_comes_late_knows_all_keyframes_of_the_correction(live: LiveScene) -> None:
    taken(live, correction(7, {k: float(k) for k in range(5)}), pose(90, 4.5, 4))
    assert list(live.scene.keyframes) == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(live.scene.final[:, 0], [4.5], atol=1e-9)


def test_a_lost_camera_leaves_no_path(live: LiveScene) -> None:
    assert taken(live, pose(0, 0.0, None, status="LOST")) <= {"facts"}
    assert len(live.scene.online) == 0


def test_a_submap_that_is_not_joined_has_no_place_in_the_published_path(live: LiveScene) -> None:
    taken(live, *WALK, pose(9, 50.0, None, submap=1))
    np.testing.assert_array_equal(np.isnan(live.scene.online[:, 0]), [False] * 4 + [True])


def test_a_long_path_is_drawn_coarser_and_to_its_end(clock: Clock) -> None:
    most = 100
    live = LiveScene(ViewerConfig(most_poses=most), clock)
    for frame in range(1000):
        live.take(pose(frame, 0.01 * frame, 0, keyframe=0 if frame == 0 else None))
    live.update()
    x = live.scene.online[:, 0]
    assert most / 2 <= len(x) <= most
    assert x[0] < 0.2
    assert x[-1] > 9.8
    np.testing.assert_allclose(np.diff(x), np.diff(x)[0], atol=1e-9)


def test_the_lens_is_learnt_from_a_keyframe(live: LiveScene) -> None:
    keyframe = EXAMPLES["keyframe"]
    assert isinstance(keyframe, Keyframe)
    assert not live.has_camera
    taken(live, keyframe)
    assert live.scene.camera == camera_from_message(keyframe.camera)


def test_detections_belong_to_their_keyframe_and_the_oldest_go(clock: Clock) -> None:
    live = LiveScene(ViewerConfig(most_keyframes=3), clock)
    cup = Detection(label="cup", score=0.9, box_px=(1.0, 2.0, 3.0, 4.0))
    for keyframe in range(5):
        boxes = DetectionBoxes(
            stamp_ns=0, keyframe=keyframe, width=64, height=48, detections=(cup,), network="n"
        )
        assert "keyframes" in taken(live, boxes)
    assert list(live.scene.sights) == [2, 3, 4]
    (sight,) = live.scene.sights[4]
    assert (sight.name, sight.box_px) == ("cup", (1.0, 2.0, 3.0, 4.0))


def test_who_comes_late_sees_what_objects_were_seen_in(live: LiveScene) -> None:
    cup = Detection(label="cup", score=0.9, box_px=(1.0, 2.0, 3.0, 4.0))
    boxes = DetectionBoxes(
        stamp_ns=0, keyframe=1, width=64, height=48, detections=(cup,), network="n"
    )
    assert "keyframes" in taken(live, boxes, seen_in(1, 5))
    assert [sight.name for sight in live.scene.sights[1]] == ["cup"], "of what came itself"
    (sight,) = live.scene.sights[5]
    assert sight.box_px == (5.0, 6.0, 7.0, 8.0)
    assert "keyframes" not in taken(live, seen_in(9)), "from now on boxes come"


def seen_in(*keyframes: int) -> MapObjects:
    found = EXAMPLES["map_objects"]
    assert isinstance(found, MapObjects)
    views = tuple(ObjectView(keyframe=k, box_px=(5.0, 6.0, 7.0, 8.0)) for k in keyframes)
    one = msgspec.structs.replace(found.objects[0], views=views)
    return msgspec.structs.replace(found, objects=(one,))


def test_loops_are_those_that_the_optimizer_believes(live: LiveScene) -> None:
    taken(live, closure(1, 8), closure(2, 9))
    assert live.scene.loops == ((1, 8), (2, 9))
    agreed = correction(
        1, {0: 0.0}, accepted_closures=((0, 7), (1, 8)), rejected_closures=((2, 9),)
    )
    assert "loops" in taken(live, agreed)
    assert set(live.scene.loops) == {(1, 8), (0, 7)}
    taken(
        live,
        correction(2, {0: 0.0}, accepted_closures=((0, 7), (1, 8)), rejected_closures=((3, 10),)),
    )
    assert set(live.scene.loops) == {(1, 8), (0, 7)}, "a correction names the newest refused ones"


def test_the_map_grows_and_a_reset_leaves_nothing_of_it(live: LiveScene) -> None:
    changing = ChangingMap(1)
    assert "gaussians" in taken(live, *WALK, changing.delta(), changing.delta(), closure(1, 8))
    np.testing.assert_array_equal(live.scene.rows, changing.map.rows)
    taken(live, EXAMPLES["map_objects"])
    anew = ChangingMap(2)
    assert taken(live, anew.delta()) >= {"online", "final", "keyframes", "objects", "loops"}
    np.testing.assert_array_equal(live.scene.rows, anew.map.rows)
    scene = live.scene
    assert len(scene.online) == len(scene.keyframes) == len(scene.loops) == 0
    assert scene.objects is None


def test_objects_are_the_newest(live: LiveScene) -> None:
    found = EXAMPLES["map_objects"]
    assert isinstance(found, MapObjects)
    assert "objects" in taken(live, found)
    assert live.scene.objects is found


def test_health_and_rates_are_told(live: LiveScene, clock: Clock) -> None:
    health = EXAMPLES["health"]
    assert isinstance(health, Health)
    for beat in range(11):
        clock.now_s += 0.5
        steps = 100 + 10 * beat
        live.take(msgspec.structs.replace(health, actor="tracker", steps=steps, paused=False))
        taken(live, pose(beat, 0.0, None))
    (row,) = [line for line in live.scene.facts.splitlines() if line.startswith("| tracker")]
    assert "| 20.0 |" in row
    assert "**OK** at frame 9, 2.0 poses/s" in live.scene.facts
    for _ in range(7):
        clock.now_s += 1
        taken(live)
    assert "**silent 7 s**" in live.scene.facts
    assert "**no pose for 7 s**; the last was OK at frame 10" in live.scene.facts
    assert "poses/s" not in live.scene.facts


def test_words_change_no_faster_than_they_can_be_read(live: LiveScene, clock: Clock) -> None:
    clock.now_s += FACTS_EVERY_S
    assert taken(live) == {"facts"}
    clock.now_s += FACTS_EVERY_S / 2
    assert taken(live) == set()


def test_actors_are_as_many_as_there_is_room_for(live: LiveScene, clock: Clock) -> None:
    health = EXAMPLES["health"]
    assert isinstance(health, Health)
    for number in range(2 * MAX_ACTORS):
        live.take(msgspec.structs.replace(health, actor=f"a{number}"))
    clock.now_s += FACTS_EVERY_S
    live.update()
    assert live.scene.facts.count("\n| a") == MAX_ACTORS + 1  # and the names of the columns


def test_silence_is_told_of(live: LiveScene, clock: Clock) -> None:
    clock.now_s += FACTS_EVERY_S
    live.update()
    assert "No actor reports" in live.scene.facts
