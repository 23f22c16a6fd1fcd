"""Pose hypotheses of a frame: alignment from several initial guesses, and selection of one.

Conventions: `ldo_service.geometry`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3

from .aligner import CPU_ALIGNER, Aligner
from .alignment import AlignConfig, Alignment
from .features import FeatureConfig, GicpConfig, detect, estimate_pose, register_gicp
from .keyframes import ReferenceKeyframe
from .motion import image_motion_rad
from .pyramid import Pyramid

# Weight of a point that is only visible, relative to one that is paired with a measured depth.
PHOTOMETRIC_ONLY_WEIGHT = 0.05
REALIGNED_LEVELS = 2  # Finest pyramid levels to which a frame is aligned again.


@dataclass(frozen=True, slots=True)
class PoseHypothesisConfig:
    """Settings of the selection between pose hypotheses."""

    # Two poses agree if their rotation plus parallax (`image_motion_rad`) is below this. Of the
    # poses by ORB features and PnP, 9 of 10 had an error of at most 3 cm.
    agreement_rad: float = 0.06
    # Minimum support of a hypothesis as a fraction of the best hypothesis's support. The images
    # refute a hypothesis with less support.
    min_support_ratio: float = 0.5

    def __post_init__(self) -> None:
        if not (self.agreement_rad > 0 and 0 < self.min_support_ratio <= 1):
            raise ConfigError(
                f"PoseHypothesisConfig.agreement_rad={self.agreement_rad:g} must be positive, "
                f"and min_support_ratio={self.min_support_ratio:g} above 0 and at most 1."
            )


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """Alignment of a frame from one initial guess, and the evidence for it.

    Distances between poses are rotation plus parallax in rad; see `motion.image_motion_rad`.
    """

    alignment: Alignment
    # Initial guess: "direct" from constant velocity or rest, "prior" from another odometry,
    # "features" from ORB, "gicp" from point clouds, "relocalized" from features of a keyframe
    # record, "reused" from the map.
    pose_source: str
    median_depth_m: float  # Median depth of the keyframe.
    # True if an independent estimate of the pose, by features or GICP, agrees; False if it
    # disagrees. None if there is no such estimate, or if the images refute the estimate.
    is_confirmed: bool | None = None
    # Distance to the farthest other hypothesis of the frame that the images support.
    hypothesis_spread_rad: float = 0.0
    agrees_with_prior: bool = False  # True if the odometry prior predicts this pose.
    # Distance to the pose by features alone; infinite if unknown.
    feature_distance_rad: float = inf


def align_hypothesis(
    keyframe: ReferenceKeyframe,
    view: Pyramid,
    T_keyframe_camera: np.ndarray,
    pose_source: str,
    config: AlignConfig,
    aligner: Aligner = CPU_ALIGNER,
) -> PoseHypothesis:
    """Align a frame directly to a keyframe from an initial guess, and return the hypothesis.

    Args:
        keyframe: The keyframe.
        view: Pyramid of the frame.
        T_keyframe_camera: Initial guess, [4, 4].
        pose_source: Name of the initial guess.
        config: Settings.
        aligner: Device of the alignment.
    """
    guess = se3.inverse(T_keyframe_camera)
    reference = keyframe.reference
    return PoseHypothesis(
        aligner.align(reference, view, guess, config), pose_source, reference.median_depth_m
    )


def support(
    candidate: PoseHypothesis,
    others: Sequence[PoseHypothesis],
    keyframe: ReferenceKeyframe,
    view: Pyramid,
    config: AlignConfig,
    aligner: Aligner = CPU_ALIGNER,
) -> float:
    """Return the support of a hypothesis: a weighted fraction of inliers, 0..1.05.

    The inliers are counted among the reference points of the keyframe.

    Alignment has estimated the noise of each hypothesis separately, and a wrong pose inflates the
    noise. All hypotheses are therefore evaluated with the smallest of these noise estimates. Each
    visible point has the weight 0.05. A point that is paired with a measured depth also has the
    weight 1, so its total weight is 1.05.

    Args:
        candidate: The hypothesis.
        others: All hypotheses of the frame; the smallest of their noise estimates is used.
        keyframe: The keyframe.
        view: Pyramid of the frame.
        config: Settings.
        aligner: Device of the evaluation.
    """
    own = candidate.alignment
    common = replace(
        own.appearance,
        intensity_sigma=min(c.alignment.intensity_sigma for c in others),
        depth_noise_scale=min(c.alignment.depth_noise_scale for c in others),
    )
    points = keyframe.reference.points[0]
    T_camera_keyframe = se3.orthonormalize(se3.inverse(own.T_reference_camera))
    seen = aligner.linearize(points, view.levels[0], T_camera_keyframe, common, config.residuals)
    total = max(points.shape[1], 1)
    return seen.photometric.inlier_fraction * (
        PHOTOMETRIC_ONLY_WEIGHT * (seen.visible / total)
        + seen.geometric.inlier_fraction * (seen.geometric.count / total)
    )


def select_hypothesis(
    candidates: Sequence[PoseHypothesis],
    T_keyframe_second: np.ndarray | None,
    keyframe: ReferenceKeyframe,
    view: Pyramid,
    config: PoseHypothesisConfig,
    align_config: AlignConfig,
    aligner: Aligner = CPU_ALIGNER,
) -> PoseHypothesis:
    """Select the hypothesis with the most support, and set its `is_confirmed`.

    Args:
        candidates: The hypotheses. If T_keyframe_second is given, the last hypothesis must have
            started from it.
        T_keyframe_second: Independent estimate of the pose by features or GICP, [4, 4]; None if
            both failed.
        keyframe: The keyframe.
        view: Pyramid of the frame.
        config: Settings.
        align_config: Settings of alignment.
        aligner: Device of the alignment.
    """
    supports = [support(c, candidates, keyframe, view, align_config, aligner) for c in candidates]
    winner, least = int(np.argmax(supports)), config.min_support_ratio * max(supports)
    apart = [
        hypothesis_distance_rad(candidates[winner], c.alignment.T_reference_camera)
        for c in candidates
    ]
    farthest = max(a for a, supported in zip(apart, supports, strict=True) if supported >= least)
    chosen = replace(candidates[winner], hypothesis_spread_rad=farthest)
    if T_keyframe_second is None:
        return chosen
    *unled, led = apart
    # Two hypotheses confirm each other if they started apart and converged to the same pose.
    others = unled if winner == len(unled) else [led]
    if min(*others, hypothesis_distance_rad(chosen, T_keyframe_second)) < config.agreement_rad:
        return replace(chosen, is_confirmed=True)
    return replace(chosen, is_confirmed=False if supports[-1] > least else None)


def hypothesis_distance_rad(candidate: PoseHypothesis, T_keyframe_camera: np.ndarray) -> float:
    """Return the distance in rad from a hypothesis to a pose [4, 4]; see `image_motion_rad`."""
    difference = se3.inverse(candidate.alignment.T_reference_camera) @ T_keyframe_camera
    return image_motion_rad(difference, candidate.median_depth_m)


@dataclass(frozen=True, slots=True)
class InitialGuessAligner:
    """Direct alignment of a frame from one or several initial guesses."""

    align: AlignConfig
    features: FeatureConfig
    shape: GicpConfig
    candidates: PoseHypothesisConfig
    # Image motion above which all initial guesses are tried, image widths per frame.
    large_motion: float
    aligner: Aligner = CPU_ALIGNER

    def align_from_guess(
        self,
        keyframe: ReferenceKeyframe,
        view: Pyramid,
        T_keyframe_camera: np.ndarray,
        pose_source: str = "direct",
    ) -> PoseHypothesis:
        """Align from the initial guess T_keyframe_camera [4, 4], and return the hypothesis."""
        return align_hypothesis(
            keyframe, view, T_keyframe_camera, pose_source, self.align, self.aligner
        )

    def align_from_all_guesses(
        self,
        predicted: PoseHypothesis,
        keyframe: ReferenceKeyframe,
        view: Pyramid,
        T_keyframe_previous: np.ndarray,
        T_keyframe_reckoned: np.ndarray | None,
    ) -> PoseHypothesis:
        """Align from all initial guesses except constant velocity; return the best hypothesis.

        Args:
            predicted: Hypothesis from the constant-velocity guess; it may be the best one.
            keyframe: The keyframe.
            view: Pyramid of the frame.
            T_keyframe_previous: Initial guess that the camera has not moved: T_keyframe_camera
                [4, 4] of the previous frame.
            T_keyframe_reckoned: Initial guess T_keyframe_camera [4, 4] by dead reckoning with the
                odometry prior; None if the prior is unknown.
        """
        candidates = [predicted, self.align_from_guess(keyframe, view, T_keyframe_previous)]
        if T_keyframe_reckoned is not None:
            candidates.append(self.align_from_guess(keyframe, view, T_keyframe_reckoned, "prior"))
        second, pose_source = self._independent_estimate(keyframe, view, T_keyframe_previous)
        if second is not None:
            candidates.append(self.align_from_guess(keyframe, view, second, pose_source))
        chosen = select_hypothesis(
            candidates, second, keyframe, view, self.candidates, self.align, self.aligner
        )
        # A hypothesis that started at the feature pose may still be there if alignment has not
        # converged. Its distance to the feature pose is then no evidence.
        is_independent = chosen.pose_source != "features" or chosen.alignment.converged
        if second is not None and pose_source == "features" and is_independent:
            distance_rad = hypothesis_distance_rad(chosen, second)
            chosen = replace(chosen, feature_distance_rad=distance_rad)
        if T_keyframe_reckoned is None:
            return chosen
        is_expected = (
            hypothesis_distance_rad(chosen, T_keyframe_reckoned) < self.candidates.agreement_rad
        )
        return replace(chosen, agrees_with_prior=is_expected)

    def align_again(
        self, keyframe: ReferenceKeyframe, view: Pyramid, candidate: PoseHypothesis
    ) -> PoseHypothesis:
        """Align a frame again after a small change of its images.

        Alignment starts from the pose of `candidate` and uses only the finest pyramid levels.
        """
        finest = replace(keyframe.reference, points=keyframe.reference.points[:REALIGNED_LEVELS])
        guess = se3.inverse(candidate.alignment.T_reference_camera)
        start = replace(self.align, start=candidate.alignment.appearance)
        return replace(candidate, alignment=self.aligner.align(finest, view, guess, start))

    def is_large_step(
        self, candidate: PoseHypothesis, T_keyframe_previous: np.ndarray, view: Pyramid
    ) -> bool:
        """Return whether the camera moved so far that alignment may be in a wrong local minimum.

        Args:
            candidate: Hypothesis of the frame.
            T_keyframe_previous: T_keyframe_camera [4, 4] of the previous frame.
            view: Pyramid of the frame.
        """
        moved = se3.inverse(T_keyframe_previous) @ candidate.alignment.T_reference_camera
        shift_rad = image_motion_rad(moved, candidate.median_depth_m)
        return shift_rad * view.camera.fx > self.large_motion * view.camera.width

    def _independent_estimate(
        self, keyframe: ReferenceKeyframe, view: Pyramid, T_keyframe_previous: np.ndarray
    ) -> tuple[np.ndarray | None, str]:
        """Estimate T_keyframe_camera [4, 4] from ORB features, or by GICP if the features fail.

        Returns:
            The pose, or None if both fail; and the name of the method.
        """
        known, seen = keyframe.features(self.features), detect(view, self.features)
        pose = estimate_pose(known, seen, view.camera, self.features)
        if pose is not None:
            return se3.inverse(pose.T_camera_reference), "features"
        return register_gicp(keyframe.reference, view, T_keyframe_previous, self.shape), "gicp"
