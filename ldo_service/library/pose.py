"""Pose of a frame, as `Slam.track` returns it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ldo_service.conversions.poses import pose_from_message
from ldo_service.schemas import TrackedPose

from .arrays import read_only_array


@dataclass(frozen=True, eq=False, slots=True)
class Pose:
    """Pose of the camera at a frame. Arrays are float64 and read-only.

    Attributes:
        frame: Number of the frame, counted from 0 by the calls of `Slam.track`.
        stamp_ns: Time of the exposure, ns.
        status: Tracking status: OK, WEAK (uncertain, not mapped) or LOST.
        T_map_camera: [4, 4], transform from the camera to the map, with all corrections so far.
            None while LOST, and in a submap that is not merged with the map yet.
        T_odom_camera: [4, 4], transform from the camera to the odometry frame. It is continuous
            while the status is not LOST. While LOST, it stays at the last pose.
        reference: Id of the keyframe that the frame was aligned to; None before the first keyframe.
        T_reference_camera: [4, 4], transform from the camera to the keyframe `reference`.
        covariance: [6, 6], covariance of T_reference_camera for a perturbation on the right:
            rotation in rad, then translation in m. Zeros if unknown.
        keyframe: Id of the keyframe that this frame became; None if it became no keyframe.
        submap: Number of the submap; 0 is the map itself.
    """

    frame: int
    stamp_ns: int
    status: Literal["OK", "WEAK", "LOST"]
    T_map_camera: np.ndarray | None
    T_odom_camera: np.ndarray
    reference: int | None
    T_reference_camera: np.ndarray
    covariance: np.ndarray
    keyframe: int | None
    submap: int


def pose_of(message: TrackedPose) -> Pose:
    """Return the pose of a frame from the tracker's message."""
    T_odom_camera = pose_from_message(message.T_odom_camera)
    T_map_camera = None
    if message.status != "LOST" and message.submap == 0:
        T_map_camera = read_only_array(pose_from_message(message.T_map_odom) @ T_odom_camera)
    return Pose(
        message.frame,
        message.stamp_ns,
        message.status,
        T_map_camera,
        read_only_array(T_odom_camera),
        message.reference,
        read_only_array(pose_from_message(message.T_reference_camera)),
        read_only_array(np.array(message.covariance).reshape(6, 6)),
        message.keyframe,
        message.submap,
    )
