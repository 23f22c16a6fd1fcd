"""Poses, keyframes and keyframe records in the textured room."""

import numpy as np

from ldo_service.geometry import se3
from ldo_service.tracking import PyramidConfig, pyramid_of
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import (
    KeyframeDatabaseConfig,
    KeyframeRecord,
    make_keyframe_record,
)
from ldo_service.tracking.keyframes import ReferenceKeyframe


def yaw(angle_rad: float) -> np.ndarray:
    """Return a rotation about the vertical axis of the camera, [4, 4]."""
    return se3.exp(np.array([0.0, angle_rad, 0.0, 0.0, 0.0, 0.0]))


def keyframe_at(room, T_odom_keyframe: np.ndarray, keyframe_id: int = 0) -> ReferenceKeyframe:
    """Return a keyframe of the room; the frames `odom` and `world` are the same."""
    view = pyramid_of(room.view(T_odom_keyframe), PyramidConfig())
    return ReferenceKeyframe(view, T_odom_keyframe, keyframe_id)


def record_at(room, T_odom_keyframe: np.ndarray, keyframe_id: int = 0) -> KeyframeRecord:
    """Return the record of a keyframe of the room."""
    keyframe = keyframe_at(room, T_odom_keyframe, keyframe_id)
    return make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig())
