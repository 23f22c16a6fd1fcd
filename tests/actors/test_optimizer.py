"""The optimizer owns the keyframe poses."""

import msgspec
import numpy as np

from ldo_service.actors.optimizer import Optimizer
from ldo_service.geometry import se3
from ldo_service.schemas import Keyframe
from ldo_service.wire import keyframe_poses_of, transform


def handled(optimizer: Optimizer, keyframes: list[Keyframe]) -> list:
    return [out for keyframe in keyframes for out in optimizer.handle(keyframe)]


def chained(keyframes: list[Keyframe]) -> list[Keyframe]:
    """Measured from their references alone."""
    return [msgspec.structs.replace(keyframe, window=()) for keyframe in keyframes]


def test_each_keyframe_gives_a_correction_of_all_poses(keyframes) -> None:
    corrections = handled(Optimizer(), chained(keyframes))
    assert [c.graph_version for c in corrections] == list(range(1, len(keyframes) + 1))
    last = keyframe_poses_of(corrections[-1])
    assert list(last) == [k.keyframe for k in keyframes]
    for keyframe in keyframes:
        np.testing.assert_allclose(
            last[keyframe.keyframe], transform(keyframe.T_odom_keyframe), atol=1e-6
        )


def test_a_keyframe_sent_twice_counts_once(keyframes) -> None:
    optimizer = Optimizer()
    handled(optimizer, keyframes[:2])
    assert handled(optimizer, keyframes[1:2]) == []
    assert optimizer.facts()["keyframes_repeated"] == 1


def test_a_missing_reference_is_bridged_by_odometry(keyframes, caplog) -> None:
    optimizer = Optimizer()
    missing = next(k.reference for k in keyframes if k.reference)
    (*_, last) = handled(optimizer, [k for k in chained(keyframes) if k.keyframe != missing])
    assert "its reference is missing" in caplog.text
    poses = keyframe_poses_of(last)
    newest = keyframes[-1]
    np.testing.assert_allclose(poses[newest.keyframe], transform(newest.T_odom_keyframe), atol=1e-6)


def test_a_window_stands_in_for_a_missing_reference(keyframes) -> None:
    optimizer = Optimizer()
    *_, last = keyframes
    older = last.window[-1]
    handled(optimizer, [k for k in keyframes if k.keyframe <= older.reference])
    (correction,) = handled(optimizer, [last])
    poses = keyframe_poses_of(correction)
    T_older_last = se3.inverse(poses[older.reference]) @ poses[last.keyframe]
    np.testing.assert_allclose(T_older_last, transform(older.T_reference_keyframe), atol=1e-6)
    assert optimizer.facts()["keyframes_bridged"] == 0


def test_windows_bring_the_keyframes_nearer_to_the_truth(keyframes, room) -> None:
    truth = room.truth().T_world_camera

    def error_m(corrections: list) -> float:
        last = keyframe_poses_of(corrections[-1])
        T_first_world = se3.inverse(truth[keyframes[0].frame])
        estimated = [last[k.keyframe][:3, 3] for k in keyframes]
        true = [(T_first_world @ truth[k.frame])[:3, 3] for k in keyframes]
        return float(np.sqrt(np.mean(np.square(np.subtract(estimated, true)).sum(axis=1))))

    alone = error_m(handled(Optimizer(), chained(keyframes)))
    together = error_m(handled(Optimizer(), keyframes))
    assert together < 0.8 * alone


def test_a_successor_goes_on_with_a_newer_version(keyframes) -> None:
    first, second = Optimizer(), Optimizer()
    handled(first, keyframes[:-1])
    second.restore(first.snapshot())
    (expected,) = handled(first, keyframes[-1:])
    (correction,) = handled(second, keyframes[-1:])
    assert correction.graph_version > expected.graph_version, "one may have been sent and not saved"
    for keyframe, T in keyframe_poses_of(correction).items():
        np.testing.assert_allclose(T, keyframe_poses_of(expected)[keyframe], atol=1e-6)


def test_two_runs_say_the_same_bytes(keyframes) -> None:
    one, two = (
        [msgspec.msgpack.encode(c) for c in handled(Optimizer(), keyframes)] for _ in range(2)
    )
    assert one == two


def test_an_information_of_zero_does_not_break_the_graph(keyframes) -> None:
    blind = msgspec.structs.replace(keyframes[1], information=(0.0,) * 36)
    assert len(handled(Optimizer(), [keyframes[0], blind])) == 2
