"""The odometry that others are judged by errs by what it says, and by nothing else."""

import numpy as np

from ldo_service.datasets import Sequence
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.tracking import Odometry, OdometryConfig
from ldo_service.tracking.tracking_result import KeyframeKind

from .false_closures import Drift, DriftingOdometry

DRIFT = Drift(scale=0.1, turn_rad_per_m=0.3)


def followed(odometry: Odometry, frames: list[RgbdFrame]) -> tuple[np.ndarray, list[int]]:
    """T_odom_camera [N, 4, 4], and the frames that became keyframes."""
    T_odom, keyframes, T_odom_keyframe = [], [], {}
    for index, frame in enumerate(frames):
        result = odometry.process(frame)
        keyframe = result.keyframe
        T_odom.append(result.T_odom_camera)
        if keyframe is not None:
            T_odom_keyframe[keyframe.id] = result.T_odom_camera
        T_chained = T_odom_keyframe[result.reference] @ result.T_reference_camera
        np.testing.assert_allclose(T_chained, result.T_odom_camera, atol=1e-9)
        np.testing.assert_allclose(result.T_map_odom, np.eye(4), atol=1e-9)
        if keyframe is not None and keyframe.kind is not KeyframeKind.MAPPING:
            keyframes.append(index)
            for m in keyframe.window:
                T_chained = T_odom_keyframe[m.a] @ m.T_a_b
                np.testing.assert_allclose(T_chained, T_odom_keyframe[m.b], atol=2e-3)
    return np.array(T_odom), keyframes


def test_each_step_is_longer_and_turns_by_as_much_as_was_asked(room: Sequence) -> None:
    frames = [room[index] for index in range(0, 24, 2)]
    right, keyframes = followed(Odometry(), frames)
    drifted, same = followed(DriftingOdometry(OdometryConfig(), DRIFT), frames)
    assert keyframes == same
    assert len(keyframes) > 1
    T_step, T_told = (se3.inverse(T[:-1]) @ T[1:] for T in (right, drifted))
    way_m, told_m = (np.linalg.norm(T[:, :3, 3], axis=1) for T in (T_step, T_told))
    np.testing.assert_allclose(told_m, 1.1 * way_m, atol=1e-6)
    turned = [se3.rotation_angle(T) for T in se3.inverse(T_step) @ T_told]
    np.testing.assert_allclose(turned, 0.3 * way_m, atol=1e-6)


def test_what_errs_aside_is_off_by_a_share_of_the_way_to_one_side(room: Sequence) -> None:
    frames = [room[index] for index in range(0, 24, 2)]
    right, _ = followed(Odometry(), frames)
    drift = Drift(scale=0.0, aside=0.1, turn_rad_per_m=0.0)
    drifted, _ = followed(DriftingOdometry(OdometryConfig(), drift), frames)
    way_m = np.linalg.norm((se3.inverse(right[:-1]) @ right[1:])[:, :3, 3], axis=1).sum()
    np.testing.assert_allclose(
        drifted[-1, :3, 3] - right[-1, :3, 3], [0.1 * way_m, 0, 0], atol=1e-6
    )
    np.testing.assert_allclose(drifted[-1, :3, :3], right[-1, :3, :3], atol=1e-9)
