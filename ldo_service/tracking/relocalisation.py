"""Finding a lost camera among all places. Conventions: `ldo_service.geometry`.

A lost frame is compared with the places whose thumbnails are most like it, and with a few more
in turn, so that each frame costs the same however large the memory is, and every place has its
chance. A place counts as found when features and images agree on it; no prediction speaks for it,
so it is judged more strictly than tracking.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3

from .align import AlignConfig
from .candidates import Candidate, attempt
from .features import FeatureConfig, FeaturePose, detect, estimate_pose
from .judgement import History, JudgementConfig, Status, judge
from .keyframes import Keyframe
from .motion import extent
from .places import Place, Places
from .pyramid import Pyramid, PyramidConfig


@dataclass(frozen=True, slots=True)
class RelocalisationConfig:
    alike: int = 5  # places per lost frame, by thumbnail: the prototype's number
    in_turn: int = 3  # further ones: 1000 places in 11 s at 30 Hz
    attempts: int = 2  # direct alignments per lost frame, the best feature poses first
    min_geometric_inliers: float = 0.85  # of the depths that meet a surface; the prototype's
    agreement_rad: float = 0.06  # rotation plus parallax between feature pose and alignment

    def __post_init__(self) -> None:
        if self.alike < 0 or self.in_turn < 0 or self.alike + self.in_turn < 1:
            raise ConfigError("alike and in_turn must not be negative, nor both 0.")
        if self.attempts < 1 or not self.agreement_rad > 0:
            raise ConfigError("attempts must be at least 1 and agreement_rad positive.")
        if not 0 <= self.min_geometric_inliers <= 1:
            raise ConfigError("min_geometric_inliers must be within 0..1.")


@dataclass(frozen=True, slots=True)
class Relocaliser:
    """How a lost camera is found; knows nothing from frame to frame."""

    pyramid: PyramidConfig
    align: AlignConfig
    features: FeatureConfig
    judgement: JudgementConfig
    config: RelocalisationConfig

    def find(
        self, view: Pyramid, places: Places, turn: int, history: History
    ) -> tuple[Keyframe, Candidate] | None:
        """The keyframe that a view surely shows, and its alignment to it.

        `turn` counts the lost frames; it decides whose turn it is beside the likely places.
        """
        for place, pose in self._poses(view, self._chosen(view, places, turn)):
            keyframe = place.keyframe(self.pyramid)
            guess = se3.inverse(pose.T_camera_reference)
            candidate = attempt(keyframe, view, guess, "relocalised", self.align)
            if self._is_sure(candidate, guess, history):
                return keyframe, replace(candidate, features_agree=True)
        return None

    def _chosen(self, view: Pyramid, places: Places, turn: int) -> list[Place]:
        """The likely ones and those whose turn it is, each once."""
        if not len(places):
            return []
        likely = places.alike(view)[: self.config.alike]
        first = turn * self.config.in_turn
        due = [number % len(places) for number in range(first, first + self.config.in_turn)]
        return [places.all[index] for index in dict.fromkeys((*likely, *due))]

    def _poses(self, view: Pyramid, places: Iterable[Place]) -> list[tuple[Place, FeaturePose]]:
        """Places with a feature pose, most inliers first, as many as may be tried."""
        seen = detect(view, self.features)
        poses = [(p, estimate_pose(p.features, seen, view.camera, self.features)) for p in places]
        found = [(place, pose) for place, pose in poses if pose is not None]
        return sorted(found, key=lambda pp: -pp[1].inliers)[: self.config.attempts]

    def _is_sure(self, candidate: Candidate, guess: np.ndarray, history: History) -> bool:
        alignment = candidate.alignment
        difference = se3.inverse(guess) @ alignment.T_reference_camera
        verdict = judge(alignment, None, history, Status.LOST, self.judgement)
        return (
            verdict is Status.OK
            and alignment.geometric_inliers >= self.config.min_geometric_inliers
            and extent(difference, candidate.median_depth_m) < self.config.agreement_rad
        )
