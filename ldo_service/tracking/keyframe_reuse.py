"""Keyframe reuse. Conventions: `ldo_service.geometry`.

A robot that repeats its route would make similar keyframes on every run, and the map would grow
without limit. Keyframe reuse prevents this growth; it starts once the map has many keyframes.
Before a new keyframe is made, the tracker searches for a known keyframe that shows the same
surface. The known keyframe is reused only if the map and the images agree on the pose of the
camera. If they disagree, odometry has drifted. The tracker then makes new keyframes, so that a loop
closure can correct the map.

A camera may come from newly mapped surface back to a known keyframe. The tracker then makes one
more keyframe and measures its pose relative to the known keyframe. This measurement connects the
new and the known keyframes in the pose graph.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .aligner import CPU_ALIGNER, Aligner
from .alignment import AlignConfig
from .keyframe_database import KeyframeRecord
from .keyframes import KeyframeConfig, ReferenceKeyframe, left_keyframe_view, limit_ratios
from .pose_candidates import PoseHypothesis, align_hypothesis, hypothesis_distance_rad
from .pyramid import Pyramid, PyramidConfig
from .tracking_quality import (
    ResidualHistory,
    TrackingQualityConfig,
    TrackingStatus,
    classify_tracking,
)

# A record, and T_keyframe_camera [4, 4] as the map predicts it.
Nearby = tuple[KeyframeRecord, np.ndarray]


@dataclass(frozen=True, slots=True)
class KeyframeReuseConfig:
    """Settings of keyframe reuse."""

    # Known keyframes are reused once this many keyframes of any kind have been made;
    # 0: never. Before that, new keyframes improve the map and cost a few kB each.
    after: int = 1500
    # Maximum number of records that a frame is aligned to, the nearest first. Each one takes 8
    # ms at 640x480.
    tries: int = 2
    # Maximum rotation plus parallax from the predicted to the aligned pose: 0.03 rad, or 3 % of the
    # median depth. Above it, new keyframes are made until a loop closure corrects the map.
    agreement_rad: float = 0.03
    # Minimum inlier fraction of the points paired with a measured depth, as in relocalization.
    min_geometric_inliers: float = 0.85

    def __post_init__(self) -> None:
        if self.after < 0 or self.tries < 1:
            raise ConfigError(
                named(self, "after", "tries")
                + ": `after` must be at least 0, and `tries` at least 1."
            )
        if not (self.agreement_rad > 0 and 0 <= self.min_geometric_inliers <= 1):
            raise ConfigError(
                named(self, "agreement_rad", "min_geometric_inliers")
                + ": agreement_rad must be positive, and min_geometric_inliers within 0..1."
            )


@dataclass(frozen=True, eq=False, slots=True)
class ReusedKeyframe:
    """Known keyframe that can be reused as the reference."""

    record: KeyframeRecord  # Record of the keyframe.
    keyframe: ReferenceKeyframe  # The keyframe, rebuilt from the record.
    candidate: PoseHypothesis  # Alignment of the frame to the keyframe.

    def measurement_of(self, keyframe: int) -> RelativePose:
        """Return the measured pose of a new keyframe relative to the reused keyframe.

        Args:
            keyframe: Id of the new keyframe, which is made of the aligned frame.
        """
        seen = self.candidate.alignment
        return RelativePose(self.record.id, keyframe, seen.T_reference_camera, seen.information)


@dataclass(frozen=True, slots=True)
class KeyframeReuse:
    """Search for a known keyframe that can be the reference instead of a new keyframe."""

    pyramid: PyramidConfig
    align: AlignConfig
    keyframes: KeyframeConfig
    tracking_quality: TrackingQualityConfig
    config: KeyframeReuseConfig
    aligner: Aligner = CPU_ALIGNER

    def find(
        self, view: Pyramid, near: Sequence[Nearby], history: ResidualHistory
    ) -> ReusedKeyframe | None:
        """Find the first keyframe to which a frame aligns at the pose that the map predicts.

        Args:
            view: Pyramid of the frame.
            near: Each record with the T_keyframe_camera [4, 4] that the map predicts, the nearest
                record first.
            history: Residual noise of the last frames, which limits the noise of the alignment.

        Returns:
            The keyframe, or None if all keyframes are too far or no alignment is verified.
        """
        for record, T_record_camera in near[: self.config.tries]:
            keyframe = record.keyframe(self.pyramid)
            candidate = align_hypothesis(
                keyframe, view, T_record_camera, "reused", self.align, self.aligner
            )
            histories = history, record.history(history)
            if self._is_sure(candidate, T_record_camera, histories):
                return ReusedKeyframe(record, keyframe, candidate)
        return None

    def _is_sure(
        self,
        candidate: PoseHypothesis,
        T_record_camera: np.ndarray,
        histories: Sequence[ResidualHistory],
    ) -> bool:
        seen, T = candidate.alignment, candidate.alignment.T_reference_camera
        agrees = hypothesis_distance_rad(candidate, T_record_camera) < self.config.agreement_rad
        confirmed = replace(candidate, is_confirmed=agrees)
        return (
            not left_keyframe_view(T, seen.overlap, candidate.median_depth_m, self.keyframes)
            and seen.geometric_inliers >= self.config.min_geometric_inliers
            and all(
                classify_tracking(confirmed, history, TrackingStatus.OK, self.tracking_quality)
                is TrackingStatus.OK
                for history in histories
            )
        )


def find_nearby_keyframes(
    records: Sequence[KeyframeRecord],
    T_map_keyframe: Mapping[int, np.ndarray],
    T_map_camera: np.ndarray,
    config: KeyframeConfig,
) -> list[Nearby]:
    """Return the records near a camera pose, the nearest first.

    A record is near if its rotation and translation to the camera are within the limits of
    `config`. Within these limits, a frame needs no new keyframe.

    Args:
        records: Records to choose from; those without a pose in the map are skipped.
        T_map_keyframe: Poses [4, 4] of the keyframes in the map, by id.
        T_map_camera: Pose of the camera in the map, [4, 4].
        config: Limits of rotation and translation; see `limit_ratios`.
    """
    known = [record for record in records if record.id in T_map_keyframe]
    if not known:
        return []
    T_camera = se3.inverse(np.array([T_map_keyframe[p.id] for p in known])) @ T_map_camera
    left = limit_ratios(T_camera, np.array([record.median_depth_m for record in known]), config)
    order = np.argsort(left, kind="stable")
    return [(known[k], T_camera[k]) for k in order if left[k] <= 1]
