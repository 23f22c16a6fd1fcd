"""Factors of the graph: what is measured, and the arrays that hold it in a saved state.

Packed measurements come back as the same bits.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .solver import point_key


@dataclass(frozen=True, slots=True)
class NoiseConfig:
    """What is believed of measurements, beside what they say of themselves."""

    first_sigma: float = 1e-6  # rad and m: the first keyframe is the origin of its component
    sigma_rotation_max_rad: float = 0.2  # a degenerate direction is believed no worse than this,
    sigma_translation_max_m: float = 0.5  # or the linear system becomes singular
    sigma_odometry_rad: float = 0.05  # of odometry over a missed keyframe
    sigma_odometry_m: float = 0.1
    # Alignment counts pixels as independent and knows no bias: on a handheld Kinect its links are
    # off by 7 sigma in the median. A random walk beside it, of the size of 1 % and 0.5 deg/m after
    # some metres: without it no chain could bend as far as a true loop closure asks for.
    drift_rad_per_sqrt_m: float = 0.02
    drift_m_per_sqrt_m: float = 0.02
    turn_m_per_rad: float = 0.5  # a turn without a step drifts as a step of so much per radian
    # Dense refinement counts pixels too; what it cannot see are calibration and exposure
    sigma_loop_rad: float = 0.01
    sigma_loop_m: float = 0.01
    # The centre of a box is not where the mean of an object's Gaussians projects to: what hides
    # part of it, and which side is seen, moves it by a share of its size; detectors add some px.
    sigma_box_px: float = 4.0
    sigma_box_share: float = 0.15
    # That is the same error in all sights of an object from one side, and another from the next, so
    # N of them inform less than N: as many as are kept of a landmark (`landmarks.most_sights`)
    # count as a tenth of one. As one, they moved odometry right to 2 mm by 3 mm (RESULTS).
    independent_sights: float = 1 / 320
    robust_sigmas: float = 2.385  # of Cauchy's kernel: 95 % efficient on Gaussian noise

    def __post_init__(self) -> None:
        optional = ("drift_rad_per_sqrt_m", "drift_m_per_sqrt_m", "turn_m_per_rad")
        sigmas = [name for name in self.__slots__ if name not in optional]
        if min(getattr(self, name) for name in sigmas) <= 0:
            raise ConfigError(named(self, *sigmas) + ": every sigma must be positive.")
        if min(getattr(self, name) for name in optional) < 0:
            raise ConfigError(named(self, *optional) + ": drift must not be negative.")
        if self.independent_sights > 1:
            raise ConfigError(f"independent_sights={self.independent_sights:g} must be at most 1.")

    @property
    def floor(self) -> np.ndarray:
        """[6, 6] information that every relative pose has."""
        return information(self.sigma_rotation_max_rad, self.sigma_translation_max_m)

    def drift(self, T: np.ndarray) -> np.ndarray:
        """Covariance [6, 6] of a random walk over T [4, 4]."""
        path_m = np.linalg.norm(T[:3, 3]) + self.turn_m_per_rad * se3.rotation_angle(T)
        rates = [self.drift_rad_per_sqrt_m] * 3 + [self.drift_m_per_sqrt_m] * 3
        return np.diag(np.array(rates) ** 2 * path_m)


@dataclass(frozen=True, slots=True)
class BoxObservation:
    """A landmark in the image of a keyframe."""

    keyframe: int
    landmark: int
    center_px: np.ndarray  # [2] of its box
    sigma_px: float
    intrinsics: np.ndarray  # [4] fx fy cx cy, px
    weight: float = 1.0  # exp(-2 H) where it is vague


def information(sigma_rad: float, sigma_m: float) -> np.ndarray:
    """[6, 6], rotation before translation."""
    return np.diag([sigma_rad**-2] * 3 + [sigma_m**-2] * 3)


def odometry_information(measured: RelativePose, noise: NoiseConfig) -> np.ndarray:
    """[6, 6], drift and floor included."""
    own = 0.5 * (measured.information + measured.information.T) + noise.floor
    return np.linalg.inv(np.linalg.inv(own) + noise.drift(measured.T_a_b))


def closure_information(
    measured: RelativePose, noise: NoiseConfig, covariance: np.ndarray
) -> np.ndarray:
    """[6, 6]; `covariance` [6, 6] is how well its ends are known in the variables that stand for
    them."""
    own = 0.5 * (measured.information + measured.information.T) + noise.floor
    least = np.linalg.inv(information(noise.sigma_loop_rad, noise.sigma_loop_m))
    return np.linalg.inv(np.linalg.inv(own) + least + covariance)


def prior_factor(keyframe: int, T_map: np.ndarray, sigma: float) -> gtsam.NonlinearFactor:
    noise = gtsam.noiseModel.Isotropic.Sigma(6, sigma)
    return gtsam.PriorFactorPose3(keyframe, gtsam.Pose3(T_map), noise)


def between_factor(
    a: int, b: int, T_a_b: np.ndarray, information: np.ndarray, robust_sigmas: float = 0.0
) -> gtsam.NonlinearFactor:
    """`robust_sigmas` of Cauchy's kernel; 0: none."""
    noise = gtsam.noiseModel.Gaussian.Information(information)
    return gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T_a_b), _robust(noise, robust_sigmas))


def box_factor(
    sight: BoxObservation, variable: int, T_variable_keyframe: np.ndarray, noise: NoiseConfig
) -> gtsam.NonlinearFactor:
    """s rho(w |pi(T_k^-1 mu) - z|^2 / sigma^2) with s = `independent_sights`; `variable` is the
    keyframe, or what it follows.

    A point behind the camera costs a constant and pulls nowhere."""
    share = np.sqrt(noise.independent_sights)
    sigma = sight.sigma_px / np.sqrt(sight.weight) / share
    model = _robust(gtsam.noiseModel.Isotropic.Sigma(2, sigma), share * noise.robust_sigmas)
    fx, fy, cx, cy = sight.intrinsics
    return gtsam.GenericProjectionFactorCal3_S2(
        sight.center_px,
        model,
        variable,
        point_key(sight.landmark),
        gtsam.Cal3_S2(fx, fy, 0.0, cx, cy),
        gtsam.Pose3(T_variable_keyframe),
    )


def _robust(noise: gtsam.noiseModel.Base, robust_sigmas: float) -> gtsam.noiseModel.Base:
    if robust_sigmas == 0:
        return noise
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(robust_sigmas)
    return gtsam.noiseModel.Robust.Create(kernel, noise)


def closure_residual(T_a: np.ndarray, T_b: np.ndarray, measured: RelativePose) -> np.ndarray:
    """[6] log(T_ab^-1 T_a^-1 T_b)."""
    return se3.log(se3.inverse(measured.T_a_b) @ se3.inverse(T_a) @ T_b)


Packed = dict[str, np.ndarray]


def pack_relative(measured: Iterable[RelativePose]) -> Packed:
    measured = list(measured)
    return {
        "pairs": np.array([(m.a, m.b) for m in measured], np.int64).reshape(-1, 2),
        "T_a_b": np.array([m.T_a_b for m in measured], float).reshape(-1, 4, 4),
        "information": np.array([m.information for m in measured], float).reshape(-1, 6, 6),
    }


def unpack_relative(packed: Mapping[str, np.ndarray]) -> list[RelativePose]:
    return [
        RelativePose(int(a), int(b), T_a_b, information)
        for (a, b), T_a_b, information in zip(
            packed["pairs"], packed["T_a_b"], packed["information"], strict=True
        )
    ]


def pack_sights(sights: Iterable[BoxObservation]) -> Packed:
    sights = list(sights)
    return {
        "pairs": np.array([(s.keyframe, s.landmark) for s in sights], np.int64).reshape(-1, 2),
        "centers_px": np.array([s.center_px for s in sights], float).reshape(-1, 2),
        "intrinsics": np.array([s.intrinsics for s in sights], float).reshape(-1, 4),
        "sigmas_px": np.array([s.sigma_px for s in sights], float),
        "weights": np.array([s.weight for s in sights], float),
    }


def unpack_sights(packed: Mapping[str, np.ndarray]) -> list[BoxObservation]:
    columns = (packed[name] for name in ("centers_px", "sigmas_px", "intrinsics", "weights"))
    return [
        BoxObservation(
            int(keyframe), int(landmark), center_px, float(sigma_px), intrinsics, float(weight)
        )
        for (keyframe, landmark), center_px, sigma_px, intrinsics, weight in zip(
            packed["pairs"], *columns, strict=True
        )
    ]
