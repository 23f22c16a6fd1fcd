import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError
from ldo_service.tracking.pose_covariance import (
    BRIGHTNESS_PRIOR,
    CovarianceConfig,
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
    """Return the mean NEES of least squares with noise that is correlated within each cell."""
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
