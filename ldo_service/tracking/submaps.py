"""Submaps: parts of the map between two losses of tracking, and their merging.

A camera that stays lost starts a new submap with its own first keyframe. Two submaps are merged
after two consistent matches between them, from frames with clearly different poses. A single match
may be a perceptual alias, such as the other end of a corridor. A false merge would place two
different rooms on top of each other. Conventions: `ldo_service.geometry`.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .alignment import Alignment
from .keyframes import ReferenceKeyframe
from .motion import image_motion_rad


@dataclass(frozen=True, slots=True)
class SubmapConfig:
    """Settings of submaps."""

    # Time that tracking must be LOST without interruption before a new submap starts, as in
    # ORB-SLAM3; 0: never.
    begin_after_s: float = 3.0
    # Frames between searches of the other submaps: twice a second at 30 Hz. A prime number, so that
    # the searches do not coincide with the frames that are held out from mapping.
    search_interval_frames: int = 17
    confirm_after: int = 7  # Frames between searches while a match is pending.
    confirm_rad: float = 0.06  # Maximum rotation plus parallax between two consistent matches.
    # Minimum rotation plus a third of the parallax between the camera poses of two matches. The
    # default is the field of view of a depth camera. Lower values merge sooner and accept
    # perceptual aliases.
    confirm_apart_rad: float = 1.0
    misses: int = 3  # Number of searches in a row without a match that a pending match survives.

    def __post_init__(self) -> None:
        if not self.begin_after_s >= 0 or min(self.search_interval_frames, self.confirm_after) < 1:
            raise ConfigError(
                f"SubmapConfig.begin_after_s={self.begin_after_s:g} must be at least 0, "
                f"search_interval_frames={self.search_interval_frames} and "
                f"confirm_after={self.confirm_after} at least 1."
            )
        if not (self.confirm_rad > 0 and self.confirm_apart_rad >= 0 and self.misses >= 0):
            raise ConfigError(
                f"SubmapConfig.confirm_rad={self.confirm_rad:g} must be positive, "
                f"confirm_apart_rad={self.confirm_apart_rad:g} and misses={self.misses} at least 0."
            )


@dataclass(frozen=True, slots=True)
class SubmapMeasurement:
    """Pose of the camera relative to a keyframe of another submap."""

    keyframe: int  # Id of the keyframe.
    submap: int  # Submap of the keyframe.
    T_keyframe_camera: np.ndarray  # [4, 4]
    information: np.ndarray  # [6, 6], as in `TrackingResult`.

    @staticmethod
    def of(keyframe: ReferenceKeyframe, alignment: Alignment) -> "SubmapMeasurement":
        """Return the measurement that follows from the alignment of the frame to a keyframe."""
        T_keyframe_camera = alignment.T_reference_camera
        return SubmapMeasurement(
            keyframe.id, keyframe.submap, T_keyframe_camera, alignment.information
        )

    def measures(self, keyframe: int) -> RelativePose:
        """Return the measured pose of a new keyframe relative to the keyframe of the other submap.

        Args:
            keyframe: Id of the new keyframe, which is made of the measured frame.
        """
        return RelativePose(self.keyframe, keyframe, self.T_keyframe_camera, self.information)


@dataclass(frozen=True, slots=True)
class SubmapMatch:
    """Relative pose of the odometry frames of two submaps, from one relocalized frame."""

    here: int  # Submap of the frame.
    there: int  # Submap of the keyframe.
    T_there_here: np.ndarray  # [4, 4]
    T_here_camera: np.ndarray  # Pose of the frame, [4, 4].
    median_depth_m: float  # Median depth of the keyframe.

    @staticmethod
    def at(
        keyframe: ReferenceKeyframe, alignment: Alignment, here: int, T_here_camera: np.ndarray
    ) -> "SubmapMatch":
        """Return the match that follows from the alignment to a keyframe of another submap.

        Args:
            keyframe: The keyframe.
            alignment: Alignment of the frame to the keyframe.
            here: Submap of the frame.
            T_here_camera: Pose of the frame in odometry, [4, 4].
        """
        T_there_camera = keyframe.T_odom_keyframe @ alignment.T_reference_camera
        T_there_here = T_there_camera @ se3.inverse(T_here_camera)
        median_depth_m = keyframe.reference.median_depth_m
        return SubmapMatch(here, keyframe.submap, T_there_here, T_here_camera, median_depth_m)

    def is_consistent_with(self, other: "SubmapMatch", config: SubmapConfig) -> bool:
        """Return whether two matches agree on the relative pose of the same two submaps."""
        if (self.here, self.there) != (other.here, other.there):
            return False
        difference = se3.inverse(self.T_there_here) @ other.T_there_here
        return image_motion_rad(difference, self.median_depth_m) < config.confirm_rad

    def is_distinct_from(self, other: "SubmapMatch", config: SubmapConfig) -> bool:
        """Return whether the frames of two matches have clearly different camera poses.

        It is then unlikely that both matches are perceptual aliases.
        """
        moved = se3.inverse(self.T_here_camera) @ other.T_here_camera
        return image_motion_rad(moved, 3.0 * self.median_depth_m) >= config.confirm_apart_rad


@dataclass(frozen=True, slots=True)
class Submaps:
    """Merged submaps, and the state of the search for further merges."""

    # Oldest submap that each submap is merged with, by submap; the submap itself if it is not
    # merged.
    roots: tuple[int, ...] = ()
    # Stamp of the first of the successive LOST frames; None if the last frame was not LOST.
    lost_since_ns: int | None = None
    frames_since_search: int = 0
    pending_match: SubmapMatch | None = None  # Match that awaits confirmation.
    missed: int = 0  # Searches in a row without a match.

    def started(self) -> "Submaps":
        """Return the state with one more submap, which is not merged with any other."""
        return Submaps((*self.roots, len(self.roots)))

    def after(self, is_lost: bool, stamp_ns: int) -> "Submaps":
        """Return the state after one more frame.

        If the camera restarts while LOST, stamps may go back. The LOST time then counts from the
        earliest stamp.

        Args:
            is_lost: True if the tracking status of the frame is LOST.
            stamp_ns: Stamp of the frame.
        """
        known = self.lost_since_ns
        since_ns = stamp_ns if known is None else min(known, stamp_ns)
        return replace(
            self,
            lost_since_ns=since_ns if is_lost else None,
            frames_since_search=self.frames_since_search + 1,
        )

    def should_start(self, stamp_ns: int, config: SubmapConfig) -> bool:
        """Return whether tracking has been LOST for long enough at a stamp to start a submap."""
        if self.lost_since_ns is None or config.begin_after_s == 0:
            return False
        return stamp_ns - self.lost_since_ns >= 1e9 * config.begin_after_s

    def is_search_due(self, config: SubmapConfig) -> bool:
        """Return whether to search the other submaps with the current frame.

        A search is due if unmerged submaps exist and the last search was long enough ago.
        """
        wait = config.search_interval_frames if self.pending_match is None else config.confirm_after
        return len(set(self.roots)) > 1 and self.frames_since_search >= wait

    def are_merged(self, submap: int, other: int) -> bool:
        """Return whether two submaps are merged, directly or through other submaps."""
        return self.roots[submap] == self.roots[other]

    def is_confirmed_by(self, look: SubmapMatch, config: SubmapConfig) -> bool:
        """Return whether a match confirms the pending match.

        Both matches must agree on the relative pose of the submaps, and the camera poses of their
        frames must clearly differ.
        """
        last = self.pending_match
        return (
            last is not None
            and last.is_consistent_with(look, config)
            and last.is_distinct_from(look, config)
        )

    def with_search_result(self, found: SubmapMatch | None, config: SubmapConfig) -> "Submaps":
        """Return the state after a search of the other submaps.

        A match that is inconsistent with the pending match becomes the pending match.

        Args:
            found: The match, or None if the search found none. More than `config.misses` searches
                in a row without a match drop the pending match.
            config: Settings.
        """
        if found is None:
            is_kept = self.missed < config.misses
            return replace(
                self,
                frames_since_search=0,
                pending_match=self.pending_match if is_kept else None,
                missed=self.missed + 1,
            )
        is_same = self.pending_match is not None and self.pending_match.is_consistent_with(
            found, config
        )
        return replace(
            self,
            frames_since_search=0,
            pending_match=self.pending_match if is_same else found,
            missed=0,
        )

    def with_merge(self, submap: int, other: int) -> "Submaps":
        """Return the state with two submaps merged."""
        older, younger = sorted((self.roots[submap], self.roots[other]))
        roots = tuple(older if root == younger else root for root in self.roots)
        return replace(self, roots=roots, pending_match=None)

    def pack(self) -> dict[str, Any]:
        """Return the state as arrays and plain values."""
        return asdict(self)

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "Submaps":
        """Return the state from its packed form."""
        match = kept["pending_match"]
        return Submaps(
            **{
                **kept,
                "roots": tuple(kept["roots"]),
                "pending_match": match and SubmapMatch(**match),
            }
        )
