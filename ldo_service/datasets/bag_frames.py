"""Coordinate frames in a bag of ROS: constant transforms between them, and odometry."""

import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Trajectory, se3

from .bag_file import BagFile, Topic

log = logging.getLogger(__name__)

ODOMETRY = "nav_msgs/msg/Odometry"
MAX_STATIC = 1000  # Maximum number of messages that are read of a topic with constant content.


def readable_messages(bag: BagFile, is_wanted: Callable[[Topic], bool]) -> Iterator[Any]:
    """Yield the first MAX_STATIC messages of each wanted topic; skip unreadable messages."""
    for topic in filter(is_wanted, bag.topics.values()):
        for message in bag.messages([topic], MAX_STATIC):
            try:
                yield bag.read(message)
            except FrameError as error:
                log.warning("%s No action needed if depth is registered to color.", error)


def matrix_of(transform: Any) -> np.ndarray | None:
    """Return the matrix [4, 4] of a geometry_msgs/Transform, or None if it is invalid."""
    return _transform_of(transform.rotation, transform.translation)


def _transform_of(q: Any, t: Any) -> np.ndarray | None:
    """Return the matrix [4, 4] of a quaternion and a translation of ROS, or None if invalid."""
    quaternion, translation = np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z])
    norm = float(np.linalg.norm(quaternion))
    if not (0.9 < norm < 1.1 and np.all(np.isfinite(translation))):
        return None
    return se3.from_quaternion(translation, quaternion / norm)


def static_transform(bag: BagFile, target: str, source: str) -> np.ndarray | None:
    """Return the transform [4, 4] from the frame `source` to the frame `target`.

    The transform is composed from /tf_static. It is None if /tf_static does not connect the two
    frames.
    """
    edges: dict[str, dict[str, np.ndarray]] = {}
    for message in readable_messages(bag, lambda topic: topic.name == "/tf_static"):
        for stamped in getattr(message, "transforms", ()):
            parent = stamped.header.frame_id.lstrip("/")
            child = stamped.child_frame_id.lstrip("/")
            T_parent_child = matrix_of(stamped.transform)
            if T_parent_child is not None:
                edges.setdefault(child, {})[parent] = T_parent_child
                edges.setdefault(parent, {})[child] = se3.inverse(T_parent_child)
    found = {source: np.eye(4)}  # Transforms from `source` to each reached frame.
    frames = [source]
    for frame in frames:
        for following, T_following_frame in edges.get(frame, {}).items():
            if following not in found:
                found[following] = T_following_frame @ found[frame]
                frames.append(following)
    return found.get(target)


def odometry_topic(bag: BagFile, given: str) -> Topic | None:
    """Return the topic with odometry, or None if the bag has none or several of them.

    Args:
        bag: The bag.
        given: Name of the topic from the options; empty to search for a topic with odometry.

    Raises:
        DataError: The topic that the options name does not contain odometry.
    """
    found = [topic for topic in bag.topics.values() if topic.kind == ODOMETRY and topic.count]
    names = ", ".join(topic.name for topic in found) or "none"
    if given:
        chosen = next((topic for topic in found if topic.name == given), None)
        if chosen is None:
            raise DataError(
                f"--topic odometry={given} does not name a topic with nav_msgs/Odometry in "
                f"{bag.path}. Choose one of its topics of this type: {names}."
            )
        return chosen
    if len(found) > 1:
        log.warning(
            "%s has several topics with odometry: %s. None of them is used. Choose one by --topic "
            "odometry=%s.",
            *(bag.path, names, found[0].name),
        )
        return None
    return found[0] if found else None


def read_odometry(bag: BagFile, topic: Topic, camera_frame: str) -> Trajectory | None:
    """Return the odometry of a topic with nav_msgs/Odometry as a trajectory of the camera.

    The result has a pose `T_odom_camera` for each valid message. It is None if no message is valid.

    Args:
        bag: The bag.
        topic: The topic.
        camera_frame: ROS name of the frame of the camera.

    Raises:
        DataError: /tf_static does not connect the base of the odometry and the camera.
    """
    poses: dict[int, np.ndarray] = {}
    base_frame = None
    for stored in bag.messages([topic]):
        try:
            message = bag.read(stored)
        except FrameError:
            continue
        pose = message.pose.pose
        T_odom_base = _transform_of(pose.orientation, pose.position)
        if T_odom_base is not None:
            base_frame = base_frame or message.child_frame_id.lstrip("/")
            poses[stored.stamp_ns] = T_odom_base
    if base_frame is None:
        return None
    T_base_camera = static_transform(bag, base_frame, camera_frame)
    if T_base_camera is None:
        raise DataError(
            f"{bag.path}: {topic.name} has poses of the frame {base_frame!r}, and /tf_static does "
            f"not connect this frame with the camera's frame {camera_frame!r}. Record /tf_static "
            "too, or remove --recorded-odometry."
        )
    stamps_ns = sorted(poses)
    T_odom_camera = np.array([poses[stamp_ns] @ T_base_camera for stamp_ns in stamps_ns])
    return Trajectory(np.array(stamps_ns) / 1e9, T_odom_camera)
