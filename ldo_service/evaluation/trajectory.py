"""Absolute and relative trajectory error (Sturm et al., IROS 2012), as `evo` computes them."""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Trajectory, associate, se3
from ldo_service.geometry.se3 import fit_rigid_transform

ASSOCIATION_TOLERANCE_S = 0.020
RPE_INTERVAL_S = 1.0
MIN_POSES = 3  # Fewer points do not determine a rotation.

PROTOCOL = """\
Estimate and truth are paired by nearest stamp within 20 ms, each pose used once.
ATE: positions after SE(3) alignment of the estimate to the truth over all pairs, without scale
(Umeyama, PAMI 1991). RPE: (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) with truth Q and estimate P, for all
pairs j = i + n, where n is 1 s in poses at the median rate; its translation and rotation angle.
`evo_ape tum TRUTH ESTIMATE --align --t_max_diff 0.02` and `evo_rpe tum TRUTH ESTIMATE --delta n
--delta_unit f --all_pairs --t_max_diff 0.02 [--pose_relation angle_deg]` print the same values,
unless one pose is the nearest to two poses, as with clocks half a frame apart: evo then uses that
pose twice. Some published systems print the mean as RMSE; both are given here."""


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of one error over a trajectory, in the unit of the error, such as meters."""

    rmse: float
    mean: float
    median: float
    max: float

    @staticmethod
    def of(errors: np.ndarray) -> "ErrorStatistics":
        """Return the statistics of N errors, [N]."""
        return ErrorStatistics(
            float(np.sqrt(np.mean(errors**2))),
            float(np.mean(errors)),
            float(np.median(errors)),
            float(np.max(errors)),
        )


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of a trajectory; the constant `PROTOCOL` of this module describes them.

    The relative errors are None if the poses span less than 1 s.
    """

    poses: int  # Number of associated poses.
    ate_m: ErrorStatistics  # Absolute trajectory error: distances of the positions.
    rpe_poses: int  # Interval of the relative errors: the number of poses in 1 s.
    rpe_translation_m: ErrorStatistics | None  # Relative pose error, translation.
    rpe_rotation_deg: ErrorStatistics | None  # Relative pose error, rotation.
    T_truth_estimate: np.ndarray  # Alignment, [4, 4].


def evaluate_trajectory(estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors:
    """Compute the errors of an estimated trajectory as the constant `PROTOCOL` describes.

    Raises:
        DataError: If fewer than 3 estimated poses have a true pose within 20 ms.
    """
    pairs = associated(estimate, truth)
    T_estimate = estimate.T_world_camera[pairs[:, 0]]
    T_truth = truth.T_world_camera[pairs[:, 1]]
    T_truth_estimate = fit_rigid_transform(T_estimate[:, :3, 3], T_truth[:, :3, 3])
    aligned = se3.transform(T_truth_estimate, T_estimate[:, :3, 3])
    interval = _poses_per_interval(estimate.stamps_s[pairs[:, 0]])
    relative = _relative_errors(T_estimate, T_truth, interval)
    return TrajectoryErrors(
        len(pairs),
        ErrorStatistics.of(np.linalg.norm(aligned - T_truth[:, :3, 3], axis=1)),
        interval,
        ErrorStatistics.of(np.linalg.norm(relative[:, :3, 3], axis=1)) if len(relative) else None,
        ErrorStatistics.of(np.rad2deg(se3.rotation_angles(relative))) if len(relative) else None,
        T_truth_estimate,
    )


def associated(estimate: Trajectory, truth: Trajectory) -> np.ndarray:
    """Pair estimated and true poses by nearest stamp within 20 ms.

    Returns:
        Indices of the estimated pose and the true pose of each of the M pairs, [M, 2].

    Raises:
        DataError: If there are fewer than 3 pairs.
    """
    pairs = associate(estimate.stamps_s, truth.stamps_s, ASSOCIATION_TOLERANCE_S)
    if len(pairs) < MIN_POSES:
        raise DataError(
            f"{len(pairs)} of {len(estimate)} estimated poses have a true pose within 20 ms (the "
            f"estimate spans {_span(estimate)}, the truth spans {_span(truth)}), but at least "
            f"{MIN_POSES} are needed. Check that both use the same clock."
        )
    return pairs


def _relative_errors(T_estimate: np.ndarray, T_truth: np.ndarray, interval: int) -> np.ndarray:
    """Return the relative errors (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), [M, 4, 4], for j = i + interval.

    P are estimated poses and Q are true poses.
    """
    motion_estimate = se3.inverse(T_estimate[:-interval]) @ T_estimate[interval:]
    motion_truth = se3.inverse(T_truth[:-interval]) @ T_truth[interval:]
    return se3.inverse(motion_truth) @ motion_estimate


def _poses_per_interval(stamps_s: np.ndarray) -> int:
    return max(1, round(RPE_INTERVAL_S / max(float(np.median(np.diff(stamps_s))), 1e-9)))


def _span(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return "nothing"
    return f"{trajectory.stamps_s[0]:.3f} s to {trajectory.stamps_s[-1]:.3f} s"
