import numpy as np
import pytest

from ldo_service.geometry import se3
from ldo_service.tracking.motion import ConstantVelocity, image_motion_rad

TWIST = np.array([0.02, -0.1, 0.05, 0.1, 0.02, -0.03])
STEP_NS = 33_000_000


def test_constant_velocity_is_extrapolated_over_any_interval() -> None:
    motion = ConstantVelocity().moved_to(np.eye(4), STEP_NS).moved_to(se3.exp(TWIST), 2 * STEP_NS)
    for steps in (0.5, 1.0, 3.0):
        stamp_ns = int((2 + steps) * STEP_NS)
        expected = se3.exp((1 + steps) * TWIST)
        np.testing.assert_allclose(motion.predicted(stamp_ns), expected, atol=1e-12)


def test_frames_without_stamps_count_as_one_interval() -> None:
    motion = ConstantVelocity().moved_to(se3.exp(TWIST), 0)
    np.testing.assert_allclose(motion.predicted(0), se3.exp(2 * TWIST), atol=1e-12)


def test_long_gap_is_not_extrapolated_without_limit() -> None:
    motion = ConstantVelocity(stamp_ns=0).moved_to(se3.exp(TWIST), STEP_NS)
    np.testing.assert_array_equal(motion.predicted(50 * STEP_NS), motion.predicted(900 * STEP_NS))


def test_ten_thousand_predictions_stay_rotations() -> None:
    motion = ConstantVelocity()
    for k in range(1, 10_001):
        motion = motion.moved_to(motion.predicted(k) @ se3.exp(TWIST * (k < 3)), k)
    R = motion.T_odom_camera[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_stopped_motion_predicts_the_same_pose() -> None:
    motion = ConstantVelocity().moved_to(se3.exp(TWIST), STEP_NS).without_velocity()
    np.testing.assert_allclose(motion.predicted(9 * STEP_NS), se3.exp(TWIST), atol=1e-12)


def test_image_motion_adds_rotation_and_parallax() -> None:
    T = se3.exp(np.array([0, 0.1, 0, 0, 0, 0]))
    T[0, 3] = 0.4
    assert image_motion_rad(T, 2.0) == pytest.approx(0.3)
