"""Conversion of object observations from messages to landmark observations of the pose graph.

This module imports gtsam with the pose graph. Most actors need the module `objects` without gtsam,
so the two modules are separate.
"""

from collections.abc import Callable
from dataclasses import astuple

import numpy as np

from ldo_service.geometry import Camera
from ldo_service.pose_graph.landmarks import MAX_CLASSES, LandmarkObservation
from ldo_service.schemas import ObjectObservation

from .objects import dense_distribution


def landmark_observation_from_message(
    message: ObjectObservation, camera: Camera, class_index: Callable[[str], int]
) -> LandmarkObservation:
    """Convert the message of an object observation to a landmark observation of the pose graph.

    Args:
        message: Observation of the object in a keyframe.
        camera: Intrinsics of this keyframe.
        class_index: Function from a label to the index of its class, below `MAX_CLASSES`.
    """
    return LandmarkObservation(
        message.keyframe,
        message.object,
        np.array(message.box_px),
        dense_distribution(message.distribution, class_index, MAX_CLASSES),
        message.entropy,
        message.is_miss,
        np.array(astuple(camera)[:6]),
    )
