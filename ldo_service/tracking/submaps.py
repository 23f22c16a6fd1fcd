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

FRAMES_PER_VIEW = 3  # A LOST frame that shows another view counts like this many frames.


@dataclass(frozen=True, slots=True)
class SubmapConfig:
    """Settings of submaps."""

    # Number of LOST frames in a row, each searched in vain, after which a new submap starts;
    # 0: never. In the kitchen at 30 Hz, relocalization took up to 87 frames. A third of this
    # number is enough if all frames show different views, as with a fast camera or few
    # frames per second: at 2 to 5 Hz, relocalization took at most 10 frames.
    begin_after_frames: int = 90
    # Correlation of the thumbnails of two frames below which the frames show different views.
    max_view_correlation: float = 0.9
    # Frames between searches of the other submaps. A prime number, so that the searches do not
    # coincide with the frames that are held out from mapping.
    search_interval_frames: int = 17
    confirm_after: int = 7  # Frames between searches while a match is pending.
    confirm_rad: float = 0.06  # Maximum rotation plus parallax between two consistent matches.
    # Minimum rotation plus a third of the parallax between the camera poses of two matches. The
    # default is the field of view of a depth camera. Lower values merge sooner and accept
    # perceptual aliases.
    confirm_apart_rad: float = 1.0
    # Maximum number of searches in a row without a match; more of them drop the pending match.
    misses: int = 3

    def __post_init__(self) -> None:
        if self.begin_after_frames < 0 or min(self.search_interval_frames, self.confirm_after) < 1:
            raise ConfigError(
                f"SubmapConfig.begin_after_frames={self.begin_after_frames} must be at least 0, "
                f"and search_interval_frames={self.search_interval_frames} and "
                f"confirm_after={self.confirm_after} must be at least 1."
            )
        if not -1 <= self.max_view_correlation <= 1:
            raise ConfigError(
                f"SubmapConfig.max_view_correlation={self.max_view_correlation:g} must be within "
                "-1..1."
            )
        if not (self.confirm_rad > 0 and self.confirm_apart_rad >= 0 and self.misses >= 0):
            raise ConfigError(
                f"SubmapConfig.confirm_rad={self.confirm_rad:g} must be positive, "
                f"and confirm_apart_rad={self.confirm_apart_rad:g} and misses={self.misses} must "
                "be at least 0."
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

    def measurement_of(self, keyframe: int) -> RelativePose:
        """Return the measured pose of a new keyframe relative to the keyframe `self.keyframe`.

        Args:
            keyframe: Id of the new keyframe, which is made of the frame of this measurement.
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

        Two matches from clearly different camera poses are unlikely to be both perceptual aliases.
        """
        moved = se3.inverse(self.T_here_camera) @ other.T_here_camera
        return image_motion_rad(moved, 3.0 * self.median_depth_m) >= config.confirm_apart_rad


@dataclass(frozen=True, slots=True)
class Submaps:
    """Record of which submaps are merged, and state of the search for further merges."""

    # Oldest submap that each submap is merged with, or the submap itself if it is not merged.
    roots: tuple[int, ...] = ()
    lost_frames: int = 0  # LOST frames in a row for which relocalization found no keyframe.
    lost_views: int = 0  # Number of these frames that differ from the last counted one.
    # Thumbnail of the last counted view, [300] int8; None without LOST frames.
    lost_thumbnail: np.ndarray | None = None
    frames_since_search: int = 0  # Frames since the last search of the other submaps.
    pending_match: SubmapMatch | None = None  # First match, which a second one must confirm.
    missed: int = 0  # Searches of the other submaps in a row without a match.

    def started(self) -> "Submaps":
        """Return the state with one more submap, which is not merged with any other."""
        return Submaps((*self.roots, len(self.roots)))

    def after_tracked(self) -> "Submaps":
        """Return the state after a frame that is not LOST."""
        since = self.frames_since_search + 1
        return replace(
            self, lost_frames=0, lost_views=0, lost_thumbnail=None, frames_since_search=since
        )

    def after_lost(self, thumbnail: np.ndarray | None, config: SubmapConfig) -> "Submaps":
        """Return the state after a LOST frame.

        Args:
            thumbnail: Thumbnail of the frame, [300] int8; None if the frame has too little depth
                for relocalization.
            config: Settings.
        """
        after = replace(self, frames_since_search=self.frames_since_search + 1)
        if thumbnail is None:
            return after
        last = self.lost_thumbnail
        is_view = last is None or _correlation(thumbnail, last) < config.max_view_correlation
        return replace(
            after,
            lost_frames=self.lost_frames + 1,
            lost_views=self.lost_views + is_view,
            lost_thumbnail=thumbnail if is_view else last,
        )

    def should_start(self, config: SubmapConfig) -> bool:
        """Return whether relocalization failed for so many LOST frames that a submap starts."""
        count = max(self.lost_frames, FRAMES_PER_VIEW * self.lost_views)
        return 0 < config.begin_after_frames <= count

    def is_search_due(self, config: SubmapConfig) -> bool:
        """Return whether to search the other submaps with the current frame.

        A search is due if unmerged submaps exist and the last search was long enough ago.
        """
        wait = config.search_interval_frames if self.pending_match is None else config.confirm_after
        return len(set(self.roots)) > 1 and self.frames_since_search >= wait

    def are_merged(self, submap: int, other: int) -> bool:
        """Return whether two submaps are merged, directly or through other submaps."""
        return self.roots[submap] == self.roots[other]

    def is_confirmed_by(self, match: SubmapMatch, config: SubmapConfig) -> bool:
        """Return whether a match confirms the pending match.

        Both matches must agree on the relative pose of the submaps, and the camera poses of their
        frames must clearly differ.
        """
        last = self.pending_match
        return (
            last is not None
            and last.is_consistent_with(match, config)
            and last.is_distinct_from(match, config)
        )

    def with_search_result(self, found: SubmapMatch | None, config: SubmapConfig) -> "Submaps":
        """Return the state after a search of the other submaps.

        If the new match is consistent with the pending match, the pending match stays. Otherwise,
        the new match becomes the pending match. `is_confirmed_by` decides whether both matches
        together are enough to merge the submaps.

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
        """Return the state with two submaps merged; the oldest submap becomes the root of both."""
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
        # A state of an earlier version has a stamp instead of counters, which start at 0.
        kept = {name: value for name, value in kept.items() if name != "lost_since_ns"}
        return Submaps(
            **{
                **kept,
                "roots": tuple(kept["roots"]),
                "pending_match": match and SubmapMatch(**match),
            }
        )


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of two thumbnails with mean 0, -1..1; 1 if one has no contrast."""
    first, second = a.astype(float), b.astype(float)
    scale = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / scale if scale > 0 else 1.0
