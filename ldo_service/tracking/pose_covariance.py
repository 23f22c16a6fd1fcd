"""Covariance of the pose that alignment estimates.

The residuals of neighboring points have correlated errors. For example, a reflection, a blurred
edge or a depth bias changes many residuals alike. The inverse Hessian H^-1 of the normal equations
is a covariance for independent residuals. It is therefore too small, by a factor that depends on
the sensor. This module computes the covariance as

    scale (H^-1 S H^-1 + max(tr(H^-1 S) / 6, 1) H^-1) + floor.

The image is divided into cells. Each cell has two gradients g of its residuals at the pose: one for
color and one for depth. S is the sum of g g^T over all these gradients. `CovarianceConfig` sets the
factor `scale` and the standard deviations of the diagonal matrix `floor`. `PRIOR` makes H regular.

The first term is the sandwich estimator (Liang and Zeger, "Longitudinal data analysis using
generalized linear models", 1986). It grows where cells, or color and depth, contradict each other.
The second term has the shape of H^-1 and the mean size of the first term. It covers directions in
which the few gradients are small by coincidence. Its factor is at least 1, the value for
independent residuals.

The spread of the gradients does not reveal an error that is common to all cells, such as a depth
bias that looks like a rotation. Color and depth then favor different poses. The function
`contradiction` therefore compares the pose from color alone with the pose from depth alone. The
covariance grows along the directions in which these poses contradict each other.
Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError, named

POSE, BRIGHTNESS = slice(0, 6), slice(6, 8)
# Prior of gain and bias as inverse variances: standard deviations of 3 % and of 3 gray levels.
BRIGHTNESS_PRIOR = np.array([1e3, 0.1])
BRIGHTNESS_INFORMATION = np.diag(BRIGHTNESS_PRIOR)
# Information that is added to the Hessian of the pose: 1 rad and 1 m. It only acts in
# directions that the residuals do not constrain.
PRIOR = np.eye(6)
ROUNDING = 1e-12  # Smallest ratio of two variances with which a covariance can be inverted.
# Minimum squared difference of color and depth along a direction, divided by its variance, at which
# they contradict each other. The variance takes all residuals as independent. A frame has such a
# direction in 10 to 23 % of the frames of exact cameras, and in all frames of a simulated handheld
# camera without self-calibration, where the median of the largest ratio is 1300.
MIN_CONTRADICTION = 20.0
MIN_CONDITION = 1e-15  # Fraction of the largest eigenvalue; double precision resolves no less.


@dataclass(frozen=True, slots=True)
class CovarianceConfig:
    """Settings of the covariance of a pose.

    The defaults were chosen on sequences with exact ground truth, by the mean normalized estimation
    error squared (NEES), whose expected value is 6. docs/benchmarks/covariance.md has its values.
    """

    scale: float = 5.0  # Factor on the covariance, before the floor is added.
    # Minimum standard deviations: errors of the linear interpolation of images.
    floor_rad: float = 3e-5
    floor_m: float = 5e-5

    def __post_init__(self) -> None:
        names = "scale", "floor_rad", "floor_m"
        if min(getattr(self, name) for name in names) <= 0:
            raise ConfigError(named(self, *names) + " must be positive.")


def without_brightness(hessian: np.ndarray) -> np.ndarray:
    """Return the Hessian [6, 6] of the pose; a Schur complement marginalizes gain and bias.

    Args:
        hessian: Hessian of pose, gain and bias, [8, 8].
    """
    return hessian[POSE, POSE] - hessian[POSE, BRIGHTNESS] @ _by_brightness(hessian)


def _by_brightness(hessian: np.ndarray) -> np.ndarray:
    """Return the change of gain and bias by a change of the pose, negated, [2, 6]."""
    brightness = hessian[BRIGHTNESS, BRIGHTNESS] + BRIGHTNESS_INFORMATION
    return np.linalg.solve(brightness, hessian[BRIGHTNESS, POSE])


def pose_covariance(
    hessian: np.ndarray, gradients: np.ndarray, config: CovarianceConfig
) -> np.ndarray:
    """Return the covariance [6, 6] of a pose, rotation first, in rad^2 and m^2.

    A direction that the residuals do not constrain has a standard deviation of at least
    sqrt(config.scale) rad or m.

    Args:
        hessian: Hessian of pose, gain and bias at the pose, [8, 8].
        gradients: Gradients of N groups of residuals, [N, 8]. The errors of different groups are
            taken as independent.
        config: Settings.
    """
    by_brightness = _by_brightness(hessian)
    g = gradients[:, POSE] - gradients[:, BRIGHTNESS] @ by_brightness
    H = hessian[POSE, POSE] - hessian[POSE, BRIGHTNESS] @ by_brightness
    root = _inverse_root(H + PRIOR)
    normalized = g @ root.T
    errors = normalized @ root  # Errors of the pose by the gradient of each group.
    ratio = max(float(np.sum(normalized**2)) / 6, 1.0)
    floor = np.diag([config.floor_rad**2] * 3 + [config.floor_m**2] * 3)
    return config.scale * (errors.T @ errors + ratio * (root.T @ root)) + floor


def inverse_of(covariance: np.ndarray) -> np.ndarray:
    """Return the information matrix [6, 6] of a pose, the inverse of its covariance.

    If color and depth of a frame contradict each other by an absurd amount, one variance is so
    large that the rounded covariance has no positive inverse. Its small variances are then raised
    to a fraction of the large one. If it is not finite, the information is almost zero.
    """
    if not np.isfinite(covariance).all():
        return ROUNDING * np.eye(len(covariance))
    variances, directions = np.linalg.eigh(covariance)
    least = ROUNDING * variances[-1]
    if variances[0] >= least:
        return np.linalg.inv(covariance)
    return (directions / np.maximum(variances, least)) @ directions.T


def contradiction(
    color_hessian: np.ndarray,
    color_gradient: np.ndarray,
    depth_hessian: np.ndarray,
    depth_gradient: np.ndarray,
) -> np.ndarray:
    """Return the difference between the poses from color and from depth that noise cannot explain.

    The difference is tested along each direction v with H_color v = share (H_color + H_depth) v.
    Here color has the fraction `share` of the information along v, and depth has the rest. A pose
    from a small fraction of the information has a large variance along v. Such a pose cannot
    contradict the other pose along v.

    Args:
        color_hessian: Hessian of the color residuals for pose, gain and bias, [8, 8].
        color_gradient: Gradient of the color residuals at the pose, [8].
        depth_hessian: Hessian of the depth residuals for the pose, [6, 6].
        depth_gradient: Gradient of the depth residuals at the pose, [6].

    Returns:
        The increment xi [6] from the pose by depth to the pose by color, to first order. The
        increment has only the directions along which the two poses contradict each other. It is 0
        if there are none.
    """
    by_brightness = _by_brightness(color_hessian)
    g_color = color_gradient[POSE] - color_gradient[BRIGHTNESS] @ by_brightness
    H_color = color_hessian[POSE, POSE] - color_hessian[POSE, BRIGHTNESS] @ by_brightness
    root = _inverse_root(H_color + depth_hessian + PRIOR)
    share, directions = np.linalg.eigh(root @ H_color @ root.T)
    share = share.clip(1e-6, 1 - 1e-6)
    V = root.T @ directions
    difference = V.T @ depth_gradient / (1 - share) - V.T @ g_color / share
    is_contradicted = difference**2 * share * (1 - share) > MIN_CONTRADICTION
    return np.asarray(V @ np.where(is_contradicted, difference, 0.0))


def _inverse_root(H: np.ndarray) -> np.ndarray:
    """Return R with R H R^T = I for a positive definite matrix H [N, N].

    Eigenvalues below the fraction MIN_CONDITION of the largest one are raised to it. Rounding can
    make them negative: few pixels at a millimeter from the camera have such a Hessian.
    """
    values, Q = np.linalg.eigh(H)
    return np.asarray((Q / np.sqrt(values.clip(MIN_CONDITION * values[-1]))).T)
