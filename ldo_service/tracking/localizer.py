"""Localization in a finished map, which does not change. Conventions: `ldo_service.geometry`.

Odometry tracks the camera with its own keyframes. At intervals, the localizer relocalizes the frame
in the keyframe database of the map, which yields T_map_odom. Odometry is continuous; T_map_odom
jumps (REP-105).
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ldo_service.geometry import RgbdFrame, se3

from .keyframe_database import KeyframeDatabase
from .map_frame import MapCorrection
from .odometry import Odometry
from .odometry_config import OdometryConfig
from .odometry_prior import OdometryPriorBuffer
from .submaps import SubmapConfig, SubmapMatch
from .tracking_quality import TrackingStatus
from .tracking_result import KeyframeKind, TrackedFrame, TrackingResult, make_tracking_result

MAP = -1  # The map, in place of the number of a submap.


@dataclass(frozen=True, slots=True)
class MapFix:
    """Pose of the odometry frame in the map, and the last match that supports it."""

    submap: int = 0  # Submap of odometry.
    T_map_odom: np.ndarray | None = None  # [4, 4]; None before the camera is found.
    pending_match: SubmapMatch | None = None
    frames_since_search: int = 0  # Frames since the last search.

    def is_search_due(self, config: SubmapConfig) -> bool:
        """Return whether to search with this frame: with every one until the camera is found."""
        return self.T_map_odom is None or self.frames_since_search >= config.look_every

    def after(self, tracked: TrackedFrame) -> "MapFix":
        """Return the fix after one more frame; a new submap of odometry has no fix yet."""
        if tracked.submap != self.submap:
            return MapFix(tracked.submap)
        return replace(self, frames_since_search=self.frames_since_search + 1)

    def with_search_result(self, look: SubmapMatch, config: SubmapConfig) -> "MapFix":
        """Return the fix after a match; the match is accepted if the previous one agrees."""
        is_confirmed = self.pending_match is not None and self.pending_match.is_consistent_with(
            look, config
        )
        T_map_odom = look.T_there_here if is_confirmed else self.T_map_odom
        # Search again soon after a match that is not confirmed.
        since = 0 if is_confirmed else config.look_every - config.confirm_after
        return replace(self, T_map_odom=T_map_odom, pending_match=look, frames_since_search=since)

    def pack(self) -> dict[str, Any]:
        """Return the fix as arrays and plain values."""
        return asdict(self)

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "MapFix":
        """Return the fix from its packed form."""
        match = kept["pending_match"]
        return MapFix(**{**kept, "pending_match": match and SubmapMatch(**match)})


class Localizer(Odometry):
    """Odometry in a finished map; its own keyframes serve tracking and are not mapped."""

    def __init__(
        self,
        places: KeyframeDatabase,
        config: OdometryConfig | None = None,
        T_base_camera: np.ndarray | None = None,
    ) -> None:
        """Start without a fix.

        Args:
            places: Keyframe database of the map; their T_odom_keyframe is T_map_keyframe.
            config: See `Odometry`, as is T_base_camera.
            T_base_camera: Camera on the robot, [4, 4].
        """
        super().__init__(config, T_base_camera)
        self._places = places
        self._fix = MapFix()

    def process(
        self,
        frame: RgbdFrame,
        prior: OdometryPriorBuffer | None = None,
        *,
        may_map: bool = True,  # noqa: ARG002
    ) -> TrackingResult:
        """Track a frame and localize it in the map.

        Args:
            frame: The frame.
            prior: The last poses of another odometry.
            may_map: Unused, since nothing is mapped.

        Returns:
            The pose of the frame in odometry and in the map; LOST until the camera is found in
            the map. It has no reference because the keyframes of odometry are not in the map.
        """
        # Track in odometry with its own keyframes.
        reading = self._read(prior, frame)
        tracked = self._frames.track(frame, reading)
        if tracked.should_start_submap:
            tracked = self._frames.start_submap(frame)
        if tracked.needed_keyframe in (KeyframeKind.FIRST, KeyframeKind.REFERENCE):
            self._add_reference(frame, tracked)
        # Localize odometry in the map.
        self._fix = self._fix.after(tracked)
        if tracked.status is TrackingStatus.OK and self._fix.is_search_due(self.config.submaps):
            self._search(frame, tracked)
        T_map_odom = self._fix.T_map_odom
        if T_map_odom is None:
            tracked, T_map_odom = replace(tracked, status=TrackingStatus.LOST), np.eye(4)
        return make_tracking_result(
            tracked,
            T_map_odom,
            self._map.version,
            submap=0,
            reference=None,
            has_prior=reading is not None,
        )

    def snapshot(self) -> dict[str, Any]:
        """Return the state that the next frames depend on; see `Odometry.snapshot`."""
        return {**super().snapshot(), "fix": self._fix.pack()}

    def restore(self, state: Mapping[str, Any], correction: MapCorrection | None = None) -> None:
        """Continue from a snapshot; see `Odometry.restore`."""
        super().restore(state, correction)
        self._fix = MapFix.unpack(state["fix"])

    def _search(self, frame: RgbdFrame, tracked: TrackedFrame) -> None:
        """Relocalize the frame just tracked in the map, and update the fix."""
        found = self._frames.relocalize_in(frame, self._places)
        if found is None:
            self._fix = replace(self._fix, frames_since_search=0)
            return
        keyframe, alignment = found
        T_map_camera = keyframe.T_odom_keyframe @ alignment.T_reference_camera
        T_map_odom = se3.orthonormalize(T_map_camera @ se3.inverse(tracked.T_odom_camera))
        median_depth_m = keyframe.reference.median_depth_m
        look = SubmapMatch(tracked.submap, MAP, T_map_odom, tracked.T_odom_camera, median_depth_m)
        self._fix = self._fix.with_search_result(look, self.config.submaps)
