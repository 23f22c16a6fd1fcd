"""Pose hypotheses of one frame: initial guesses, alignment from each, and the choice between them.

Conventions: `ldo_service.geometry`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3

from .alignment import AlignConfig, Alignment, align, evaluate
from .features import FeatureConfig, GicpConfig, detect, estimate_pose, register_gicp
from .keyframes import ReferenceKeyframe
from .motion import image_motion_rad
from .pyramid import Pyramid

# weight of points without a depth to compare with, against points with one
PHOTOMETRIC_ONLY_WEIGHT = 0.05


@dataclass(frozen=True, slots=True)
class PoseHypothesisConfig:
    agreement_rad: float = 0.06  # rotation plus parallax; 9 of 10 ORB-PnP poses erred 3 cm or less
    rival_support: float = 0.5  # of the best: a pose with less is refuted by the images

    def __post_init__(self) -> None:
        if not (self.agreement_rad > 0 and 0 < self.rival_support <= 1):
            raise ConfigError("agreement_rad must be positive, rival_support within 0..1.")


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """`is_confirmed` is None where there was no second opinion, or the images refute it."""

    alignment: Alignment
    # "direct" from a motion guess, "prior" from another odometry, "features" from ORB, "gicp" from
    # point clouds
    pose_source: str
    median_depth_m: float  # of the keyframe
    is_confirmed: bool | None = None
    hypothesis_spread_rad: float = 0.0  # from the farthest rival that the images support
    agrees_with_prior: bool = False  # a prior has the camera there too


def align_hypothesis(
    keyframe: ReferenceKeyframe,
    view: Pyramid,
    T_keyframe_camera: np.ndarray,
    pose_source: str,
    config: AlignConfig,
) -> PoseHypothesis:
    """Direct alignment from a guessed pose."""
    guess = se3.inverse(T_keyframe_camera)
    reference = keyframe.reference
    return PoseHypothesis(
        align(reference, view, guess, config), pose_source, reference.median_depth_m
    )


def support(
    candidate: PoseHypothesis,
    others: Sequence[PoseHypothesis],
    keyframe: ReferenceKeyframe,
    view: Pyramid,
    config: AlignConfig,
) -> float:
    """How much of the reference a candidate explains at the least noise among the others, 0..1.

    Each estimated its own noise, and a wrong pose excuses itself with a large one: so all are
    measured again with the smallest. Depth counts; colour alone counts little.
    """
    own = candidate.alignment
    common = replace(
        own.appearance,
        intensity_sigma=min(c.alignment.intensity_sigma for c in others),
        depth_noise_scale=min(c.alignment.depth_noise_scale for c in others),
    )
    T_camera_keyframe = se3.inverse(own.T_reference_camera)
    seen = evaluate(keyframe.reference, view, T_camera_keyframe, common, config)
    return seen.photometric_inliers * (
        PHOTOMETRIC_ONLY_WEIGHT * seen.overlap + seen.geometric_inliers * seen.paired
    )


def select_hypothesis(
    candidates: Sequence[PoseHypothesis],
    T_keyframe_second: np.ndarray | None,
    keyframe: ReferenceKeyframe,
    view: Pyramid,
    config: PoseHypothesisConfig,
    align_config: AlignConfig,
) -> PoseHypothesis:
    """The candidate with the most support, told whether a second opinion is with it.

    T_keyframe_second [4, 4] is the camera's pose as features or shape have it, without a guess; the
    candidate that started there is the last. None: neither found one.
    """
    supports = [support(c, candidates, keyframe, view, align_config) for c in candidates]
    winner, least = int(np.argmax(supports)), config.rival_support * max(supports)
    apart = [
        hypothesis_distance_rad(candidates[winner], c.alignment.T_reference_camera)
        for c in candidates
    ]
    farthest = max(a for a, supported in zip(apart, supports, strict=True) if supported >= least)
    chosen = replace(candidates[winner], hypothesis_spread_rad=farthest)
    if T_keyframe_second is None:
        return chosen
    *unled, led = apart
    others = unled if winner == len(unled) else [led]  # two starts that met are two witnesses
    if min(*others, hypothesis_distance_rad(chosen, T_keyframe_second)) < config.agreement_rad:
        return replace(chosen, is_confirmed=True)
    return replace(chosen, is_confirmed=False if supports[-1] > least else None)


def hypothesis_distance_rad(candidate: PoseHypothesis, T_keyframe_camera: np.ndarray) -> float:
    """Rotation plus parallax, rad."""
    difference = se3.inverse(candidate.alignment.T_reference_camera) @ T_keyframe_camera
    return image_motion_rad(difference, candidate.median_depth_m)


@dataclass(frozen=True, slots=True)
class InitialGuessAligner:
    """Alignments from each guess; knows nothing from frame to frame."""

    align: AlignConfig
    features: FeatureConfig
    shape: GicpConfig
    candidates: PoseHypothesisConfig
    large_motion: float  # image widths per frame

    def align_from_guess(
        self,
        keyframe: ReferenceKeyframe,
        view: Pyramid,
        T_keyframe_camera: np.ndarray,
        pose_source: str = "direct",
    ) -> PoseHypothesis:
        return align_hypothesis(keyframe, view, T_keyframe_camera, pose_source, self.align)

    def align_from_all_guesses(
        self,
        predicted: PoseHypothesis,
        keyframe: ReferenceKeyframe,
        view: Pyramid,
        resting: np.ndarray,
        carried: np.ndarray | None,
    ) -> PoseHypothesis:
        """The best of `predicted`, what rest leads to and what a second opinion leads to.

        resting  T_keyframe_camera [4, 4] of the frame before
        carried  T_keyframe_camera [4, 4] by a prior; None: there is none
        """
        candidates = [predicted, self.align_from_guess(keyframe, view, resting)]
        if carried is not None:
            candidates.append(self.align_from_guess(keyframe, view, carried, "prior"))
        second, pose_source = self._independent_estimate(keyframe, view, resting)
        if second is not None:
            candidates.append(align_hypothesis(keyframe, view, second, pose_source, self.align))
        chosen = select_hypothesis(candidates, second, keyframe, view, self.candidates, self.align)
        if carried is None:
            return chosen
        is_expected = hypothesis_distance_rad(chosen, carried) < self.candidates.agreement_rad
        return replace(chosen, agrees_with_prior=is_expected)

    def is_large_step(self, candidate: PoseHypothesis, resting: np.ndarray, view: Pyramid) -> bool:
        """Whether the image moved so far since the last frame that a minimum may be a wrong one."""
        moved = se3.inverse(resting) @ candidate.alignment.T_reference_camera
        shift_rad = image_motion_rad(moved, candidate.median_depth_m)
        return shift_rad * view.camera.fx > self.large_motion * view.camera.width

    def _independent_estimate(
        self, keyframe: ReferenceKeyframe, view: Pyramid, resting: np.ndarray
    ) -> tuple[np.ndarray | None, str]:
        """T_keyframe_camera [4, 4] by features; by shape, where there is too little texture."""
        known, seen = keyframe.features(self.features), detect(view, self.features)
        pose = estimate_pose(known, seen, view.camera, self.features)
        if pose is not None:
            return se3.inverse(pose.T_camera_reference), "features"
        return register_gicp(keyframe.reference, view, resting, self.shape), "gicp"
