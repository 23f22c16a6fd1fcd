"""Subgraphs: groups of consecutive keyframes, which loop detection compares.

See the LDO-SLAM paper, III.C.
"""

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
    """Settings of subgraphs: groups of consecutive keyframes that are compared as a whole."""

    min_keyframes: int = 3  # Minimum keyframes of a subgraph (LDO-SLAM paper, III.C).
    max_keyframes: int = 5  # Maximum keyframes of a subgraph (LDO-SLAM paper, III.C).
    # A subgraph is complete with `min_keyframes` keyframes if the rotation plus parallax from its
    # first to its last keyframe exceeds this. Half of the view of a depth camera is then new.
    # Parallax is the distance divided by the median depth.
    turned_rad: float = 0.5
    # A new subgraph begins if the rotation plus parallax between two keyframes exceeds this.
    # Consecutive keyframes are 0.35 rad apart, unless frames were dropped.
    gap_rad: float = 1.5
    # Number of keyframes of a complete subgraph that are stored for later comparisons, 0.13 MB
    # each at 640x480. With a larger number, no more loops were found on the sequences kitchen and
    # `synthetic:flat`.
    kept_views: int = 2

    def __post_init__(self) -> None:
        if (
            not 1 <= self.kept_views <= self.max_keyframes
            or not 1 <= self.min_keyframes <= self.max_keyframes
        ):
            raise ConfigError(
                named(self, "min_keyframes", "max_keyframes", "kept_views")
                + ": 1 <= min_keyframes <= max_keyframes and "
                + "1 <= kept_views <= max_keyframes must hold."
            )
        if not (self.turned_rad > 0 and self.gap_rad > 0):
            raise ConfigError(named(self, "turned_rad", "gap_rad") + " must be positive.")


@dataclass(frozen=True, eq=False)
class SubgraphKeyframe:
    """Keyframe of a subgraph with its descriptors.

    Attributes:
        place: Record of the keyframe.
        frame: Number of the camera frame.
        stamp_ns: Time of the keyframe, ns.
        path_m: Length of the camera path up to this keyframe, meters.
        has_detections: True if a detector ran on the keyframe, even if it found nothing.
        sightings: Detections as labelled 3D points.
        words: Counts of visual words, [W] float32.
    """

    place: KeyframeRecord
    frame: int
    stamp_ns: int
    path_m: float
    has_detections: bool
    sightings: DetectionPoints
    words: np.ndarray

    @property
    def keyframe(self) -> int:
        """Id of the keyframe."""
        return self.place.id

    def pack(self) -> dict[str, Any]:
        """Return a dictionary of the fields; repeated calls return the same dictionary.

        The values are arrays and plain values.
        """
        return self._packed

    @cached_property
    def _packed(self) -> dict[str, Any]:
        kept = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**kept, "place": self.place.pack(), "sightings": asdict(self.sightings)}

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "SubgraphKeyframe":
        """Return the keyframe that `pack` packed."""
        place, sightings = (
            KeyframeRecord.unpack(kept["place"]),
            DetectionPoints(**kept["sightings"]),
        )
        return SubgraphKeyframe(**{**kept, "place": place, "sightings": sightings})


@dataclass(frozen=True, eq=False)
class Subgraph:
    """Group of consecutive keyframes of one submap, with landmarks and histograms.

    Attributes:
        views: Stored keyframes, the oldest first.
        keyframes: Ids of all keyframes.
        first_frame: Smallest camera frame number of the keyframes.
        last_frame: Largest camera frame number of the keyframes.
        stamp_ns: Time of the newest keyframe, ns.
        path_m: Length of the camera path up to the newest keyframe, meters.
        has_detections: True if a detector ran on one of the keyframes.
        landmarks: Landmarks in the odometry frame of the submap.
        names: Histogram of labels, weighted by the detection scores, [256] float32.
        layout: Histogram of landmark pairs by labels and distance, [512] float32.
        words: Histogram of visual words, [W] float32.
    """

    views: tuple[SubgraphKeyframe, ...]
    keyframes: tuple[int, ...]
    first_frame: int
    last_frame: int
    stamp_ns: int
    path_m: float
    has_detections: bool
    landmarks: SubgraphLandmarks
    names: np.ndarray
    layout: np.ndarray
    words: np.ndarray

    @property
    def submap(self) -> int:
        """Number of the submap."""
        return self.views[0].place.submap

    def pack(self) -> dict[str, Any]:
        """Return a dictionary of the fields; repeated calls return the same dictionary.

        The values are arrays and plain values.
        """
        return self._packed

    @cached_property
    def _packed(self) -> dict[str, Any]:
        kept = {field.name: getattr(self, field.name) for field in fields(self)}
        views = [view.pack() for view in self.views]
        return {**kept, "views": views, "landmarks": self.landmarks.pack()}

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "Subgraph":
        """Return the subgraph that `pack` packed."""
        changed = {
            "views": tuple(map(SubgraphKeyframe.unpack, kept["views"])),
            "keyframes": tuple(kept["keyframes"]),
            "landmarks": SubgraphLandmarks(**kept["landmarks"]),
        }
        return Subgraph(**{**kept, **changed})


def follows(before: KeyframeRecord, place: KeyframeRecord, config: SubgraphConfig) -> bool:
    """Return whether a keyframe belongs to the same subgraph as the previous keyframe.

    Both keyframes must be in the same submap, and the rotation plus parallax between them must not
    exceed `gap_rad`. Consecutive keyframes can be far apart, because the tracker may have reused
    existing keyframes between them.

    Args:
        before: Record of the previous keyframe.
        place: Record of the new keyframe.
        config: Limits of subgraphs.
    """
    moved = se3.inverse(before.T_odom_keyframe) @ place.T_odom_keyframe
    is_near = image_motion_rad(moved, before.median_depth_m) <= config.gap_rad
    return is_near and before.submap == place.submap


def is_complete(views: Sequence[SubgraphKeyframe], config: SubgraphConfig) -> bool:
    """Return whether the keyframes `views` form a complete subgraph.

    A subgraph is complete with `max_keyframes` keyframes. It is also complete with `min_keyframes`
    if the rotation plus parallax from the first to the last keyframe exceeds `turned_rad`.
    """
    if len(views) < config.min_keyframes:
        return False
    first, last = views[0].place, views[-1].place
    moved = se3.inverse(first.T_odom_keyframe) @ last.T_odom_keyframe
    return (
        len(views) >= config.max_keyframes
        or image_motion_rad(moved, first.median_depth_m) > config.turned_rad
    )


def evenly_spaced(views: Sequence[SubgraphKeyframe], count: int) -> tuple[SubgraphKeyframe, ...]:
    """Select `count` keyframes at equal steps, including the first and the last.

    If `count` is 1, the middle keyframe is selected.
    """
    if count == 1:
        return (views[len(views) // 2],)
    at = np.rint(np.linspace(0, len(views) - 1, min(count, len(views)))).astype(int)
    return tuple(views[index] for index in at)
