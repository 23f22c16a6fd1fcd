"""Several attempts at one frame's pose, and the choice between them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.geometry import se3

from .align import AlignConfig, Alignment, align, evaluate
from .keyframes import Keyframe
from .motion import extent
from .pyramid import Pyramid


@dataclass(frozen=True, slots=True)
class Candidate:
    """`features_agree` is None where no feature pose was there to compare with."""

    alignment: Alignment
    method: str  # "direct" from a motion guess, "features" from ORB
    features_agree: bool | None = None


def attempt(
    keyframe: Keyframe,
    view: Pyramid,
    T_keyframe_camera: np.ndarray,
    method: str,
    config: AlignConfig,
) -> Candidate:
    """Direct alignment from a guessed pose."""
    guess = se3.inverse(T_keyframe_camera)
    return Candidate(align(keyframe.reference, view, guess, config), method)


def best(
    candidates: Sequence[Candidate], keyframe: Keyframe, view: Pyramid, config: AlignConfig
) -> Candidate:
    """The candidate that explains most of the reference at the least noise among them all.

    Each estimated its own noise, and a wrong pose excuses itself with a large one: so all are
    measured again with the smallest. The first wins a tie.
    """
    if len(candidates) == 1:
        return candidates[0]
    intensity_sigma = min(c.alignment.intensity_sigma for c in candidates)
    depth_noise_scale = min(c.alignment.depth_noise_scale for c in candidates)

    def support(candidate: Candidate) -> float:
        own = candidate.alignment
        common = replace(
            own.appearance, intensity_sigma=intensity_sigma, depth_noise_scale=depth_noise_scale
        )
        T_camera_keyframe = se3.inverse(own.T_reference_camera)
        seen = evaluate(keyframe.reference, view, T_camera_keyframe, common, config)
        return seen.photometric_inliers * (0.05 * seen.overlap + seen.geometric_inliers * seen.paired)

    return max(candidates, key=support)


def compared(
    candidate: Candidate, T_keyframe_camera: np.ndarray, median_depth_m: float, tolerance: float
) -> Candidate:
    """The candidate with the verdict of a feature pose: within `tolerance` (rad) or not."""
    difference = se3.inverse(candidate.alignment.T_reference_camera) @ T_keyframe_camera
    return replace(candidate, features_agree=extent(difference, median_depth_m) < tolerance)
