"""Keyframes of two walks along one path, the second one with drifted odometry."""

from collections.abc import Iterable, Sequence

import numpy as np

from ldo_service.conversions.frames import camera_to_message
from ldo_service.conversions.poses import matrix6_to_message, pose_to_message
from ldo_service.geometry import se3
from ldo_service.schemas import (
    Array,
    Detection,
    DetectionBoxes,
    Keyframe,
    LoopCandidate,
    LoopClosure,
    Message,
)

FIRST_WALK, SECOND_WALK = range(0, 20, 2), range(1, 21, 2)
DRIFT = se3.exp(np.array([0.02, -0.03, 0.02, 0.15, -0.1, 0.1]))  # 2 degrees and 20 cm.
LONG_AFTER = 500  # Frames between the walks.
NO_DRIFT = np.eye(4)
INFORMATION = matrix6_to_message(1e4 * np.eye(6))


def keyframes_of(
    room, indices: Iterable[int], first: int, frame: int, T_drift: np.ndarray = NO_DRIFT
) -> list[Keyframe]:
    """Return keyframes of the room with ids from `first` and camera frames from `frame`."""
    return [
        keyframe_of(room, index, first + n, frame + 3 * n, T_drift)
        for n, index in enumerate(indices)
    ]


def keyframe_of(room, index: int, number: int, frame: int, T_drift: np.ndarray) -> Keyframe:
    """Return a keyframe without reference, so that odometry places it in the map."""
    view, T_odom = room[index], T_drift @ true_pose(room, index)
    return Keyframe(
        stamp_ns=10**8 * number,
        keyframe=number,
        frame=frame,
        camera=camera_to_message(view.camera),
        color=Array.of(view.color),
        depth_m=Array.of(view.depth_m),
        reference=None,
        T_reference_keyframe=pose_to_message(np.eye(4)),
        information=INFORMATION,
        T_odom_keyframe=pose_to_message(T_odom),
    )


def true_pose(room, index: int) -> np.ndarray:
    return room.truth().T_world_camera[index]


def boxes_of(keyframe: Keyframe, *detections: Detection, network: str = "") -> DetectionBoxes:
    return DetectionBoxes(
        stamp_ns=keyframe.stamp_ns,
        keyframe=keyframe.keyframe,
        width=keyframe.camera.width,
        height=keyframe.camera.height,
        detections=detections,
        network=network,
    )


def with_empty_detections(keyframes: Sequence[Keyframe]) -> list[Message]:
    """Return each keyframe followed by detections without a network."""
    return [m for keyframe in keyframes for m in (keyframe, boxes_of(keyframe))]


def closures(messages: Iterable[Message]) -> list[LoopClosure]:
    return [message for message in messages if isinstance(message, LoopClosure)]


def candidates(messages: Iterable[Message]) -> list[LoopCandidate]:
    return [message for message in messages if isinstance(message, LoopCandidate)]
