"""Tests of rigid motions from correspondences against SciPy and with outliers."""

import numpy as np
from scipy.spatial.transform import Rotation

from ldo_service.geometry import se3
from ldo_service.geometry.se3 import fit_rigid_transform
from ldo_service.loop_closing.pose_estimation import ransac_rigid


def corresponding_points(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return T_a_b [4, 4] and ten points in both frames, [10, 3] each."""
    T_a_b = se3.exp(rng.normal(size=6))
    p_b = rng.uniform(-3, 3, (10, 3))
    return T_a_b, se3.transform(T_a_b, p_b), p_b


def test_rigid_fit_equals_scipy() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        _, p_a, p_b = corresponding_points(rng)
        p_a = p_a + rng.normal(0, 0.2, p_a.shape)
        expected, _ = Rotation.align_vectors(p_a - p_a.mean(axis=0), p_b - p_b.mean(axis=0))
        T = fit_rigid_transform(p_b, p_a)
        np.testing.assert_allclose(T[:3, :3], expected.as_matrix(), atol=1e-12)
        np.testing.assert_allclose(se3.transform(T, p_b.mean(axis=0)), p_a.mean(axis=0))


def test_ransac_finds_the_true_motion_among_two_thirds_outliers() -> None:
    rng = np.random.default_rng(1)
    T_a_b, p_a, p_b = corresponding_points(rng)
    p_a = p_a + rng.normal(0, 0.02, p_a.shape)
    pairs = np.array([(a, b) for a in range(10) for b in (a, (a + 3) % 10, (a + 7) % 10)])
    motion = ransac_rigid(p_a, p_b, pairs, 0.25, 400, np.random.default_rng(0))
    assert motion is not None
    assert pairs[motion.inliers].tolist() == [[k, k] for k in range(10)]
    np.testing.assert_allclose(motion.T_a_b, T_a_b, atol=0.05)
    repeated = ransac_rigid(p_a, p_b, pairs, 0.25, 400, np.random.default_rng(0))
    assert repeated is not None
    assert repeated.T_a_b.tobytes() == motion.T_a_b.tobytes()


def test_collinear_points_give_no_pose() -> None:
    p = np.outer(np.arange(5.0), [1.0, 0, 0])
    pairs = np.column_stack([np.arange(5)] * 2)
    assert ransac_rigid(p, p, pairs, 0.25, 50, np.random.default_rng(0)) is None


def test_two_correspondences_give_no_pose() -> None:
    p = np.eye(3)
    assert (
        ransac_rigid(p, p, np.array([[0, 0], [1, 1]]), 0.25, 50, np.random.default_rng(0)) is None
    )
