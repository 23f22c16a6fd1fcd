"""Coarse-to-fine direct alignment of an RGB-D frame to a reference keyframe.

A reference point p with gray level s and normal n lies at p_c = T_camera_reference p in the camera.
Each point has two residuals:

    photometric   r = I(project(p_c)) - gain s - bias
    geometric     r = (R n) . (p_c - q)

I is the gray image of the frame, and R is the rotation of T_camera_reference. q is the 3D point
that the frame's depth image measures at the pixel nearest to project(p_c).

Alignment minimizes the sum of w r^2 / sigma^2, where sigma is the noise of the residual. The
weights follow a t-distribution with 5 degrees of freedom, w = 6 / (5 + (r / sigma)^2) (Kerl, Sturm
and Cremers, "Robust odometry estimation for RGB-D cameras", 2013, III). The unknowns are gain, bias
and the pose increment xi, which changes the pose to T_reference_camera * exp(xi). Conventions:
`ldo_service.geometry`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.kernels import _align

from .pose_covariance import (
    BRIGHTNESS,
    BRIGHTNESS_PRIOR,
    POSE,
    CovarianceConfig,
    contradiction,
    inverse_of,
    pose_covariance,
    without_brightness,
)
from .pyramid import DepthNoise, Level, Pyramid, ReferencePoints

DEGREES_OF_FREEDOM = 5.0  # Kerl et al. 2013, III.B; the kernel uses the same value.
INLIER_SIGMA = 3.0
# Noise that removes one kind of residuals from the normal equations: gray levels, or a multiple of
# `DepthNoise`.
NO_WEIGHT = 1e5
CUE_LEVEL = 1  # Pyramid level on which color and depth are compared; a quarter of the points.


@dataclass(frozen=True, slots=True)
class ResidualConfig:
    """Settings of the photometric and geometric residuals."""

    noise: DepthNoise = field(default_factory=DepthNoise)
    # Largest depth difference between a point and its measured point q, as a fraction of depth.
    gate: float = 0.1
    # Minimum distance of a hidden point behind the measured surface, as a fraction of the measured
    # depth.
    occlusion: float = 0.08

    def __post_init__(self) -> None:
        if not (self.gate > 0 and self.occlusion > 0):
            raise ConfigError(
                f"ResidualConfig.gate={self.gate:g} and occlusion={self.occlusion:g} must be "
                "positive."
            )


@dataclass(frozen=True, slots=True)
class BrightnessModel:
    """Brightness change and residual noise of a frame relative to its reference keyframe.

    Alignment starts from the default gain, bias and noise, and estimates them with the pose.
    """

    gain: float = 1.0
    bias: float = 0.0  # Gray levels.
    intensity_sigma: float = 8.0  # Photometric noise, gray levels.
    depth_noise_scale: float = 2.0  # Geometric noise as a multiple of `DepthNoise`.


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Statistics of the photometric or of the geometric residuals."""

    count: float  # Number of residuals.
    inliers: float  # Number of residuals within 3 sigma.
    square: float  # Sum of w (r / sigma)^2.

    @property
    def inlier_fraction(self) -> float:
        """Fraction of the residuals within 3 sigma; 0 if there are no residuals."""
        return self.inliers / self.count if self.count else 0.0


class NormalEquations(NamedTuple):
    """Gauss-Newton approximation of half the sum of weighted squared residuals.

    The order of the unknowns is the pose increment xi [6], gain, bias.
    """

    hessian: np.ndarray  # [8, 8]
    gradient: np.ndarray  # [8]
    visible: float  # Number of points inside the image and not hidden.
    photometric: ResidualStatistics
    geometric: ResidualStatistics
    # Gradients of the photometric and of the geometric residuals, summed over each image cell,
    # [C, 2, 8]; empty if the equations were computed without cells.
    cells: np.ndarray


def normal_equations(
    points: np.ndarray,
    target: Level,
    T_camera_reference: np.ndarray,
    appearance: BrightnessModel,
    config: ResidualConfig,
    cells: np.ndarray | None = None,
) -> NormalEquations:
    """Linearize the residuals of reference points in one pyramid level of a frame.

    Equal input gives a bitwise equal result on CPUs with the same instruction set.

    Args:
        points: Reference points, [7, N]; see `ReferencePoints`.
        target: Pyramid level of the frame.
        T_camera_reference: Pose at which the residuals are linearized, [4, 4].
        appearance: Brightness change and noise.
        config: Settings of the residuals.
        cells: Image cell of each point, [N] uint8 below 64; see `ReferencePoints.cells`. None if
            the gradients of each cell are not needed.

    Raises:
        ValueError: An array has a wrong shape, or the transform is not rigid.
    """
    hessian, gradient, counts, by_cell = _align.normal_equations(
        points,
        target.texels,
        target.intrinsics,
        T_camera_reference,
        appearance.gain,
        appearance.bias,
        appearance.intensity_sigma,
        appearance.depth_noise_scale,
        config.noise.coefficients,
        config.gate,
        config.occlusion,
        cells,
    )
    return NormalEquations(
        hessian,
        gradient,
        counts[0],
        ResidualStatistics(*counts[1:4]),
        ResidualStatistics(*counts[4:7]),
        by_cell,
    )


# Computation of normal equations, with the arguments of `normal_equations`.
Linearizer = Callable[..., NormalEquations]


@dataclass(frozen=True, slots=True)
class AlignConfig:
    """Settings of direct alignment."""

    residuals: ResidualConfig = field(default_factory=ResidualConfig)
    # Brightness change and noise from which alignment starts.
    start: BrightnessModel = field(default_factory=BrightnessModel)
    iterations: tuple[int, ...] = (8, 8, 10, 10)  # Maximum per level, the finest first.
    # A pyramid level has converged when a step moves its image by fewer pixels than this.
    stop_px: float = 0.02
    # Limit of one step: rotation in rad, and translation as a fraction of the median depth.
    max_step: float = 0.15
    # Damping of the normal equations as a fraction of their diagonal, so that directions which the
    # residuals do not constrain stay fixed.
    damping: float = 1e-6
    # Lower bound of the photometric noise, gray levels: the noise of rounding and interpolation.
    min_intensity_sigma: float = 1.0
    # Lower bound of the geometric noise as a multiple of `DepthNoise`: 0.24 mm at short
    # range, where `DepthNoise` is 1.2 mm. It covers depth that is rounded to millimeters.
    min_depth_noise_scale: float = 0.2
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    # Lower bound of the geometric noise while the depth may have an unknown smooth bias, as a
    # multiple of `DepthNoise`. A smooth bias does not look like noise, so biased residuals would
    # weigh as much as exact ones. With a bound of 5, the trajectory error (ATE) on the sequence
    # tour-handheld falls from 1.6 to 1.1 cm. On sequences without a bias, it changes by at most
    # 0.04 cm.
    biased_depth_noise_scale: float = 5.0
    # Factor on the covariance while the depth may have an unknown smooth bias. With two simulated
    # cameras, the squared errors of the first 20 frames were ten times those of the later frames.
    biased_covariance_scale: float = 10.0

    def with_bias(self, relative_sigma: float) -> "AlignConfig":
        """Return the settings for a camera whose depth bias is uncertain.

        Args:
            relative_sigma: Standard deviation of the bias, divided by its value for an uncalibrated
                camera. 0 means no bias, and 1 means no calibration; see `CameraKnowledge`.
        """
        if not relative_sigma:
            return self
        noise = max(relative_sigma * self.biased_depth_noise_scale, self.min_depth_noise_scale)
        factor = 1.0 + (self.biased_covariance_scale - 1.0) * relative_sigma**2
        covariance = replace(self.covariance, scale=factor * self.covariance.scale)
        return replace(self, min_depth_noise_scale=noise, covariance=covariance)

    def __post_init__(self) -> None:
        if not self.iterations or min(self.iterations) < 1:
            raise ConfigError(
                f"AlignConfig.iterations={self.iterations} must have at least 1 iteration for each "
                "level."
            )
        names = (
            *("stop_px", "max_step", "min_intensity_sigma", "min_depth_noise_scale"),
            *("biased_depth_noise_scale", "biased_covariance_scale"),
        )
        if min(getattr(self, name) for name in names) <= 0:
            raise ConfigError(named(self, *names) + " must be positive.")


@dataclass(frozen=True, slots=True)
class Alignment:
    """Pose of a camera relative to its reference keyframe, with quality measures."""

    T_reference_camera: np.ndarray  # [4, 4]
    # [6, 6] for T_reference_camera * exp(xi), xi = (rotation rad, translation m).
    information: np.ndarray
    photometric_inliers: float  # Fraction of the visible points within 3 sigma.
    # Fraction within 3 sigma, of the points that are paired with a measured depth.
    geometric_inliers: float
    intensity_sigma: float  # Photometric noise, gray levels.
    depth_noise_scale: float  # Geometric noise as a multiple of `DepthNoise`.
    overlap: float  # Visible fraction of the reference points.
    paired: float  # Fraction of the reference points that are paired with a measured depth.
    gain: float  # Gray level of the frame divided by that of the keyframe.
    bias: float  # Gray levels.
    iterations: int  # Sum over all levels.
    converged: bool  # The last step on the finest level was below stop_px.
    # Condition number of the Hessian, with translation in median depths; inf if singular.
    condition: float
    # Difference of the poses by color and by depth where they contradict each other, [6]; see
    # `pose_covariance.contradiction`.
    contradiction: np.ndarray = field(default_factory=lambda: np.zeros(6))

    @property
    def appearance(self) -> BrightnessModel:
        """Brightness change and noise that were estimated with the pose."""
        return BrightnessModel(self.gain, self.bias, self.intensity_sigma, self.depth_noise_scale)


def align(
    reference: ReferencePoints,
    frame: Pyramid,
    T_camera_reference: np.ndarray,
    config: AlignConfig,
    linearize: Linearizer = normal_equations,
) -> Alignment:
    """Align a frame to reference points by Gauss-Newton, from an initial guess.

    Each iteration also estimates the noise of intensity and depth (Kerl et al. 2013, equation 13).
    The noise sets the relative weight of photometric and geometric residuals. Equal input gives a
    bitwise equal result.

    Args:
        reference: Surface points of the reference keyframe.
        frame: Pyramid of the frame.
        T_camera_reference: Initial guess, [4, 4].
        config: Settings.
        linearize: Computation of the normal equations.

    Returns:
        The pose, with its quality on the finest pyramid level.
    """
    T, appearance = se3.orthonormalize(T_camera_reference), config.start
    count, converged = 0, False
    levels = min(len(reference.points), len(frame.levels))
    for level in reversed(range(levels)):
        points, target = reference.points[level], frame.levels[level]
        for _ in range(config.iterations[min(level, len(config.iterations) - 1)]):
            equations = linearize(points, target, T, appearance, config.residuals)
            step = _step(equations, reference.median_depth_m, config)
            T = se3.exp(-step[POSE]) @ T
            appearance = _improved(appearance, step, equations, config)
            count += 1
            converged = _image_motion_px(step, target, reference) < config.stop_px
            if converged:
                break
    return _evaluate(reference, frame, T, appearance, config, count, converged, linearize)


def _evaluate(
    reference: ReferencePoints,
    frame: Pyramid,
    T_camera_reference: np.ndarray,
    appearance: BrightnessModel,
    config: AlignConfig,
    iterations: int,
    converged: bool,
    linearize: Linearizer,
) -> Alignment:
    """Evaluate the residuals of a given pose on the finest pyramid level, without optimization.

    Args:
        reference: Surface points of the reference keyframe.
        frame: Pyramid of the frame.
        T_camera_reference: The pose, [4, 4].
        appearance: Brightness change and noise of the frame.
        config: Settings.
        iterations: Value of `Alignment.iterations` in the result.
        converged: Value of `Alignment.converged` in the result.
        linearize: Computation of the normal equations.
    """
    T = se3.orthonormalize(T_camera_reference)
    points = reference.points[0]
    e = linearize(points, frame.levels[0], T, appearance, config.residuals, reference.cells)
    covariance = pose_covariance(e.hessian, e.cells.reshape(-1, 8), config.covariance)
    difference = _contradiction(reference, frame, T, appearance, config.residuals, linearize)
    covariance += np.outer(difference, difference)
    total = max(points.shape[1], 1)
    return Alignment(
        T_reference_camera=se3.inverse(T),
        information=inverse_of(covariance),
        photometric_inliers=e.photometric.inlier_fraction,
        geometric_inliers=e.geometric.inlier_fraction,
        intensity_sigma=appearance.intensity_sigma,
        depth_noise_scale=appearance.depth_noise_scale,
        overlap=e.visible / total,
        paired=e.geometric.count / total,
        gain=appearance.gain,
        bias=appearance.bias,
        iterations=iterations,
        converged=converged,
        condition=_condition(without_brightness(e.hessian), reference.median_depth_m),
        contradiction=difference,
    )


def _contradiction(
    reference: ReferencePoints,
    frame: Pyramid,
    T_camera_reference: np.ndarray,
    appearance: BrightnessModel,
    config: ResidualConfig,
    linearize: Linearizer,
) -> np.ndarray:
    """Return by how much color and depth contradict each other at a pose, [6]."""
    level = min(CUE_LEVEL, len(frame.levels) - 1, len(reference.points) - 1)
    points, target = reference.points[level], frame.levels[level]
    color, depth = (
        linearize(points, target, T_camera_reference, noise, config)
        for noise in (
            replace(appearance, depth_noise_scale=NO_WEIGHT),
            replace(appearance, intensity_sigma=NO_WEIGHT),
        )
    )
    return contradiction(
        color.hessian, color.gradient, depth.hessian[POSE, POSE], depth.gradient[POSE]
    )


def _step(equations: NormalEquations, median_depth_m: float, config: AlignConfig) -> np.ndarray:
    hessian = equations.hessian.copy()
    diagonal = hessian.reshape(-1)[::9]
    diagonal[BRIGHTNESS] += BRIGHTNESS_PRIOR
    diagonal += config.damping * diagonal + 1e-9
    step = -np.linalg.solve(hessian, equations.gradient)
    size = max(se3.length(step[:3]), se3.length(step[3:6]) / median_depth_m)
    if size > config.max_step:
        step[POSE] *= config.max_step / size
    return step


def _improved(
    appearance: BrightnessModel, step: np.ndarray, equations: NormalEquations, config: AlignConfig
) -> BrightnessModel:
    sigma = _rescaled(appearance.intensity_sigma, equations.photometric)
    scale = _rescaled(appearance.depth_noise_scale, equations.geometric)
    return BrightnessModel(
        gain=appearance.gain + float(step[6]),
        bias=appearance.bias + float(step[7]),
        intensity_sigma=max(sigma, config.min_intensity_sigma),
        depth_noise_scale=max(scale, config.min_depth_noise_scale),
    )


def _rescaled(sigma: float, term: ResidualStatistics) -> float:
    return sigma * (term.square / term.count) ** 0.5 if term.count else sigma


def _image_motion_px(step: np.ndarray, target: Level, reference: ReferencePoints) -> float:
    angle = se3.length(step[:3]) + se3.length(step[3:6]) / reference.median_depth_m
    return angle * target.camera.fx


def _condition(hessian: np.ndarray, median_depth_m: float) -> float:
    units = np.repeat([1.0, median_depth_m], 3)
    eigenvalues = np.linalg.eigvalsh(hessian * np.outer(units, units))
    smallest, largest = eigenvalues[0], eigenvalues[-1]
    return float(largest / smallest) if smallest > 1e-12 * largest > 0 else float("inf")
