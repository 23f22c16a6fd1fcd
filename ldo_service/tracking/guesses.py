"""Where a frame may have been taken, before it is aligned. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass, replace

import numpy as np

from ldo_service.geometry import se3

from .align import AlignConfig
from .candidates import Candidate, CandidateConfig, apart_rad, attempt, best
from .features import FeatureConfig, detect, estimate_pose
from .keyframes import Keyframe
from .motion import extent
from .pyramid import Pyramid
from .shape import ShapeConfig, pose_from_shape


@dataclass(frozen=True, slots=True)
class Guesses:
    """Alignments from each guess; knows nothing from frame to frame."""

    align: AlignConfig
    features: FeatureConfig
    shape: ShapeConfig
    candidates: CandidateConfig
    large_motion: float  # image widths per frame

    def from_motion(
        self,
        keyframe: Keyframe,
        view: Pyramid,
        T_keyframe_camera: np.ndarray,
        method: str = "direct",
    ) -> Candidate:
        return attempt(keyframe, view, T_keyframe_camera, method, self.align)

    def best_of_all(
        self,
        predicted: Candidate,
        keyframe: Keyframe,
        view: Pyramid,
        resting: np.ndarray,
        carried: np.ndarray | None,
    ) -> Candidate:
        """The best of `predicted`, what rest leads to and what a second opinion leads to.

        resting  T_keyframe_camera [4, 4] of the frame before
        carried  T_keyframe_camera [4, 4] by a prior; None: there is none
        """
        candidates = [predicted, self.from_motion(keyframe, view, resting)]
        if carried is not None:
            candidates.append(self.from_motion(keyframe, view, carried, "prior"))
        second, method = self._second_opinion(keyframe, view, resting)
        if second is not None:
            candidates.append(attempt(keyframe, view, second, method, self.align))
        chosen = best(candidates, second, keyframe, view, self.candidates, self.align)
        if carried is None:
            return chosen
        is_expected = apart_rad(chosen, carried) < self.candidates.agreement_rad
        return replace(chosen, is_expected=is_expected)

    def is_large_step(self, candidate: Candidate, resting: np.ndarray, view: Pyramid) -> bool:
        """Whether the image moved so far since the last frame that a minimum may be a wrong one."""
        moved = se3.inverse(resting) @ candidate.alignment.T_reference_camera
        shift_rad = extent(moved, candidate.median_depth_m)
        return shift_rad * view.camera.fx > self.large_motion * view.camera.width

    def _second_opinion(
        self, keyframe: Keyframe, view: Pyramid, resting: np.ndarray
    ) -> tuple[np.ndarray | None, str]:
        """T_keyframe_camera [4, 4] by features; by shape, where there is too little texture."""
        known, seen = keyframe.features(self.features), detect(view, self.features)
        pose = estimate_pose(known, seen, view.camera, self.features)
        if pose is not None:
            return se3.inverse(pose.T_camera_reference), "features"
        return pose_from_shape(keyframe.reference, view, resting, self.shape), "shape"
