import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError
from ldo_service.tracking.pose_covariance import (
    BRIGHTNESS_PRIOR,
    CovarianceConfig,
    contradiction,
    inverse_of,
    pose_covariance,
    without_brightness,
)
from tests.bench.bench_covariance import errors_and_covariances

CELLS, POINTS = 48, 40  # Points of each cell.


def jacobians(rng: np.random.Generator) -> np.ndarray:
    """Return Jacobians [CELLS, POINTS, 8] that differ more between cells than within a cell."""
    by_cell = rng.normal(size=(CELLS, 1, 8))
    return 100 * by_cell + 10 * rng.normal(size=(CELLS, POINTS, 8))


def nees_of_sandwich_and_hessian(correlation: float) -> tuple[float, float]:
    """Return the mean NEES by the sandwich covariance, and by the inverse Hessian alone.

    The noise of the least squares is correlated within each cell.
    """
    rng = np.random.default_rng(3)
    config = CovarianceConfig(scale=0.5, floor_rad=1e-12, floor_m=1e-12)
    J = jacobians(rng)
    flat = J.reshape(-1, 8)
    hessian = flat.T @ flat
    sandwich, plain = [], []
    for _ in range(400):
        common = np.sqrt(correlation) * rng.normal(size=(CELLS, 1))
        noise = common + np.sqrt(1 - correlation) * rng.normal(size=(CELLS, POINTS))
        x = np.linalg.solve(hessian, flat.T @ noise.ravel())
        residuals = noise - J @ x
        gradients = np.einsum("cpk,cp->ck", J, residuals)
        covariance = pose_covariance(hessian, gradients, config)
        sandwich.append(x[:6] @ np.linalg.solve(covariance, x[:6]))
        plain.append(x[:6] @ without_brightness(hessian) @ x[:6])
    return float(np.mean(sandwich)), float(np.mean(plain))


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.9])
def test_covariance_fits_the_errors_of_correlated_residuals(correlation: float) -> None:
    sandwich, plain = nees_of_sandwich_and_hessian(correlation)
    assert 4.5 < sandwich < 9.0  # The expected value is 6; 48 cells estimate it a little too high.
    assert plain > 6 * (1 + 10 * correlation) - 1  # Independent residuals are assumed.


def test_hessian_without_brightness_is_that_of_the_marginal_pose() -> None:
    J = jacobians(np.random.default_rng(4)).reshape(-1, 8)
    hessian = J.T @ J
    with_prior = hessian + np.diag([0.0] * 6 + list(BRIGHTNESS_PRIOR))
    marginal = np.linalg.inv(np.linalg.inv(with_prior)[:6, :6])
    np.testing.assert_allclose(without_brightness(hessian), marginal, rtol=1e-9)


def test_direction_without_residuals_has_a_sigma_of_more_than_a_meter() -> None:
    J = jacobians(np.random.default_rng(5))
    J[..., 4] = 0.0
    gradients = np.einsum("cpk,cp->ck", J, np.ones((CELLS, POINTS)))
    hessian = np.einsum("cpi,cpj->ij", J, J)
    sigmas = np.sqrt(np.diag(pose_covariance(hessian, gradients, CovarianceConfig())))
    assert sigmas[4] > 1
    assert np.delete(sigmas, 4).max() < 0.1


def test_covariance_without_any_residual_is_large() -> None:
    covariance = pose_covariance(np.zeros((8, 8)), np.zeros((96, 8)), CovarianceConfig())
    assert np.linalg.eigvalsh(covariance).min() > 1


def test_settings_that_are_not_positive_are_refused() -> None:
    with pytest.raises(ConfigError, match="floor_m"):
        CovarianceConfig(floor_m=0.0)


@pytest.mark.parametrize("source", ["synthetic:tour", "synthetic:tour-noisy"])
def test_covariance_of_a_tracked_pose_fits_its_error(source: str) -> None:
    errors, covariances = errors_and_covariances(open_sequence(source), 60, is_calibrated=True)
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])
    assert len(nees) > 50
    assert 0.3 < nees.mean() < 12
    assert np.mean(nees > 30) < 0.05


def cues(error: np.ndarray, depth_scale: np.ndarray | float = 1.0) -> tuple[np.ndarray, ...]:
    """Return Hessian and gradient of color and of depth at their common solution.

    The depth residuals are those of a pose that is wrong by `error`, [6]; color has no error. The
    Jacobian of depth is multiplied by `depth_scale`, [6].
    """
    rng = np.random.default_rng(6)
    J_color, J_depth = (jacobians(rng).reshape(-1, 8) for _ in range(2))
    J_depth[:, 6:] = 0.0
    J_depth[:, :6] *= depth_scale
    r_color, r_depth = rng.normal(size=(2, CELLS * POINTS))
    r_depth = r_depth + J_depth[:, :6] @ error
    H_color, H_depth = J_color.T @ J_color, J_depth.T @ J_depth
    x = np.linalg.solve(H_color + H_depth, J_color.T @ r_color + J_depth.T @ r_depth)
    g_color, g_depth = J_color.T @ (r_color - J_color @ x), J_depth.T @ (r_depth - J_depth @ x)
    return H_color, g_color, H_depth[:6, :6], g_depth[:6]


def test_cues_that_agree_do_not_contradict_each_other() -> None:
    assert not contradiction(*cues(np.zeros(6))).any()


@pytest.mark.parametrize("axis", range(6))
def test_contradiction_is_the_error_of_one_cue(axis: int) -> None:
    error = np.zeros(6)
    error[axis] = 0.03
    found = contradiction(*cues(error))
    # The sign is that of the step from the pose by depth to the pose by color.
    np.testing.assert_allclose(np.abs(found), np.abs(error), atol=0.003)


def test_cue_without_information_along_a_direction_contradicts_nothing_there() -> None:
    wall = np.array([1.0, 1.0, 1.0, 1.0, 1e-4, 1.0])
    found = contradiction(*cues(np.array([0.03, 0, 0, 0, 0, 0]), wall))
    assert abs(found[0]) > 0.02
    assert abs(found[4]) < 0.02  # The poses by color and by depth alone differ by more than 1 here.


def test_hessian_that_rounding_makes_indefinite_is_accepted() -> None:
    rng = np.random.default_rng(7)
    J = 1e10 * rng.normal(size=(3, 8))  # Three residuals, as of few pixels at a millimeter.
    J[:, 6:] = 0.0
    hessian, gradient = J.T @ J, J.T @ np.ones(3)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(hessian[:6, :6] + np.eye(6))
    assert np.isfinite(contradiction(hessian, gradient, hessian[:6, :6], gradient[:6])).all()
    covariance = pose_covariance(hessian, gradient[None], CovarianceConfig())
    assert np.linalg.eigvalsh(covariance)[0] > 0


@pytest.mark.parametrize("size", [1e4, 1e6, 1e10, 1e150])
def test_absurd_contradiction_leaves_a_positive_information_matrix(size: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(100):
        direction = rng.normal(size=6)
        direction *= size / np.linalg.norm(direction)
        information = inverse_of(1e-9 * np.eye(6) + np.outer(direction, direction))
        np.testing.assert_allclose(information, information.T, rtol=1e-9)
        assert np.linalg.eigvalsh(information)[0] > 0


def test_covariance_that_is_not_finite_gives_almost_no_information() -> None:
    information = inverse_of(np.full((6, 6), np.inf))
    assert 0 < np.linalg.eigvalsh(information)[0] < 1e-9


def test_usual_covariance_has_the_bits_of_its_inverse() -> None:
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3) + 1e-7
    assert inverse_of(covariance).tobytes() == np.linalg.inv(covariance).tobytes()


@pytest.mark.slow
def test_errors_of_an_uncalibrated_camera_are_within_three_sigma() -> None:
    """Vignetting, depth bias and a rolling shutter move color and depth by several sigma."""
    sequence = open_sequence("synthetic:room-handheld")
    errors, covariances = errors_and_covariances(sequence, 40, is_calibrated=False)
    sigmas = np.sqrt(np.einsum("nii->ni", covariances))
    is_beyond = np.zeros(len(errors), bool)
    for part in (slice(0, 3), slice(3, 6)):
        size, sigma = (np.linalg.norm(each[:, part], axis=1) for each in (errors, sigmas))
        is_beyond |= size > 3 * sigma
    assert len(errors) > 30
    assert is_beyond.mean() < 0.1
