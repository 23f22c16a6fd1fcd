"""Stretches of tracking without a loss, and which of them are known to meet.

A camera that stays lost begins a new submap, with a first keyframe of its own. Where that is
among the older ones is found out when keyframes of another submap are recognised, twice and to
the same effect, in views that share nothing: a corridor's ends may look alike, and a false join
would fold two places into one. Conventions: `ldo_service.geometry`.
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
    begin_after_s: float = 3.0  # LOST without a break: ORB-SLAM3's patience; 0: never
    # Frames between looks for the other submaps: twice a second at 30 Hz. A prime, so that it
    # does not meet a frame held out from mapping each time.
    look_every: int = 17
    confirm_after: int = 7  # frames between looks while a find is to be confirmed
    confirm_rad: float = 0.06  # rotation plus parallax between what the two looks say
    # How far the camera has turned from one to the other, plus a third of the parallax: as wide as
    # a depth camera sees. Lower values join sooner and believe twins.
    confirm_apart_rad: float = 1.0
    misses: int = 3  # looks in a row that find nothing before a find is forgotten

    def __post_init__(self) -> None:
        if not self.begin_after_s >= 0 or min(self.look_every, self.confirm_after) < 1:
            raise ConfigError(
                "begin_after_s must be at least 0, look_every and confirm_after at least 1."
            )
        if not (self.confirm_rad > 0 and self.confirm_apart_rad >= 0 and self.misses >= 0):
            raise ConfigError(
                "confirm_rad must be positive, confirm_apart_rad and misses at least 0."
            )


@dataclass(frozen=True, slots=True)
class SubmapMeasurement:
    """The camera as a keyframe of another submap sees it; `information` as in `TrackingResult`."""

    keyframe: int
    submap: int  # of the keyframe
    T_keyframe_camera: np.ndarray  # [4, 4]
    information: np.ndarray  # [6, 6]

    @staticmethod
    def of(keyframe: ReferenceKeyframe, alignment: Alignment) -> "SubmapMeasurement":
        """By the alignment of the camera's frame to that keyframe."""
        T_keyframe_camera = alignment.T_reference_camera
        return SubmapMeasurement(
            keyframe.id, keyframe.submap, T_keyframe_camera, alignment.information
        )

    def measures(self, keyframe: int) -> RelativePose:
        """The pose of the keyframe that the camera's frame was made."""
        return RelativePose(self.keyframe, keyframe, self.T_keyframe_camera, self.information)


@dataclass(frozen=True, slots=True)
class SubmapMatch:
    """One submap as seen from another: where their odometry frames are to each other."""

    here: int
    there: int
    T_there_here: np.ndarray  # [4, 4]
    T_here_camera: np.ndarray  # [4, 4], of the view
    median_depth_m: float  # of what was recognised

    @staticmethod
    def at(
        keyframe: ReferenceKeyframe, alignment: Alignment, here: int, T_here_camera: np.ndarray
    ) -> "SubmapMatch":
        """By the alignment of a frame at T_here_camera [4, 4] to a keyframe of another submap."""
        T_there_camera = keyframe.T_odom_keyframe @ alignment.T_reference_camera
        T_there_here = T_there_camera @ se3.inverse(T_here_camera)
        median_depth_m = keyframe.reference.median_depth_m
        return SubmapMatch(here, keyframe.submap, T_there_here, T_here_camera, median_depth_m)

    def is_consistent_with(self, other: "SubmapMatch", config: SubmapConfig) -> bool:
        if (self.here, self.there) != (other.here, other.there):
            return False
        difference = se3.inverse(self.T_there_here) @ other.T_there_here
        return image_motion_rad(difference, self.median_depth_m) < config.confirm_rad

    def is_distinct_from(self, other: "SubmapMatch", config: SubmapConfig) -> bool:
        """Whether the views are so different that a chance likeness of both is unlikely."""
        moved = se3.inverse(self.T_here_camera) @ other.T_here_camera
        return image_motion_rad(moved, 3.0 * self.median_depth_m) >= config.confirm_apart_rad


@dataclass(frozen=True, slots=True)
class Submaps:
    """`roots[s]` is the oldest submap that s is joined to, itself where there is none."""

    roots: tuple[int, ...] = ()
    lost_since_ns: int | None = None  # stamp of the first frame of those LOST in a row
    frames_since_search: int = 0  # frames
    pending_match: SubmapMatch | None = None  # the find that is to be confirmed
    missed: int = 0  # looks in a row since it that found nothing

    def started(self) -> "Submaps":
        return Submaps((*self.roots, len(self.roots)))

    def after(self, is_lost: bool, stamp_ns: int) -> "Submaps":
        """One frame later; a camera that starts again may count time from an earlier point."""
        known = self.lost_since_ns
        since_ns = stamp_ns if known is None else min(known, stamp_ns)
        return replace(
            self,
            lost_since_ns=since_ns if is_lost else None,
            frames_since_search=self.frames_since_search + 1,
        )

    def should_start(self, stamp_ns: int, config: SubmapConfig) -> bool:
        """Whether a frame of this stamp is LOST, and those before it were for long enough."""
        if self.lost_since_ns is None or config.begin_after_s == 0:
            return False
        return stamp_ns - self.lost_since_ns >= 1e9 * config.begin_after_s

    def is_search_due(self, config: SubmapConfig) -> bool:
        """Whether any submaps are apart, and the last look was long enough ago."""
        wait = config.look_every if self.pending_match is None else config.confirm_after
        return len(set(self.roots)) > 1 and self.frames_since_search >= wait

    def are_merged(self, submap: int, other: int) -> bool:
        return self.roots[submap] == self.roots[other]

    def is_confirmed_by(self, look: SubmapMatch, config: SubmapConfig) -> bool:
        """Whether both say the same of different views."""
        last = self.pending_match
        return (
            last is not None
            and last.is_consistent_with(look, config)
            and last.is_distinct_from(look, config)
        )

    def with_search_result(self, found: SubmapMatch | None, config: SubmapConfig) -> "Submaps":
        """The oldest find that nothing speaks against is kept."""
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
        older, younger = sorted((self.roots[submap], self.roots[other]))
        roots = tuple(older if root == younger else root for root in self.roots)
        return replace(self, roots=roots, pending_match=None)

    def pack(self) -> dict[str, Any]:
        """Arrays and plain values."""
        return asdict(self)

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "Submaps":
        match = kept["pending_match"]
        return Submaps(
            **{
                **kept,
                "roots": tuple(kept["roots"]),
                "pending_match": match and SubmapMatch(**match),
            }
        )
