"""The camera in a finished map that stays as it is. Conventions: `ldo_service.geometry`.

Odometry follows the camera as always, with keyframes of its own; now and then the view is looked
for among the places of the map, which says where the odometry frame is in it: T_map_odom. As in
any localiser (REP-105), odometry is continuous and T_map_odom takes the jumps.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ldo_service.geometry import RgbdFrame, se3

from .keyframe_database import Places
from .odometry import Odometry
from .odometry_prior import Reading
from .submaps import Look, SegmentConfig
from .tracking_quality import Status
from .tracking_result import Tracked

MAP = -1  # stands for the map where a segment's number stands otherwise


@dataclass(frozen=True, slots=True)
class Fix:
    """Where odometry is in the map, and the last look at it."""

    segment: int = 0  # of the odometry
    T_map_odom: np.ndarray | None = None  # [4, 4]; None: not known yet
    last: Look | None = None
    since_look: int = 0  # frames

    def is_time_to_look(self, config: SegmentConfig) -> bool:
        """At every frame until the camera is found."""
        return self.T_map_odom is None or self.since_look >= config.look_every

    def after(self, tracked: Tracked) -> "Fix":
        """One frame later; a new segment of odometry may be anywhere."""
        if tracked.segment != self.segment:
            return Fix(tracked.segment)
        return replace(self, since_look=self.since_look + 1)

    def looked(self, look: Look, config: SegmentConfig) -> "Fix":
        """After a look that found something: believed when the last one said the same."""
        is_confirmed = self.last is not None and self.last.agrees(look, config)
        T_map_odom = look.T_there_here if is_confirmed else self.T_map_odom
        # a find that contradicts the last one is looked at again soon
        since = 0 if is_confirmed else config.look_every - config.confirm_after
        return replace(self, T_map_odom=T_map_odom, last=look, since_look=since)

    @property
    def packed(self) -> dict[str, Any]:
        """Arrays and plain values."""
        return asdict(self)

    @staticmethod
    def unpacked(kept: dict[str, Any]) -> "Fix":
        last = None if kept["last"] is None else Look(**kept["last"])
        return Fix(**{**kept, "last": last})


class Localiser:
    """`places` are those of the map: their `T_odom_keyframe` is T_map_keyframe."""

    def __init__(self, odometry: Odometry, places: Places) -> None:
        self._odometry, self._places = odometry, places
        self.fix = Fix()

    def track(
        self, frame: RgbdFrame, prior: Reading | None = None
    ) -> tuple[Tracked, np.ndarray | None]:
        """The frame in odometry, and T_map_odom [4, 4]; None until the camera is found."""
        tracked = self._followed(frame, prior)
        self.fix = self.fix.after(tracked)
        config = self._odometry.config.segments
        if tracked.status is Status.OK and self.fix.is_time_to_look(config):
            self._look(frame, tracked)
        return tracked, self.fix.T_map_odom

    def _followed(self, frame: RgbdFrame, prior: Reading | None) -> Tracked:
        tracked = self._odometry.track(frame, prior)
        if tracked.may_begin:
            tracked = self._odometry.begin_segment(frame)
        if tracked.wants_keyframe:
            self._odometry.make_keyframe(frame, tracked)
        return tracked

    def _look(self, frame: RgbdFrame, tracked: Tracked) -> None:
        config = self._odometry.config.segments
        found = self._odometry.recognised(frame, self._places)
        if found is None:
            self.fix = replace(self.fix, since_look=0)
            return
        keyframe, alignment = found
        T_map_camera = keyframe.T_odom_keyframe @ alignment.T_reference_camera
        T_map_odom = se3.orthonormalised(T_map_camera @ se3.inverse(tracked.T_odom_camera))
        median_depth_m = keyframe.reference.median_depth_m
        look = Look(tracked.segment, MAP, T_map_odom, tracked.T_odom_camera, median_depth_m)
        self.fix = self.fix.looked(look, config)
