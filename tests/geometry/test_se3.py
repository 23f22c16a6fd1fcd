"""Rotations and transforms, compared with SciPy and with the group laws."""

import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from ldo_service.geometry import se3


def hat(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.skew(xi[:3]), xi[3:]
    return out


def tangent(angle_rad: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.r_[axis / np.linalg.norm(axis) * angle_rad, rng.normal(size=3)]


ANGLES = [0.0, 1e-9, 1e-7, 1e-6, 3e-6, 1e-5, 1e-4, 1e-3, 0.1, 1.0, 2.5, 3.1]


@pytest.mark.parametrize("angle_rad", ANGLES)
def test_exp_is_the_matrix_exponential(angle_rad: float) -> None:
    xi = tangent(angle_rad)
    np.testing.assert_allclose(se3.exp(xi), expm(hat(xi)), atol=2e-15)


@pytest.mark.parametrize("angle_rad", ANGLES)
def test_log_inverts_exp(angle_rad: float) -> None:
    xi = tangent(angle_rad)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-13)


def test_log_is_the_matrix_logarithm() -> None:
    T = se3.exp(tangent(1.3))
    log = np.real(logm(T))
    np.testing.assert_allclose(hat(se3.log(T)), log, atol=1e-10)


def test_log_of_a_half_turn_gives_back_the_transform() -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()
    T[:3, 3] = 1, 2, 3
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-12)


def test_quaternions_and_rotations_agree_with_scipy() -> None:
    rotations = Rotation.random(200, rng=np.random.default_rng(1))
    for R, (x, y, z, w) in zip(
        rotations.as_matrix(), rotations.as_quat(canonical=True), strict=True
    ):
        np.testing.assert_allclose(se3.quaternion(R), [w, x, y, z], atol=1e-12)
        np.testing.assert_allclose(se3.rotation(np.array([w, x, y, z]) * 3), R, atol=1e-12)


def test_rotation_vectors_equal_those_of_scipy() -> None:
    rng = np.random.default_rng(2)
    vectors = rng.normal(size=(300, 3)) * 10.0 ** rng.uniform(-8, 0.5, (300, 1))
    for R in Rotation.from_rotvec(vectors).as_matrix():
        expected = Rotation.from_matrix(R).as_rotvec()
        np.testing.assert_allclose(se3.rotation_vector(R), expected, rtol=1e-12, atol=1e-15)


def test_rotation_vector_of_a_matrix_with_errors_is_that_of_the_nearest_rotation() -> None:
    R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    np.testing.assert_allclose(se3.rotation_vector(1.001 * R), [0.3, -0.2, 0.5], atol=1e-12)


def test_quaternion_of_a_mirror_image_is_refused() -> None:
    with pytest.raises(ValueError, match="determinant"):
        se3.quaternion(-np.eye(3))


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0]])
def test_quaternion_of_a_half_turn_keeps_its_precision(axis: list[float]) -> None:
    R = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    np.testing.assert_allclose(se3.rotation(se3.quaternion(R)), R, atol=1e-12)


def test_rotation_of_integer_quaternions_is_not_truncated() -> None:
    np.testing.assert_allclose(
        se3.rotation(np.array([3, 1, 0, 0])), Rotation.from_quat([1, 0, 0, 3]).as_matrix()
    )


def test_rotations_keep_float32_and_batches() -> None:
    q = np.ones((2, 5, 4), np.float32)
    assert se3.rotation(q).shape == (2, 5, 3, 3)
    assert se3.rotation(q).dtype == np.float32


def test_inverse_of_a_batch_cancels_each_transform() -> None:
    T = np.array([se3.exp(tangent(1.0, seed)) for seed in range(6)]).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(se3.inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-14)


def test_orthonormalized_finds_the_nearest_rotation() -> None:
    T = se3.exp(tangent(2.0))
    noisy = T.copy()
    noisy[:3, :3] += np.random.default_rng(2).normal(0, 1e-4, (3, 3))
    nearest = se3.orthonormalize(noisy)
    np.testing.assert_allclose(nearest[:3, :3] @ nearest[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.norm(nearest - noisy) <= np.linalg.norm(T - noisy)
    np.testing.assert_array_equal(nearest[:3, 3], noisy[:3, 3])


def test_orthonormalized_never_mirrors() -> None:
    assert np.linalg.det(se3.orthonormalize(np.diag([1.0, 1.0, -1.0, 1.0]))[:3, :3]) > 0


def test_adjoint_moves_a_perturbation_to_the_left() -> None:
    T, xi = se3.exp(tangent(1.1, 3)), tangent(0.4, 4)
    np.testing.assert_allclose(T @ se3.exp(xi), se3.exp(se3.adjoint(T) @ xi) @ T, atol=1e-13)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-8, 1e-3, 1.0, 3.0, np.pi])
def test_rotation_angle_is_the_length_of_the_rotation_vector(angle_rad: float) -> None:
    assert se3.rotation_angle(se3.exp(tangent(angle_rad))) == pytest.approx(angle_rad, abs=1e-12)


def test_transform_applies_rotation_then_translation_to_any_batch() -> None:
    T = se3.from_quaternion(np.array([1.0, 2, 3]), np.array([1.0, 0, 0, 1]))  # 90 degrees about z.
    points = np.broadcast_to([1.0, 0, 0], (2, 4, 3))
    np.testing.assert_allclose(se3.transform(T, points), np.broadcast_to([1, 3, 3], (2, 4, 3)))


def test_transforms_differ_by_distance_or_by_angle() -> None:
    rng = np.random.default_rng(0)
    T = np.array([se3.exp(rng.normal(size=6)) for _ in range(4)])
    steps = np.array([[0, 0, 0, 0, 0, 9e-4], [0, 0, 0, 0, 2e-3, 0], [9e-5, 0, 0, 0, 0, 0]])
    other = T.copy()
    for k, xi in enumerate((*steps, np.array([0, 2e-4, 0, 0, 0, 0]))):
        other[k] = T[k] @ se3.exp(xi)
    assert se3.transforms_differ(T, other, 1e-3, 1e-4).tolist() == [False, True, False, True]
    assert se3.transforms_differ(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), 1, 1).shape == (0,)
