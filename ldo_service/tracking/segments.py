"""Stretches of tracking without a loss, and which of them are known to meet.

A camera that stays lost begins a new segment, with a first keyframe of its own. Where that is
among the older ones is found out when a keyframe of another segment is recognised, twice and to
the same effect: a false join would fold two places into one. Conventions: `ldo_service.geometry`.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3

from .motion import extent


@dataclass(frozen=True, slots=True)
class SegmentConfig:
    begin_after: int = 90  # LOST frames in a row: 3 s at 30 Hz, ORB-SLAM3's patience; 0: never
    # Frames between looks for the other segments: twice a second at 30 Hz. A prime, so that it
    # does not meet a frame held out from mapping each time.
    look_every: int = 17
    confirm_after: int = 7  # frames from a find to the look that confirms it
    confirm_rad: float = 0.06  # rotation plus parallax between the two looks that join

    def __post_init__(self) -> None:
        if self.begin_after < 0 or min(self.look_every, self.confirm_after) < 1:
            raise ConfigError(
                "begin_after must be at least 0, look_every and confirm_after at least 1."
            )
        if not self.confirm_rad > 0:
            raise ConfigError(f"confirm_rad={self.confirm_rad:g} must be positive.")


@dataclass(frozen=True, slots=True)
class Join:
    """The camera as a keyframe of another segment sees it; `information` as in `Tracked`."""

    keyframe: int
    segment: int  # of the keyframe
    T_keyframe_camera: np.ndarray  # [4, 4]
    information: np.ndarray  # [6, 6]


@dataclass(frozen=True, slots=True)
class Look:
    """One segment as seen from another: where their odometry frames are to each other."""

    here: int
    there: int
    T_there_here: np.ndarray  # [4, 4]
    median_depth_m: float  # of what was recognised

    def agrees(self, other: "Look", config: SegmentConfig) -> bool:
        if (self.here, self.there) != (other.here, other.there):
            return False
        difference = se3.inverse(self.T_there_here) @ other.T_there_here
        return extent(difference, self.median_depth_m) < config.confirm_rad


@dataclass(frozen=True, slots=True)
class Segments:
    """`roots[s]` is the oldest segment that s is joined to, itself where there is none."""

    roots: tuple[int, ...] = ()
    lost: int = 0  # frames in a row
    since_look: int = 0  # frames
    last: Look | None = None  # what the last look found

    def begun(self) -> "Segments":
        return Segments((*self.roots, len(self.roots)))

    def after(self, is_lost: bool) -> "Segments":
        """One frame later."""
        return replace(self, lost=self.lost + 1 if is_lost else 0, since_look=self.since_look + 1)

    def may_begin(self, config: SegmentConfig) -> bool:
        return 0 < config.begin_after <= self.lost

    def is_time_to_look(self, config: SegmentConfig) -> bool:
        """Whether any segments are apart, and the last look was long enough ago."""
        wait = config.look_every if self.last is None else config.confirm_after
        return len(set(self.roots)) > 1 and self.since_look >= wait

    def are_joined(self, segment: int, other: int) -> bool:
        return self.roots[segment] == self.roots[other]

    def is_confirmed_by(self, look: Look, config: SegmentConfig) -> bool:
        return self.last is not None and self.last.agrees(look, config)

    def looked(self, found: Look | None) -> "Segments":
        return replace(self, since_look=0, last=found)

    def joined(self, segment: int, other: int) -> "Segments":
        older, younger = sorted((self.roots[segment], self.roots[other]))
        roots = tuple(older if root == younger else root for root in self.roots)
        return replace(self, roots=roots, last=None)

    @property
    def packed(self) -> dict[str, Any]:
        """Arrays and plain values."""
        return asdict(self)

    @staticmethod
    def unpacked(kept: dict[str, Any]) -> "Segments":
        last = None if kept["last"] is None else Look(**kept["last"])
        return Segments(**{**kept, "roots": tuple(kept["roots"]), "last": last})
