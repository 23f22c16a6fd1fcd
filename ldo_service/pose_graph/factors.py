"""Factors of the pose graph and their noise; packing of measurements as arrays for checkpoints.

An unpacked measurement is bitwise equal to the measurement that was packed.
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
    """Parameters of the noise of measurements.

    A relative-pose measurement comes with an information matrix. These parameters bound its
    covariance, and add noise that the matrix does not contain, such as odometry drift.
    """

    # Sigma of the prior that fixes the first keyframe of each component, rad and m.
    first_sigma: float = 1e-6
    # Upper bounds of the sigma in a degenerate direction; without them, the linear system would be
    # singular.
    sigma_rotation_max_rad: float = 0.2
    sigma_translation_max_m: float = 0.5
    sigma_odometry_rad: float = 0.05  # Sigma of an odometry pose across missed keyframes.
    sigma_odometry_m: float = 0.1
    # Alignment treats pixels as independent and models no bias, so its sigmas are too small: for
    # a handheld Kinect, the median error of its relative poses is 7 sigma. Therefore the
    # covariance of a random walk is added: about 1 % of the path and 0.5 deg/m after some
    # meters. Without this covariance, a chain of measurements could not bend as far as a true
    # loop closure requires.
    drift_rad_per_sqrt_m: float = 0.02
    drift_m_per_sqrt_m: float = 0.02
    turn_m_per_rad: float = 0.5  # Path length with the same drift as a rotation of 1 rad in place.
    # Sigmas of the covariance that is added to a loop closure. The dense refinement of a
    # closure also treats pixels as independent, and does not model errors of calibration and
    # exposure.
    sigma_loop_rad: float = 0.01
    sigma_loop_m: float = 0.01
    # Errors of the center of a detected box, relative to the projected mean of the object's
    # Gaussians. The first sigma, in pixels, is the error of the detector. The second one, a
    # fraction of the longer side of the box, comes from occlusion and from the visible side of the
    # object. The squares of both are added.
    sigma_box_px: float = 4.0
    sigma_box_share: float = 0.15
    # Observations of an object from one side have the same error, so N observations contain less
    # information than N independent observations. Each observation counts as this fraction of an
    # independent one. The maximum of 32 observations (`landmarks.max_observations`) thus counts as
    # a tenth of one independent observation. With ten times this value, landmarks moved poses by
    # 3 mm although odometry was accurate to 2 mm (docs/decisions/0057-tenth-information.md).
    independent_observations: float = 1 / 320
    # Width of the Cauchy kernel in sigmas: 95 % efficient on Gaussian noise.
    robust_sigmas: float = 2.385

    def __post_init__(self) -> None:
        optional = ("drift_rad_per_sqrt_m", "drift_m_per_sqrt_m", "turn_m_per_rad")
        sigmas = [name for name in self.__slots__ if name not in optional]
        if min(getattr(self, name) for name in sigmas) <= 0:
            raise ConfigError(named(self, *sigmas) + " must be positive.")
        if min(getattr(self, name) for name in optional) < 0:
            raise ConfigError(
                named(self, *optional)
                + ": drift_rad_per_sqrt_m, drift_m_per_sqrt_m and turn_m_per_rad must not be "
                "negative."
            )
        if self.independent_observations > 1:
            raise ConfigError(named(self, "independent_observations") + " must be at most 1.")

    @property
    def floor(self) -> np.ndarray:
        """Information [6, 6] that is added to each relative-pose measurement."""
        return information(self.sigma_rotation_max_rad, self.sigma_translation_max_m)

    def drift(self, T: np.ndarray) -> np.ndarray:
        """Return the covariance [6, 6] of odometry drift over a relative pose T [4, 4].

        Drift is modeled as a random walk along the path. The covariance is in rad^2 and m^2,
        rotation first.
        """
        path_m = np.linalg.norm(T[:3, 3]) + self.turn_m_per_rad * se3.rotation_angle(T)
        rates = [self.drift_rad_per_sqrt_m] * 3 + [self.drift_m_per_sqrt_m] * 3
        return np.diag(np.array(rates) ** 2 * path_m)


@dataclass(frozen=True, slots=True)
class BoxObservation:
    """Observation of a landmark as a box in the image of a keyframe."""

    keyframe: int  # Id of the keyframe.
    landmark: int  # Id of the landmark.
    center_px: np.ndarray  # Center of the box, [2].
    sigma_px: float  # Standard deviation of the center.
    intrinsics: np.ndarray  # fx, fy, cx, cy in pixels, [4].
    # Factor on the squared residual: exp(-2 H) if the entropy H of the observed classes is
    # high, else 1.
    weight: float = 1.0


def information(sigma_rad: float, sigma_m: float) -> np.ndarray:
    """Return the diagonal information matrix [6, 6] for sigmas of rotation and translation."""
    return np.diag([sigma_rad**-2] * 3 + [sigma_m**-2] * 3)


def odometry_information(measured: RelativePose, noise: NoiseConfig) -> np.ndarray:
    """Return the information [6, 6] of an odometry measurement.

    The result is ((Omega + floor)^-1 + drift)^-1 with the information Omega of `measured`, and with
    `NoiseConfig.floor` and `NoiseConfig.drift`. The drift thus increases the covariance.
    """
    own = 0.5 * (measured.information + measured.information.T) + noise.floor
    return np.linalg.inv(np.linalg.inv(own) + noise.drift(measured.T_a_b))


def closure_information(
    measured: RelativePose, noise: NoiseConfig, covariance: np.ndarray
) -> np.ndarray:
    """Return the information [6, 6] of a loop closure.

    The result is ((Omega + floor)^-1 + S + covariance)^-1 with the information Omega of `measured`
    and `NoiseConfig.floor`. S is the diagonal covariance of `sigma_loop_rad` and `sigma_loop_m`.

    Args:
        measured: The closure.
        noise: Noise of the measurements.
        covariance: Covariance [6, 6] that is added when the closure is transferred from condensed
            keyframes to variables. It is zero if both keyframes are variables.
    """
    own = 0.5 * (measured.information + measured.information.T) + noise.floor
    least = np.linalg.inv(information(noise.sigma_loop_rad, noise.sigma_loop_m))
    return np.linalg.inv(np.linalg.inv(own) + least + covariance)


def prior_factor(keyframe: int, T_map: np.ndarray, sigma: float) -> gtsam.NonlinearFactor:
    """Return a prior factor that fixes a keyframe at T_map [4, 4]; `sigma` is in rad and m."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, sigma)
    return gtsam.PriorFactorPose3(keyframe, gtsam.Pose3(T_map), noise)


def between_factor(
    a: int, b: int, T_a_b: np.ndarray, information: np.ndarray, robust_sigmas: float = 0.0
) -> gtsam.NonlinearFactor:
    """Return a relative-pose factor between the keyframes a and b.

    Args:
        a: Id of the first keyframe.
        b: Id of the second keyframe.
        T_a_b: Measured pose of b in a, [4, 4].
        information: Information matrix of the measurement, [6, 6], rotation first.
        robust_sigmas: Width of the Cauchy kernel in sigmas; 0 for no robust kernel.
    """
    noise = gtsam.noiseModel.Gaussian.Information(information)
    return gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T_a_b), _robust(noise, robust_sigmas))


def box_factor(
    observation: BoxObservation, variable: int, T_variable_keyframe: np.ndarray, noise: NoiseConfig
) -> gtsam.NonlinearFactor:
    """Return the reprojection factor of an observation.

    Its cost is s rho(w |pi(T_k^-1 mu) - z|^2 / sigma^2). pi projects the landmark mu into the image
    of keyframe k with the pose T_k. The observation has the center z, the noise sigma and the
    weight w. rho is the Cauchy kernel and s is `independent_observations`. A point behind the
    camera has a constant cost and no gradient.

    Args:
        observation: The observation.
        variable: Id of the observing keyframe if it is a variable of the pose graph; otherwise the
            id of the variable before or after it.
        T_variable_keyframe: Pose of the observing keyframe in `variable`, [4, 4].
        noise: Noise of the measurements.
    """
    share = np.sqrt(noise.independent_observations)
    sigma = observation.sigma_px / np.sqrt(observation.weight) / share
    model = _robust(gtsam.noiseModel.Isotropic.Sigma(2, sigma), share * noise.robust_sigmas)
    fx, fy, cx, cy = observation.intrinsics
    return gtsam.GenericProjectionFactorCal3_S2(
        observation.center_px,
        model,
        variable,
        point_key(observation.landmark),
        gtsam.Cal3_S2(fx, fy, 0.0, cx, cy),
        gtsam.Pose3(T_variable_keyframe),
    )


def _robust(noise: gtsam.noiseModel.Base, robust_sigmas: float) -> gtsam.noiseModel.Base:
    if robust_sigmas == 0:
        return noise
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(robust_sigmas)
    return gtsam.noiseModel.Robust.Create(kernel, noise)


def closure_residual(T_a: np.ndarray, T_b: np.ndarray, measured: RelativePose) -> np.ndarray:
    """Return the residual log(T_ab^-1 T_a^-1 T_b) of a closure, [6]: rotation, then translation.

    Args:
        T_a: Pose of keyframe a in the map, [4, 4].
        T_b: Pose of keyframe b in the map, [4, 4].
        measured: The closure; T_ab is its measured pose of keyframe b in keyframe a.
    """
    return se3.log(se3.inverse(measured.T_a_b) @ se3.inverse(T_a) @ T_b)


Packed = dict[str, np.ndarray]


def pack_relative(measured: Iterable[RelativePose]) -> Packed:
    """Pack measurements into arrays, by name."""
    measured = list(measured)
    return {
        "pairs": np.array([(m.a, m.b) for m in measured], np.int64).reshape(-1, 2),
        "T_a_b": np.array([m.T_a_b for m in measured], float).reshape(-1, 4, 4),
        "information": np.array([m.information for m in measured], float).reshape(-1, 6, 6),
    }


def unpack_relative(packed: Mapping[str, np.ndarray]) -> list[RelativePose]:
    """Return the measurements that `pack_relative` packed."""
    return [
        RelativePose(int(a), int(b), T_a_b, information)
        for (a, b), T_a_b, information in zip(
            packed["pairs"], packed["T_a_b"], packed["information"], strict=True
        )
    ]


def pack_observations(observations: Iterable[BoxObservation]) -> Packed:
    """Pack observations into arrays, by name."""
    observations = list(observations)
    return {
        "pairs": np.array([(s.keyframe, s.landmark) for s in observations], np.int64).reshape(
            -1, 2
        ),
        "centers_px": np.array([s.center_px for s in observations], float).reshape(-1, 2),
        "intrinsics": np.array([s.intrinsics for s in observations], float).reshape(-1, 4),
        "sigmas_px": np.array([s.sigma_px for s in observations], float),
        "weights": np.array([s.weight for s in observations], float),
    }


def unpack_observations(packed: Mapping[str, np.ndarray]) -> list[BoxObservation]:
    """Return the observations that `pack_observations` packed."""
    columns = (packed[name] for name in ("centers_px", "sigmas_px", "intrinsics", "weights"))
    return [
        BoxObservation(
            int(keyframe), int(landmark), center_px, float(sigma_px), intrinsics, float(weight)
        )
        for (keyframe, landmark), center_px, sigma_px, intrinsics, weight in zip(
            packed["pairs"], *columns, strict=True
        )
    ]
