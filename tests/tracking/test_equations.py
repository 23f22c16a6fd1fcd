import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.tracking import PyramidConfig, build_reference, pyramid_of
from ldo_service.tracking.alignment import (
    BrightnessModel,
    ResidualConfig,
    ResidualStatistics,
    normal_equations,
)


def test_first_step_is_the_missing_right_perturbation(room) -> None:
    """Far from the reference, left and right perturbations differ by centimeters."""
    T_reference_camera = se3.exp(np.array([0.05, 0.3, -0.1, 0.4, 0.1, 0.2]))
    xi = np.array([0.002, -0.001, 0.003, 0.004, -0.003, 0.005])
    guess = T_reference_camera @ se3.exp(-xi)
    points = build_reference(pyramid_of(room.view(np.eye(4)), PyramidConfig())).points[0]
    target = pyramid_of(room.view(T_reference_camera), PyramidConfig()).levels[0]
    e = normal_equations(points, target, se3.inverse(guess), BrightnessModel(), ResidualConfig())
    step = -np.linalg.solve(e.hessian, e.gradient)[:6]
    left = se3.adjoint(T_reference_camera) @ xi
    np.testing.assert_allclose(step, xi, atol=1e-3)
    assert np.linalg.norm(step - xi) < 0.5 * np.linalg.norm(step - left)


def test_inlier_fraction_without_residuals_is_zero() -> None:
    assert ResidualStatistics(0, 0, 0.0).inlier_fraction == 0.0
    assert ResidualStatistics(8, 6, 1.0).inlier_fraction == 0.75


def test_occluded_points_are_not_visible(room) -> None:
    points = build_reference(pyramid_of(room.view(np.eye(4)), PyramidConfig())).points[0]
    view = room.view(np.eye(4))
    view.depth_m[:, :80] *= 0.5  # An occluder covers the left half.
    target = pyramid_of(view, PyramidConfig()).levels[0]
    e = normal_equations(points, target, np.eye(4), BrightnessModel(), ResidualConfig())
    assert e.visible == pytest.approx(points.shape[1] / 2, rel=0.05)


def test_gate_of_zero_is_rejected() -> None:
    with pytest.raises(ConfigError, match="gate"):
        ResidualConfig(gate=0.0)
