"""Corrections of the optimizer from loop closures and object observations."""

from collections.abc import Iterable, Iterator

import msgspec
import numpy as np

from ldo_service.actors.optimizer import Optimizer
from ldo_service.conversions.poses import (
    keyframe_poses_from_correction,
    matrix6_to_message,
    pose_to_message,
    relative_pose_to_message,
)
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.schemas import (
    Array,
    CameraModel,
    GraphCorrection,
    Keyframe,
    LoopClosure,
    Message,
    ObjectObservation,
)
from ldo_service.storage.state_codec import decode_state, encode_state
from tests.actors.conftest import without_images

CAMERA = CameraModel(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)
COLOR, DEPTH = np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.float32)
INFORMATION = np.diag([1e4] * 6)
CENTER = np.array([0.0, 0.0, 0.0])  # Center of the circle and position of the object.


def poses_on_circle(count: int, each: int, radius_m: float = 2.0) -> list[np.ndarray]:
    """Return camera poses on a circle around an object, all directed at it."""
    poses = []
    for angle in 2 * np.pi * np.arange(count) / each:
        T = se3.exp(np.array([0, angle, 0, 0, 0, 0]))
        T[:3, 3] = -radius_m * T[:3, 2]
        poses.append(T)
    return poses


TRUTH = poses_on_circle(90, 40)


def T_of_step(k: int) -> np.ndarray:
    """Return the motion to pose k as measured by drifting odometry."""
    T = se3.inverse(TRUTH[k - 1]) @ TRUTH[k]
    T[:3, 3] *= 1.01
    return T @ se3.exp(np.array([0, 1.5e-3, 0, 0, 0, 0]))


def keyframes() -> Iterator[Keyframe]:
    T_odom = TRUTH[0]
    for k in range(len(TRUTH)):
        T_odom = T_odom @ T_of_step(k) if k else T_odom
        yield Keyframe(
            stamp_ns=k * 10**8,
            keyframe=k,
            frame=3 * k,
            camera=CAMERA,
            color=Array.of(COLOR),
            depth_m=Array.of(DEPTH),
            reference=k - 1 if k else None,
            T_reference_keyframe=pose_to_message(T_of_step(k) if k else np.eye(4)),
            information=matrix6_to_message(INFORMATION),
            T_odom_keyframe=pose_to_message(T_odom),
        )


def closure(a: int, b: int, T_a_b: np.ndarray | None = None) -> LoopClosure:
    T_a_b = se3.inverse(TRUTH[a]) @ TRUTH[b] if T_a_b is None else T_a_b
    pose = relative_pose_to_message(RelativePose(a, b, T_a_b, INFORMATION))
    return LoopClosure(stamp_ns=b * 10**8, pose=pose, overlap=0.6, rmse_m=0.01)


def observation(k: int, p: float = 0.9, entropy: float = 0.4) -> ObjectObservation:
    u, v, z = se3.transform(se3.inverse(TRUTH[k]), CENTER)
    u, v = 250 * u / z + 159.5, 250 * v / z + 119.5
    return ObjectObservation(
        stamp_ns=k * 10**8,
        keyframe=k,
        object=4,
        box_px=(u - 20, v - 20, u + 20, v + 20),
        distribution=(("chair", p), ("couch", (1 - p) / 2)),
        entropy=entropy,
    )


def messages_with_closures() -> Iterator[Message]:
    """Yield keyframes, observations one keyframe late, and a closure every five keyframes."""
    for message in keyframes():
        k = message.keyframe
        yield message
        if k % 3 != 0 and k > 1:
            yield observation(k - 1)
        if k > 50 and k % 5 == 0:
            yield closure(k - 40, k)


def corrections(optimizer: Optimizer, messages: Iterable[Message]) -> list[GraphCorrection]:
    return [out for message in without_images(messages) for out in optimizer.handle(message)]


def error_m(correction: GraphCorrection) -> float:
    T_map = keyframe_poses_from_correction(correction)
    off = [T[:3, 3] - TRUTH[k][:3, 3] for k, T in T_map.items()]
    return float(np.sqrt(np.mean(np.square(off).sum(axis=1))))


def test_closures_correct_odometry_drift() -> None:
    drifted = corrections(Optimizer(), keyframes())[-1]
    optimizer = Optimizer()
    *_, last = corrections(optimizer, messages_with_closures())
    assert last.accepted_closures == tuple((k - 40, k) for k in range(55, 90, 5))
    assert last.rejected_closures == ()
    assert error_m(last) < error_m(drifted) / 3, (
        "closures do not correct the length of steps, 1 % too long"
    )
    assert optimizer.metrics()["closures"] == 7
    # The newest 20 keyframes and ends of closures.
    assert optimizer.metrics()["graph_variables"] < 45


def test_false_closure_is_published_as_rejected_and_moves_nothing() -> None:
    optimizer = Optimizer()
    *_, before = corrections(optimizer, keyframes())
    (after,) = corrections(optimizer, [closure(10, 70, np.eye(4))])
    assert after.accepted_closures == ()
    assert after.rejected_closures == ((10, 70),)
    assert bytes(after.T_map_keyframe.data) == bytes(before.T_map_keyframe.data)
    assert optimizer.metrics()["closures_rejected"] == 1


def test_a_closure_waits_for_its_keyframe() -> None:
    messages = list(keyframes())
    optimizer = Optimizer()
    corrections(optimizer, messages[:60])
    assert corrections(optimizer, [closure(20, 60)]) == []
    (correction,) = corrections(optimizer, messages[60:61])
    assert correction.accepted_closures == ((20, 60),)


def test_an_object_becomes_a_landmark_with_its_name() -> None:
    *_, last = corrections(Optimizer(), messages_with_closures())
    (landmark,) = last.landmarks
    assert landmark.object == 4
    assert landmark.distribution[0][0] == "chair"
    assert dict(landmark.distribution)["chair"] > 0.85
    assert np.linalg.norm(np.subtract(landmark.centroid, CENTER)) < 0.1


def test_observations_are_optimized_in_batches() -> None:
    optimizer = Optimizer()
    corrections(optimizer, messages_with_closures())
    metrics = optimizer.metrics()
    assert metrics["landmarks"] == 1
    assert metrics["optimizations_skipped"] > 40


def test_early_observation_waits_for_its_keyframe() -> None:
    messages = list(keyframes())
    optimizer = Optimizer()
    corrections(optimizer, messages[:10])
    assert corrections(optimizer, [observation(10), *messages[10:13], observation(12)]) != []
    assert optimizer.metrics()["early_messages_discarded"] == 0
    assert len(optimizer.snapshot()["rest"]["waiting"]) == 2


def test_restored_optimizer_continues_bitwise_equal() -> None:
    messages = list(messages_with_closures())
    for split in (40, 101, 131):
        first, second = Optimizer(), Optimizer()
        corrections(first, messages[:split])
        second.restore(decode_state(encode_state(first.snapshot())))
        one, other = (
            [msgspec.structs.replace(c, graph_version=0) for c in corrections(o, messages[split:])]
            for o in (first, second)
        )
        assert list(map(msgspec.msgpack.encode, one)) == list(map(msgspec.msgpack.encode, other))
