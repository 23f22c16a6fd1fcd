"""Camera pose of each RGB-D frame in a finished map.                     actors/localiser.py

In the tracker's stead, with its name and its ports, when `tracker.localise` names a finished run:
so whoever listens to poses need not know. It makes no keyframe, so the mapper and the optimizer
have nothing to do and the map stays as it is.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.actors.tracker import Tracker, TrackerConfig
from ldo_service.geometry import RgbdFrame
from ldo_service.schemas import Keyframe, TrackedPose
from ldo_service.tracking.keyframe_database import places_of
from ldo_service.tracking.localizer import Fix, Localiser
from ldo_service.tracking.tracking_quality import Status


class LocalisingTracker(Tracker):
    """LOST until the camera is found in the map; poses are in the map's frame from then on."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__(config)
        self._localiser = Localiser(self._odometry, places_of(Path(config.localise)))

    def _track(self, frame: RgbdFrame) -> Iterator[TrackedPose | Keyframe]:
        tracked, T_map_odom = self._localiser.track(frame, self._prior_of(frame))
        if T_map_odom is None:
            tracked, T_map_odom = replace(tracked, status=Status.LOST), np.eye(4)
        yield self._pose_message(frame, tracked, T_map_odom, reference=None)

    def snapshot(self) -> dict[str, Any]:
        return {**super().snapshot(), "fix": self._localiser.fix.packed}

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        super().restore(state)
        self._localiser.fix = Fix.unpacked(state["fix"])
