"""Keyframes that follow each other, taken together: what is recognised. Paper, III.C."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.tracking.keyframe_database import KeyframeRecord
from ldo_service.tracking.motion import image_motion_rad

from .object_points import DetectionPoints, SubgraphLandmarks


@dataclass(frozen=True, slots=True)
class SubgraphConfig:
    least: int = 3  # keyframes (III.C)
    most: int = 5  # keyframes (III.C)
    turned_rad: float = 0.5  # rotation plus parallax from first to last, after which `least` are
    # enough: half of what a depth camera sees is new then
    gap_rad: float = 1.5  # likewise, from one to the next, after which a new one begins: keyframes
    # that follow each other are 0.35 apart, unless frames were dropped
    kept_views: int = (
        2  # of each: 0.13 MB a view at 640x480. More found no more on flat and kitchen
    )

    def __post_init__(self) -> None:
        if not 1 <= self.kept_views <= self.most or not 1 <= self.least <= self.most:
            raise ConfigError(
                named(self, "least", "most", "kept_views")
                + ": 1 <= least <= most and 1 <= kept_views <= most are needed."
            )
        if not (self.turned_rad > 0 and self.gap_rad > 0):
            raise ConfigError(
                named(self, "turned_rad", "gap_rad") + ": turned_rad and gap_rad must be positive."
            )


@dataclass(frozen=True, eq=False)
class SubgraphKeyframe:
    """A keyframe as places are recognised by.

    words [W] float32 counts of visual words; path_m how far the camera had come by then
    """

    place: KeyframeRecord
    frame: int  # of the camera
    stamp_ns: int
    path_m: float
    has_detections: bool  # by a detector
    sightings: DetectionPoints
    words: np.ndarray

    @property
    def keyframe(self) -> int:
        return self.place.id

    def pack(self) -> dict[str, Any]:
        """Return arrays and plain values, the same object each time."""
        return self._packed

    @cached_property
    def _packed(self) -> dict[str, Any]:
        kept = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**kept, "place": self.place.pack(), "sightings": asdict(self.sightings)}

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "SubgraphKeyframe":
        """The inverse of `pack`."""
        place, sightings = (
            KeyframeRecord.unpack(kept["place"]),
            DetectionPoints(**kept["sightings"]),
        )
        return SubgraphKeyframe(**{**kept, "place": place, "sightings": sightings})


@dataclass(frozen=True, eq=False)
class Subgraph:
    """`views` are those kept, the oldest first.

    names [C], layout [512] and words [W] float32 are its histograms
    """

    views: tuple[SubgraphKeyframe, ...]
    keyframes: tuple[int, ...]
    first_frame: int
    last_frame: int
    stamp_ns: int  # of its newest keyframe
    path_m: float  # likewise
    has_detections: bool
    landmarks: SubgraphLandmarks
    names: np.ndarray
    layout: np.ndarray
    words: np.ndarray

    @property
    def submap(self) -> int:
        return self.views[0].place.submap

    def pack(self) -> dict[str, Any]:
        """Return arrays and plain values, the same object each time."""
        return self._packed

    @cached_property
    def _packed(self) -> dict[str, Any]:
        kept = {field.name: getattr(self, field.name) for field in fields(self)}
        views = [view.pack() for view in self.views]
        return {**kept, "views": views, "landmarks": self.landmarks.pack()}

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "Subgraph":
        """The inverse of `pack`."""
        changed = {
            "views": tuple(map(SubgraphKeyframe.unpack, kept["views"])),
            "keyframes": tuple(kept["keyframes"]),
            "landmarks": SubgraphLandmarks(**kept["landmarks"]),
        }
        return Subgraph(**{**kept, **changed})


def follows(before: KeyframeRecord, place: KeyframeRecord, config: SubgraphConfig) -> bool:
    """Whether a keyframe goes on where the one before was made: others may lie between that were
    made long ago."""
    moved = se3.inverse(before.T_odom_keyframe) @ place.T_odom_keyframe
    is_near = image_motion_rad(moved, before.median_depth_m) <= config.gap_rad
    return is_near and before.submap == place.submap


def is_complete(views: Sequence[SubgraphKeyframe], config: SubgraphConfig) -> bool:
    """Whether keyframes of one submap make a subgraph: enough of them, or far enough apart."""
    if len(views) < config.least:
        return False
    first, last = views[0].place, views[-1].place
    moved = se3.inverse(first.T_odom_keyframe) @ last.T_odom_keyframe
    return (
        len(views) >= config.most
        or image_motion_rad(moved, first.median_depth_m) > config.turned_rad
    )


def evenly_spaced(views: Sequence[SubgraphKeyframe], count: int) -> tuple[SubgraphKeyframe, ...]:
    """So many of them, at equal steps, the first and the last included; the middle one of one."""
    if count == 1:
        return (views[len(views) // 2],)
    at = np.rint(np.linspace(0, len(views) - 1, min(count, len(views)))).astype(int)
    return tuple(views[index] for index in at)
