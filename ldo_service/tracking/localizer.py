"""Localization in a finished map, which does not change. Conventions: `ldo_service.geometry`.

Odometry tracks the camera against keyframes that it makes itself. At intervals, the localizer
relocalizes the current frame in the keyframe database of the map, which yields T_map_odom. Poses in
odometry are continuous; T_map_odom may jump (REP-105).
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ldo_service.calibration.knowledge import CameraKnowledge
from ldo_service.errors import DataError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.storage.state_codec import decode_state

from .keyframe_database import (
    DATABASE_FILE,
    OLD_DATABASE_FILE,
    KeyframeDatabase,
    KeyframeRecord,
)
from .map_frame import MapCorrection
from .odometry import Odometry
from .odometry_config import OdometryConfig
from .odometry_prior import OdometryPriorBuffer
from .submaps import SubmapConfig, SubmapMatch
from .tracking_quality import TrackingStatus
from .tracking_result import KeyframeKind, TrackedFrame, TrackingResult, make_tracking_result

MAP = -1  # Value of `SubmapMatch.there` for the finished map, which has no submap number.


@dataclass(frozen=True, slots=True)
class MapFix:
    """Pose of the odometry frame in the map, and the last relocalization match."""

    submap: int = 0  # Current submap of odometry.
    T_map_odom: np.ndarray | None = None  # [4, 4]; None before the camera is found in the map.
    pending_match: SubmapMatch | None = None  # Last relocalization match; None before the first.
    frames_since_search: int = 0  # Frames since the last search of the map.

    def is_search_due(self, config: SubmapConfig) -> bool:
        """Return whether to relocalize the current frame in the map.

        Every frame is relocalized until the camera is found in the map. After that, a frame is
        relocalized when `config.search_interval_frames` frames have passed since the last search.
        """
        return self.T_map_odom is None or self.frames_since_search >= config.search_interval_frames

    def after(self, tracked: TrackedFrame) -> "MapFix":
        """Return the state after one more tracked frame.

        If odometry has started a new submap, T_map_odom is unknown again.
        """
        if tracked.submap != self.submap:
            return MapFix(tracked.submap)
        return replace(self, frames_since_search=self.frames_since_search + 1)

    def with_search_result(self, match: SubmapMatch, config: SubmapConfig) -> "MapFix":
        """Return the state after a relocalization match.

        T_map_odom changes only if the previous match agrees with the new match.
        """
        is_confirmed = self.pending_match is not None and self.pending_match.is_consistent_with(
            match, config
        )
        T_map_odom = match.T_there_here if is_confirmed else self.T_map_odom
        # Search again soon after a match that is not confirmed.
        since = 0 if is_confirmed else config.search_interval_frames - config.confirm_after
        return replace(self, T_map_odom=T_map_odom, pending_match=match, frames_since_search=since)

    def pack(self) -> dict[str, Any]:
        """Return the state as arrays and plain values."""
        return asdict(self)

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "MapFix":
        """Return the state from its packed form."""
        match = kept["pending_match"]
        return MapFix(**{**kept, "pending_match": match and SubmapMatch(**match)})


class Localizer(Odometry):
    """Odometry of one camera, with its pose in a finished map.

    The localizer makes keyframes for tracking only, which do not change the map.
    """

    def __init__(
        self,
        database: KeyframeDatabase,
        config: OdometryConfig | None = None,
        T_base_camera: np.ndarray | None = None,
    ) -> None:
        """Start without a known pose in the map.

        Args:
            database: Keyframe database of the map. Its poses
                `T_odom_keyframe` are in the map frame, not in an odometry frame.
            config: Settings; see `Odometry`.
            T_base_camera: Pose of the camera on the robot, [4, 4]; see `Odometry`.
        """
        super().__init__(config, T_base_camera)
        self._database = database
        self._fix = MapFix()

    def process(
        self,
        frame: RgbdFrame,
        prior: OdometryPriorBuffer | None = None,
        *,
        may_map: bool = True,  # noqa: ARG002
        camera: CameraKnowledge | None = None,
    ) -> TrackingResult:
        """Track a frame and localize it in the map.

        Args:
            frame: The frame.
            prior: The last poses of another odometry, such as wheels.
            may_map: Unused, since nothing is mapped.
            camera: Shutter timing and depth-bias uncertainty that the self-calibration has
                estimated so far; None if the self-calibration is off.

        Returns:
            The pose of the frame in odometry and in the map. The status is LOST until the camera is
            found in the map. `reference` is None, since the keyframes made here are not in the map.
        """
        # Track the frame in odometry, against keyframes that are not in the map.
        reading = self._read(prior, frame)
        self._frames.use_knowledge(camera or CameraKnowledge())
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
            motion=self._frames.motion,
            shutter=self._frames.state.shutter,
        )

    def snapshot(self) -> dict[str, Any]:
        """Return the state for `restore`; see `Odometry.snapshot`."""
        return {**super().snapshot(), "fix": self._fix.pack()}

    def restore(self, state: Mapping[str, Any], correction: MapCorrection | None = None) -> None:
        """Continue from a snapshot; see `Odometry.restore`."""
        super().restore(state, correction)
        self._fix = MapFix.unpack(state["fix"])

    def _search(self, frame: RgbdFrame, tracked: TrackedFrame) -> None:
        """Relocalize the frame just tracked in the map, and update the fix."""
        found = self._frames.relocalize_in(frame, self._database)
        if found is None:
            self._fix = replace(self._fix, frames_since_search=0)
            return
        keyframe, alignment = found
        T_map_camera = keyframe.T_odom_keyframe @ alignment.T_reference_camera
        T_map_odom = se3.orthonormalize(T_map_camera @ se3.inverse(tracked.T_odom_camera))
        median_depth_m = keyframe.reference.median_depth_m
        match = SubmapMatch(tracked.submap, MAP, T_map_odom, tracked.T_odom_camera, median_depth_m)
        self._fix = self._fix.with_search_result(match, self.config.submaps)


def load_keyframe_database(folder: Path) -> KeyframeDatabase:
    """Load the keyframe database of a finished run from its folder.

    Raises:
        DataError: The folder has no keyframe database, or the database is unreadable or empty.
    """
    files = [folder / name for name in (DATABASE_FILE, OLD_DATABASE_FILE)]
    path = next((file for file in files if file.is_file()), None)
    if path is None:
        raise DataError(
            f"{folder} has no {DATABASE_FILE}, which localization needs. Give a folder that "
            "`ldo run SOURCE --out DIR` wrote. If an older version wrote the folder, repeat the "
            "run."
        )
    try:
        kept = decode_state(path.read_bytes())
        database = KeyframeDatabase(
            tuple(KeyframeRecord.unpack(record) for record in kept["places"])
        )
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}. Repeat the run.") from error
    except (msgspec.DecodeError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path} is not a valid keyframe database ({error!r}). Repeat the run (`ldo run`)."
        ) from error
    if not len(database):
        raise DataError(
            f"{path} contains no keyframe, because the run made none. Check that the recording "
            "has depth images, and repeat the run."
        )
    return database
