"""Relocalization of a lost camera. Conventions: `ldo_service.geometry`.

A lost frame is compared with the keyframe records whose thumbnails are most similar
to that of the frame. It is also compared with a few further records, which change from search to
search. The time per frame is thus independent of the size of the database, and every record is
tried eventually. If ORB features find no match, SIFT features are tried on the newest records and a
few others. SIFT also matches a surface that is half or twice as far away, but takes ten times as
long.

A record is accepted if features and direct alignment agree on the pose. The criteria are stricter
than in tracking, since no predicted pose supports the result. A match is ambiguous and rejected if
a distant record of the same submap explains the frame almost as well. For example, the two ends of
a corridor may look alike. Records of different submaps are not compared, since their relative pose
is unknown here.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3

from .aligner import CPU_ALIGNER, Aligner
from .alignment import AlignConfig
from .features import (
    FeatureConfig,
    FeaturePose,
    Features,
    detect,
    detect_sift,
    estimate_pose,
)
from .keyframe_database import KeyframeDatabase, KeyframeRecord, make_thumbnail
from .keyframes import ReferenceKeyframe
from .motion import image_motion_rad
from .pose_candidates import PoseHypothesis, align_hypothesis, hypothesis_distance_rad
from .pyramid import Pyramid, PyramidConfig
from .tracking_quality import (
    ResidualHistory,
    TrackingQualityConfig,
    TrackingStatus,
    classify_tracking,
)

NEWEST = 2  # Number of newest records that each SIFT search includes: the camera may be near them.
# Multiple of `appearance_candidates`: number of ranked records to choose distinct candidates from.
RANKED = 10


PosedRecord = tuple[KeyframeRecord, FeaturePose]


@dataclass(frozen=True, slots=True)
class RelocalizationConfig:
    """Settings of relocalization."""

    # Number of records that a frame is compared with: those with the most similar thumbnails.
    appearance_candidates: int = 5
    # Number of further records that a frame is compared with. The next search uses the next
    # ones. All of 1000 records have had their turn after 11 s at 30 Hz.
    in_turn: int = 3
    # Number of further records that a lost frame is compared with by SIFT, which matches across
    # scales. The next search uses the next ones. 0: no SIFT.
    across_scales: int = 8
    # Maximum number of direct alignments per search, from the feature poses with most inliers.
    attempts: int = 3
    # Minimum inlier fraction of the points paired with a measured depth.
    min_geometric_inliers: float = 0.85
    # Maximum rotation plus parallax between the feature pose and the pose by alignment.
    agreement_rad: float = 0.06
    # Records of similar appearance within this distance of each other count as one candidate.
    variety_rad: float = 0.25
    # A match is ambiguous if a distant record has more than this fraction of the match's inliers.
    ambiguous_inlier_ratio: float = 0.3
    # A record is distant from the match if the camera poses that both give differ by more than
    # this: 57 degrees of rotation, or one median depth of translation.
    ambiguous_rad: float = 1.0
    # Minimum correlation of a WEAK frame's thumbnail with that of the last OK frame. Below it, the
    # frame shows another place and becomes LOST. On the sequence kitchen, successive frames
    # correlate above 0.93, and 97 % of the frames from different places correlate below 0.4.
    familiar: float = 0.4

    def __post_init__(self) -> None:
        if (
            self.appearance_candidates < 0
            or self.in_turn < 0
            or self.appearance_candidates + self.in_turn < 1
        ):
            raise ConfigError(
                named(self, "appearance_candidates", "in_turn")
                + ": neither value may be negative, and at least one must be positive."
            )
        if self.attempts < 1 or self.across_scales < 0:
            raise ConfigError(
                named(self, "attempts", "across_scales")
                + ": attempts must be at least 1, and across_scales at least 0."
            )
        if not min(self.agreement_rad, self.variety_rad, self.ambiguous_rad) > 0:
            raise ConfigError(
                named(self, "agreement_rad", "variety_rad", "ambiguous_rad") + " must be positive."
            )
        if not (0 <= self.min_geometric_inliers <= 1 and 0 <= self.ambiguous_inlier_ratio <= 1):
            raise ConfigError(
                named(self, "min_geometric_inliers", "ambiguous_inlier_ratio")
                + ": both values must be within 0..1."
            )
        if not 0 <= self.familiar <= 1:
            raise ConfigError(
                f"RelocalizationConfig.familiar={self.familiar:g} must be a correlation within "
                "0..1."
            )


@dataclass(frozen=True, slots=True)
class Relocalizer:
    """Relocalization of a frame in a keyframe database."""

    pyramid: PyramidConfig
    align: AlignConfig
    features: FeatureConfig
    tracking_quality: TrackingQualityConfig
    config: RelocalizationConfig
    aligner: Aligner = CPU_ALIGNER

    def find(
        self,
        view: Pyramid,
        database: KeyframeDatabase,
        turn: int,
        history: ResidualHistory,
        *,
        is_lost: bool = True,
    ) -> tuple[ReferenceKeyframe, PoseHypothesis] | None:
        """Find a keyframe that shows the same surface as a frame, and verify it by alignment.

        Args:
            view: Pyramid of the frame.
            database: Keyframe database to search.
            turn: Number of searches before this one. It selects the records that are tried besides
                the most similar and the newest ones.
            history: Residual noise of the last frames. It is used for records without stored noise.
            is_lost: True allows the search by SIFT, which is too slow while tracking works.

        Returns:
            The keyframe and the alignment of the frame to it. None if no keyframe is verified or
            the match is ambiguous.
        """
        if not len(database):
            return None
        likely = self._distinct_candidates(
            database.all[index] for index in database.rank_by_similarity(view)
        )
        poses = self._poses(view, _each_once(likely, _due(database, turn, self.config.in_turn)))
        sure = self._first_verified(view, poses, history)
        if sure is None and is_lost and self.config.across_scales:
            newest, due = database.all[-NEWEST:], _due(database, turn, self.config.across_scales)
            others = self._poses_across_scales(view, _each_once(newest, due))
            sure, poses = self._first_verified(view, others, history), [*poses, *others]
        if sure is None or self._is_ambiguous(*sure[0], poses):
            return None
        return sure[1]

    def resembles_last_trusted(self, view: Pyramid, trusted: np.ndarray) -> bool:
        """Return whether a frame looks like the last OK frame, which has thumbnail `trusted`."""
        seen, trusted = make_thumbnail(view).astype(float), trusted.astype(float)
        scale = np.linalg.norm(seen) * np.linalg.norm(trusted)
        return bool(seen @ trusted >= self.config.familiar * scale > 0)

    def _distinct_candidates(self, ranked: Iterable[KeyframeRecord]) -> list[KeyframeRecord]:
        """Return the first `appearance_candidates` ranked records that show distinct places."""
        likely: list[KeyframeRecord] = []
        for record in islice(ranked, RANKED * self.config.appearance_candidates):
            if len(likely) == self.config.appearance_candidates:
                break
            if all(_is_apart(record, other, self.config.variety_rad) for other in likely):
                likely.append(record)
        return likely

    def _poses(self, view: Pyramid, records: Iterable[KeyframeRecord]) -> list[PosedRecord]:
        """Return the records whose ORB features yield a pose of the frame, with that pose.

        The record with the most inliers comes first.
        """
        seen = detect(view, self.features)
        return self._posed(view, seen, ((record, record.features) for record in records))

    def _poses_across_scales(
        self, view: Pyramid, records: Iterable[KeyframeRecord]
    ) -> list[PosedRecord]:
        """Return the records whose SIFT features yield a pose of the frame, with that pose.

        The record with the most inliers comes first. SIFT also matches if the camera is at half or
        twice the distance to the surface.
        """
        config = self.features
        image = view.gray, view.depth_m, view.camera
        seen = detect_sift(*image, config.count_across_scales, config)
        known = ((record, record.sift_features(config)) for record in records)
        return self._posed(view, seen, known)

    def _posed(
        self, view: Pyramid, seen: Features, known: Iterable[tuple[KeyframeRecord, Features]]
    ) -> list[PosedRecord]:
        poses = [(p, estimate_pose(there, seen, view.camera, self.features)) for p, there in known]
        found = [(record, pose) for record, pose in poses if pose is not None]
        return sorted(found, key=lambda pp: -pp[1].inliers)

    def _first_verified(
        self, view: Pyramid, poses: Sequence[PosedRecord], history: ResidualHistory
    ) -> tuple[PosedRecord, tuple[ReferenceKeyframe, PoseHypothesis]] | None:
        """Return the first record and feature pose that direct alignment verifies, or None.

        The second element of the result is the keyframe of that record, with the alignment to it.
        """
        for record, pose in poses[: self.config.attempts]:
            keyframe = record.keyframe(self.pyramid)
            guess = se3.inverse(pose.T_camera_reference)
            candidate = align_hypothesis(
                keyframe, view, guess, "relocalized", self.align, self.aligner
            )
            if self._is_sure(candidate, guess, record.history(history)):
                return (record, pose), (keyframe, replace(candidate, is_confirmed=True))
        return None

    def _is_sure(
        self, candidate: PoseHypothesis, guess: np.ndarray, history: ResidualHistory
    ) -> bool:
        agrees = hypothesis_distance_rad(candidate, guess) < self.config.agreement_rad
        confirmed = replace(candidate, is_confirmed=agrees)
        status = classify_tracking(confirmed, history, TrackingStatus.LOST, self.tracking_quality)
        inliers = candidate.alignment.geometric_inliers
        return status is TrackingStatus.OK and inliers >= self.config.min_geometric_inliers

    def _is_ambiguous(
        self, record: KeyframeRecord, pose: FeaturePose, poses: Iterable[PosedRecord]
    ) -> bool:
        """Return whether a distant record of the same submap matches the frame almost as well."""
        T_odom_camera = _seen_from(record, pose)
        return any(
            other.submap == record.submap
            and other_pose.inliers > self.config.ambiguous_inlier_ratio * pose.inliers
            and image_motion_rad(
                se3.inverse(T_odom_camera) @ _seen_from(other, other_pose), record.median_depth_m
            )
            > self.config.ambiguous_rad
            for other, other_pose in poses
        )


def _due(database: KeyframeDatabase, turn: int, count: int) -> list[KeyframeRecord]:
    """Return the next `count` records after `turn` searches, in rotation over all records."""
    numbers = range(turn * count, (turn + 1) * count)
    return [database.all[number % len(database)] for number in numbers]


def _each_once(*groups: Iterable[KeyframeRecord]) -> list[KeyframeRecord]:
    return list(dict.fromkeys(chain(*groups)))


def _seen_from(record: KeyframeRecord, pose: FeaturePose) -> np.ndarray:
    """Return T_odom_camera [4, 4] of a frame, given its feature pose relative to a record."""
    return record.T_odom_keyframe @ se3.inverse(pose.T_camera_reference)


def _is_apart(record: KeyframeRecord, other: KeyframeRecord, limit_rad: float) -> bool:
    T_other_record = se3.inverse(other.T_odom_keyframe) @ record.T_odom_keyframe
    is_far = image_motion_rad(T_other_record, other.median_depth_m) > limit_rad
    return is_far or record.submap != other.submap
