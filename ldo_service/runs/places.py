"""What a later run is localised by: the places of a finished one."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ldo_service.conversions.frames import keyframe_of
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.schemas import Keyframe
from ldo_service.storage.state_codec import encode_state
from ldo_service.tracking import OdometryConfig
from ldo_service.tracking.keyframe_database import Places, place_of


class PlaceRecord:
    """Places of the keyframes that it is shown: no more than `places.count`, 0.13 MB each."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._places = Places()

    def add(self, message: Keyframe) -> None:
        config = self._config
        place = place_of(keyframe_of(message, config.pyramid), config.features, config.places)
        self._places = self._places.added(place, config.places)

    def save(self, path: Path, poses: KeyframePoses, joined: dict[int, int]) -> None:
        """Those that are in the map's frame, with T_map_keyframe for T_odom_keyframe."""
        places = [
            replace(place, segment=0, T_odom_keyframe=np.array(poses[place.id]))
            for place in self._places.all
            if joined.get(place.segment, place.segment) == 0
        ]
        path.write_bytes(encode_state({"places": [place.packed for place in places]}))
