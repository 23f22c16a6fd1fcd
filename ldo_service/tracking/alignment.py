"""Coarse-to-fine direct alignment of an RGB-D frame to a reference. `ldo_service.geometry`.

For every reference point p with grey level s and normal n, seen at p_c = T_camera_reference p:

    photometric   r = I(project(p_c)) - gain s - bias
    geometric     r = (R n) . (p_c - q),  q the camera's surface at the nearest pixel

weighted by a t-distribution with 5 degrees of freedom, w = 6 / (5 + (r / sigma)^2) / sigma^2
(Kerl, Sturm and Cremers, "Robust odometry estimation for RGB-D cameras", 2013, III). Unknowns are
rotation and translation of T_reference_camera * exp(xi), then gain and bias.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.kernels import _align

from .pyramid import DepthNoise, Level, Pyramid, ReferencePoints

DEGREES_OF_FREEDOM = 5.0  # Kerl et al. 2013, III.B; the kernel has the same
INLIER_SIGMA = 3.0

POSE, BRIGHTNESS = slice(0, 6), slice(6, 8)
BRIGHTNESS_PRIOR = np.array([1e3, 0.1])  # inverse variances: gain within 3 %, bias within 3 levels


@dataclass(frozen=True, slots=True)
class ResidualConfig:
    noise: DepthNoise = field(default_factory=DepthNoise)
    gate: float = 0.1  # relative depth difference beyond which points are no pair
    occlusion: float = 0.08  # relative; a point this far behind the surface is hidden

    def __post_init__(self) -> None:
        if not (self.gate > 0 and self.occlusion > 0):
            raise ConfigError(f"gate={self.gate:g}, occlusion={self.occlusion:g}: must be > 0.")


@dataclass(frozen=True, slots=True)
class BrightnessModel:
    """Brightness change and noise, estimated beside the pose."""

    gain: float = 1.0
    bias: float = 0.0  # grey levels
    intensity_sigma: float = 8.0  # grey levels; where estimation starts
    depth_noise_scale: float = 2.0  # times DepthNoise; where estimation starts


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """One kind of residual: how many, how many within 3 sigma, and sum of w (r / sigma)^2."""

    count: float
    inliers: float
    square: float

    @property
    def inlier_fraction(self) -> float:
        return self.inliers / self.count if self.count else 0.0


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """hessian [8, 8] and gradient [8] of half the weighted squares; `visible` points."""

    hessian: np.ndarray
    gradient: np.ndarray
    visible: float
    photometric: ResidualStatistics
    geometric: ResidualStatistics


def normal_equations(
    points: np.ndarray,
    target: Level,
    T_camera_reference: np.ndarray,
    appearance: BrightnessModel,
    config: ResidualConfig,
) -> NormalEquations:
    """Linearise all residuals of points [7, N] (see `ReferencePoints`) in a target level.

    Raises ValueError for arrays of another shape or a transform that is not rigid. Bitwise
    reproducible on one instruction set.
    """
    hessian, gradient, counts = _align.normal_equations(
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
    )
    return NormalEquations(
        hessian,
        gradient,
        counts[0],
        ResidualStatistics(*counts[1:4]),
        ResidualStatistics(*counts[4:7]),
    )


@dataclass(frozen=True, slots=True)
class AlignConfig:
    residuals: ResidualConfig = field(default_factory=ResidualConfig)
    start: BrightnessModel = field(default_factory=BrightnessModel)
    iterations: tuple[int, ...] = (8, 8, 10, 10)  # at most, per level, the finest first
    stop_px: float = 0.02  # image motion of the last step, at the level's resolution
    largest_step: float = 0.15  # rad, and fraction of the median depth: one step's limit
    damping: float = 1e-6  # of the diagonal: directions that nothing observes stay put
    least_intensity_sigma: float = 1.0  # grey levels: rounding and interpolation
    least_depth_noise_scale: float = 0.2  # 0.24 mm at the noise floor: rounding to millimetres
    # Neighbouring residuals share their errors, so N of them inform less than N: errors fit a
    # fraction of 0.1 on exact renders, and of 1e-4 (next frame) to 3e-5 (half a second) on a
    # Kinect against KinectFusion, whose own error is in that. The value lies between, unproven.
    independent_fraction: float = 2e-3

    def __post_init__(self) -> None:
        if not self.iterations or min(self.iterations) < 1:
            raise ConfigError(f"iterations={self.iterations}: at least 1 for each level.")
        if min(self.stop_px, self.largest_step, self.independent_fraction) <= 0:
            raise ConfigError("stop_px, largest_step and independent_fraction must be positive.")
        if min(self.least_intensity_sigma, self.least_depth_noise_scale) <= 0:
            raise ConfigError("the least noise of intensity and depth must be positive.")


@dataclass(frozen=True, slots=True)
class Alignment:
    """Pose of a camera in its reference, and how far to trust it.

    information is [6, 6] of T_reference_camera * exp(xi), rotation rad then translation m.
    """

    T_reference_camera: np.ndarray  # [4, 4]
    information: np.ndarray
    photometric_inliers: float  # fraction of the visible points within 3 sigma
    geometric_inliers: float  # fraction of the paired points within 3 sigma
    intensity_sigma: float  # grey levels
    depth_noise_scale: float  # times the sensor model
    overlap: float  # visible fraction of the reference points
    paired: float  # fraction of the reference points that have a depth to compare with
    gain: float
    bias: float  # grey levels
    iterations: int  # over all levels
    converged: bool  # the last step on the finest level was below stop_px
    condition: float  # of the information, translation in median depths; inf if singular

    @property
    def appearance(self) -> BrightnessModel:
        return BrightnessModel(self.gain, self.bias, self.intensity_sigma, self.depth_noise_scale)


def align(
    reference: ReferencePoints,
    frame: Pyramid,
    T_camera_reference: np.ndarray,
    config: AlignConfig,
) -> Alignment:
    """Minimise the residuals of `equations` by Gauss-Newton, from a guess [4, 4].

    Noise of intensity and depth is estimated along the way (Kerl et al. 2013, equation 13), and
    weighs colour against geometry. Deterministic: bitwise equal for equal input.
    """
    T, appearance = se3.orthonormalize(T_camera_reference), config.start
    count, converged = 0, False
    levels = min(len(reference.points), len(frame.levels))
    for level in reversed(range(levels)):
        points, target = reference.points[level], frame.levels[level]
        for _ in range(config.iterations[min(level, len(config.iterations) - 1)]):
            equations = normal_equations(points, target, T, appearance, config.residuals)
            step = _step(equations, reference.median_depth_m, config)
            T = se3.exp(-step[POSE]) @ T
            appearance = _improved(appearance, step, equations, config)
            count += 1
            converged = _image_motion_px(step, target, reference) < config.stop_px
            if converged:
                break
    return evaluate(reference, frame, T, appearance, config, count, converged)


def evaluate(
    reference: ReferencePoints,
    frame: Pyramid,
    T_camera_reference: np.ndarray,
    appearance: BrightnessModel,
    config: AlignConfig,
    iterations: int = 0,
    converged: bool = True,
) -> Alignment:
    """The alignment that a pose [4, 4] and an appearance make, measured on the finest level."""
    T = se3.orthonormalize(T_camera_reference)
    points = reference.points[0]
    e = normal_equations(points, frame.levels[0], T, appearance, config.residuals)
    information = _pose_information(e) * config.independent_fraction
    total = max(points.shape[1], 1)
    return Alignment(
        T_reference_camera=se3.inverse(T),
        information=information,
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
        condition=_condition(information, reference.median_depth_m),
    )


def _step(equations: NormalEquations, median_depth_m: float, config: AlignConfig) -> np.ndarray:
    hessian = equations.hessian.copy()
    hessian[BRIGHTNESS, BRIGHTNESS] += np.diag(BRIGHTNESS_PRIOR)
    hessian[np.diag_indices(8)] += config.damping * np.diag(hessian) + 1e-9
    step = -np.linalg.solve(hessian, equations.gradient)
    size = max(np.linalg.norm(step[:3]), np.linalg.norm(step[3:6]) / median_depth_m)
    if size > config.largest_step:
        step[POSE] *= config.largest_step / size
    return step


def _improved(
    appearance: BrightnessModel, step: np.ndarray, equations: NormalEquations, config: AlignConfig
) -> BrightnessModel:
    sigma = _rescaled(appearance.intensity_sigma, equations.photometric)
    scale = _rescaled(appearance.depth_noise_scale, equations.geometric)
    return replace(
        appearance,
        gain=appearance.gain + float(step[6]),
        bias=appearance.bias + float(step[7]),
        intensity_sigma=max(sigma, config.least_intensity_sigma),
        depth_noise_scale=max(scale, config.least_depth_noise_scale),
    )


def _rescaled(sigma: float, term: ResidualStatistics) -> float:
    return sigma * (term.square / term.count) ** 0.5 if term.count else sigma


def _image_motion_px(step: np.ndarray, target: Level, reference: ReferencePoints) -> float:
    angle = np.linalg.norm(step[:3]) + np.linalg.norm(step[3:6]) / reference.median_depth_m
    return float(angle * target.camera.fx)


def _pose_information(equations: NormalEquations) -> np.ndarray:
    """The pose's part, gain and bias marginalised (Schur complement)."""
    hessian = equations.hessian
    brightness = hessian[BRIGHTNESS, BRIGHTNESS] + np.diag(BRIGHTNESS_PRIOR)
    cross = hessian[POSE, BRIGHTNESS]
    return hessian[POSE, POSE] - cross @ np.linalg.solve(brightness, cross.T)


def _condition(information: np.ndarray, median_depth_m: float) -> float:
    units = np.repeat([1.0, median_depth_m], 3)
    eigenvalues = np.linalg.eigvalsh(information * np.outer(units, units))
    smallest, largest = eigenvalues[0], eigenvalues[-1]
    return float(largest / smallest) if smallest > 1e-12 * largest > 0 else float("inf")
