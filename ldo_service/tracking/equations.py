"""Normal equations of direct RGB-D alignment. Conventions: `ldo_service.geometry`.

For every reference point p with grey level s and normal n, seen at p_c = T_camera_reference p:

    photometric   r = I(project(p_c)) - gain s - bias
    geometric     r = (R n) . (p_c - q),  q the camera's surface at the nearest pixel

weighted by a t-distribution with 5 degrees of freedom, w = 6 / (5 + (r / sigma)^2) / sigma^2
(Kerl, Sturm and Cremers, "Robust odometry estimation for RGB-D cameras", 2013, III). Unknowns are
rotation and translation of T_reference_camera * exp(xi), then gain and bias.
"""

from dataclasses import dataclass, field

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.kernels import _align

from .noise import DepthNoise
from .pyramid import Level

DEGREES_OF_FREEDOM = 5.0  # Kerl et al. 2013, III.B; the kernel has the same
INLIER_SIGMA = 3.0


@dataclass(frozen=True, slots=True)
class ResidualConfig:
    noise: DepthNoise = field(default_factory=DepthNoise)
    gate: float = 0.1  # relative depth difference beyond which points are no pair
    occlusion: float = 0.08  # relative; a point this far behind the surface is hidden

    def __post_init__(self) -> None:
        if not (self.gate > 0 and self.occlusion > 0):
            raise ConfigError(f"gate={self.gate:g}, occlusion={self.occlusion:g}: must be > 0.")


@dataclass(frozen=True, slots=True)
class Appearance:
    """Brightness change and noise, estimated beside the pose."""

    gain: float = 1.0
    bias: float = 0.0  # grey levels
    intensity_sigma: float = 8.0  # grey levels; where estimation starts
    depth_noise_scale: float = 2.0  # times DepthNoise; where estimation starts


@dataclass(frozen=True, slots=True)
class Term:
    """One kind of residual: how many, how many within 3 sigma, and sum of w (r / sigma)^2."""

    count: float
    inliers: float
    square: float

    @property
    def inlier_fraction(self) -> float:
        return self.inliers / self.count if self.count else 0.0


@dataclass(frozen=True, slots=True)
class Equations:
    """hessian [8, 8] and gradient [8] of half the weighted squares; `visible` points."""

    hessian: np.ndarray
    gradient: np.ndarray
    visible: float
    photometric: Term
    geometric: Term


def normal_equations(
    points: np.ndarray,
    target: Level,
    T_camera_reference: np.ndarray,
    appearance: Appearance,
    config: ResidualConfig,
) -> Equations:
    """Linearise all residuals of points [7, N] (see `Reference`) in a target level.

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
    return Equations(hessian, gradient, counts[0], Term(*counts[1:4]), Term(*counts[4:7]))
