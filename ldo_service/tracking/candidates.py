"""Several attempts at one frame's pose, and the choice between them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3

from .align import AlignConfig, Alignment, align, evaluate
from .keyframes import Keyframe
from .motion import extent
from .pyramid import Pyramid

COLOUR_ALONE = 0.05  # weight of points without a depth to compare with, against points with one


@dataclass(frozen=True, slots=True)
class CandidateConfig:
    agreement_rad: float = 0.06  # rotation plus parallax; 9 of 10 ORB-PnP poses erred 3 cm or less
    rival_support: float = 0.5  # of the best: a pose with less is refuted by the images

    def __post_init__(self) -> None:
        if not (self.agreement_rad > 0 and 0 < self.rival_support <= 1):
            raise ConfigError("agreement_rad must be positive, rival_support within 0..1.")


@dataclass(frozen=True, slots=True)
class Candidate:
    """`second_agrees` is None where there was no second opinion, or the images refute it."""

    alignment: Alignment
    # "direct" from a motion guess, "prior" from another odometry, "features" from ORB, "shape" from
    # point clouds
    method: str
    median_depth_m: float  # of the keyframe
    second_agrees: bool | None = None
    disagreement_rad: float = 0.0  # from the farthest rival that the images support
    is_expected: bool = False  # a prior has the camera there too


def attempt(
    keyframe: Keyframe,
    view: Pyramid,
    T_keyframe_camera: np.ndarray,
    method: str,
    config: AlignConfig,
) -> Candidate:
    """Direct alignment from a guessed pose."""
    guess = se3.inverse(T_keyframe_camera)
    reference = keyframe.reference
    return Candidate(align(reference, view, guess, config), method, reference.median_depth_m)


def support(
    candidate: Candidate,
    others: Sequence[Candidate],
    keyframe: Keyframe,
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
        COLOUR_ALONE * seen.overlap + seen.geometric_inliers * seen.paired
    )


def best(
    candidates: Sequence[Candidate],
    T_keyframe_second: np.ndarray | None,
    keyframe: Keyframe,
    view: Pyramid,
    config: CandidateConfig,
    align_config: AlignConfig,
) -> Candidate:
    """The candidate with the most support, told whether a second opinion is with it.

    T_keyframe_second [4, 4] is the camera's pose as features or shape have it, without a guess; the
    candidate that started there is the last. None: neither found one.
    """
    supports = [support(c, candidates, keyframe, view, align_config) for c in candidates]
    winner, least = int(np.argmax(supports)), config.rival_support * max(supports)
    apart = [apart_rad(candidates[winner], c.alignment.T_reference_camera) for c in candidates]
    farthest = max(a for a, supported in zip(apart, supports, strict=True) if supported >= least)
    chosen = replace(candidates[winner], disagreement_rad=farthest)
    if T_keyframe_second is None:
        return chosen
    *unled, led = apart
    others = unled if winner == len(unled) else [led]  # two starts that met are two witnesses
    if min(*others, apart_rad(chosen, T_keyframe_second)) < config.agreement_rad:
        return replace(chosen, second_agrees=True)
    return replace(chosen, second_agrees=False if supports[-1] > least else None)


def apart_rad(candidate: Candidate, T_keyframe_camera: np.ndarray) -> float:
    """Rotation plus parallax, rad."""
    difference = se3.inverse(candidate.alignment.T_reference_camera) @ T_keyframe_camera
    return extent(difference, candidate.median_depth_m)
