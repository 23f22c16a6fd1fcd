"""Drifting odometry of the test helpers, compared with its parameters."""

import numpy as np

from ldo_service.datasets import Sequence
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.tracking import Odometry, OdometryConfig
from ldo_service.tracking.tracking_result import KeyframeKind

from .false_closures import Drift, DriftingOdometry

DRIFT = Drift(scale=0.1, turn_rad_per_m=0.3)


def track_frames(odometry: Odometry, frames: list[RgbdFrame]) -> tuple[np.ndarray, list[int]]:
    """Return T_odom_camera [N, 4, 4] and the indices of frames that became keyframes."""
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


def test_each_step_is_scaled_and_turned_by_the_given_drift(room: Sequence) -> None:
    frames = [room[index] for index in range(0, 24, 2)]
    exact, keyframes = track_frames(Odometry(), frames)
    drifted, keyframes_drifted = track_frames(DriftingOdometry(OdometryConfig(), DRIFT), frames)
    assert keyframes == keyframes_drifted
    assert len(keyframes) > 1
    T_step, T_drifted = (se3.inverse(T[:-1]) @ T[1:] for T in (exact, drifted))
    distance_m, drifted_m = (np.linalg.norm(T[:, :3, 3], axis=1) for T in (T_step, T_drifted))
    np.testing.assert_allclose(drifted_m, 1.1 * distance_m, atol=1e-6)
    turned = [se3.rotation_angle(T) for T in se3.inverse(T_step) @ T_drifted]
    np.testing.assert_allclose(turned, 0.3 * distance_m, atol=1e-6)


def test_sideways_drift_is_a_fraction_of_the_distance_in_one_direction(room: Sequence) -> None:
    frames = [room[index] for index in range(0, 24, 2)]
    exact, _ = track_frames(Odometry(), frames)
    drift = Drift(scale=0.0, aside=0.1, turn_rad_per_m=0.0)
    drifted, _ = track_frames(DriftingOdometry(OdometryConfig(), drift), frames)
    distance_m = np.linalg.norm((se3.inverse(exact[:-1]) @ exact[1:])[:, :3, 3], axis=1).sum()
    np.testing.assert_allclose(
        drifted[-1, :3, 3] - exact[-1, :3, 3], [0.1 * distance_m, 0, 0], atol=1e-6
    )
    np.testing.assert_allclose(drifted[-1, :3, :3], exact[-1, :3, :3], atol=1e-9)
