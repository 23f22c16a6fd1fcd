"""Writer of a run's keyframe database, with which `--localize` later finds the camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ldo_service.conversions.frames import keyframe_from_message
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.schemas import Keyframe
from ldo_service.storage.state_codec import encode_state
from ldo_service.tracking import OdometryConfig
from ldo_service.tracking.keyframe_database import KeyframeDatabase, make_keyframe_record


class DatabaseWriter:
    """Writer of the keyframe database of a run.

    The writer keeps at most `keyframe_database.count` keyframe records in memory, 0.13 MB each.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._database = KeyframeDatabase()

    def add(self, message: Keyframe) -> None:
        """Add the record of a keyframe."""
        config = self._config
        record = make_keyframe_record(
            keyframe_from_message(message, config.pyramid),
            config.features,
            config.keyframe_database,
        )
        self._database = self._database.with_record(record, config.keyframe_database)

    def save(self, path: Path, poses: KeyframePoses, merged: dict[int, int]) -> None:
        """Write the records of the keyframes that have a pose in the map.

        Args:
            path: File to write.
            poses: Final poses T_map_keyframe, which replace T_odom_keyframe.
            merged: For each merged submap, the older submap that it is now part of.
        """
        records = [
            replace(record, submap=0, T_odom_keyframe=np.array(poses[record.id]))
            for record in self._database.all
            if merged.get(record.submap, record.submap) == 0
        ]
        path.write_bytes(encode_state({"places": [record.pack() for record in records]}))
