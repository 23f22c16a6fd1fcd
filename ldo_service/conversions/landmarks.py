"""Conversion of messages of object observations to landmark observations of the pose graph.

The conversion has a module of its own, because the pose graph imports gtsam. In the module
`objects`, it would make every actor import gtsam.
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
    """Convert the observation of an object to that of a landmark of the pose graph.

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
