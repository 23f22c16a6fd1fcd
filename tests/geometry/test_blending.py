"""Interpolation of transforms, compared with SciPy and with single transforms."""

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ldo_service.geometry import se3
from ldo_service.geometry.se3 import interpolate

RNG = np.random.default_rng(3)


def random_transforms(count: int) -> np.ndarray:
    return np.array([se3.exp(RNG.normal(size=6)) for _ in range(count)])


def test_rotations_follow_the_geodesic_and_positions_a_line() -> None:
    T_a, T_b, fraction = random_transforms(7), random_transforms(7), RNG.random(7)
    T = interpolate(T_a, T_b, fraction)
    for k in range(7):
        ends = Rotation.from_matrix([T_a[k, :3, :3], T_b[k, :3, :3]])
        np.testing.assert_allclose(
            T[k, :3, :3], Slerp([0, 1], ends)(fraction[k]).as_matrix(), atol=1e-12
        )
        line = (1 - fraction[k]) * T_a[k, :3, 3] + fraction[k] * T_b[k, :3, 3]
        np.testing.assert_allclose(T[k, :3, 3], line, atol=1e-12)


def test_interpolation_at_0_and_1_gives_the_end_transforms() -> None:
    T_a, T_b = random_transforms(3), random_transforms(3)
    np.testing.assert_allclose(interpolate(T_a, T_b, np.zeros(3)), T_a, atol=1e-12)
    np.testing.assert_allclose(interpolate(T_a, T_b, np.ones(3)), T_b, atol=1e-12)


def test_quaternions_of_a_batch_equal_single_ones() -> None:
    T = random_transforms(50)
    one_by_one = [se3.quaternion(R) for R in T[:, :3, :3]]
    np.testing.assert_allclose(se3.quaternion(T[:, :3, :3]), one_by_one, atol=1e-12)
    assert se3.quaternion(np.zeros((0, 3, 3))).shape == (0, 4)
    assert interpolate(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), np.zeros(0)).shape == (0, 4, 4)


def test_half_turns_and_tiny_turns_keep_their_precision() -> None:
    axes = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8], [0, 0.6, -0.8], [0, 0, 0]])
    R = Rotation.from_rotvec(np.pi * axes).as_matrix()
    np.testing.assert_allclose(se3.rotation(se3.quaternion(R)), R, atol=1e-12)
    tiny = np.array([se3.exp(np.r_[1e-12 * axis, 0, 0, 0]) for axis in axes])
    halves = interpolate(np.tile(np.eye(4), (6, 1, 1)), tiny, np.full(6, 0.5))
    np.testing.assert_allclose(halves[:, 2, 1], 0.5e-12 * axes[:, 0], atol=1e-16)


def test_batch_interpolation_is_bitwise_equal_to_single_ones() -> None:
    T_a, T_b, fraction = random_transforms(40), random_transforms(40), RNG.random(40)
    alone = [interpolate(T_a[k : k + 1], T_b[k : k + 1], fraction[k : k + 1])[0] for k in range(40)]
    np.testing.assert_array_equal(interpolate(T_a, T_b, fraction), alone)
