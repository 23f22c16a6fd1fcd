"""Bags of ROS 1 and ROS 2 with the frames of a sequence, written by rosbags."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ldo_service.datasets import Sequence
from ldo_service.geometry import Camera, RawFrame
from tests.cameras.ros import STORE, camera_info, cdr, compressed, header, image

NOETIC = get_typestore(Stores.ROS1_NOETIC)
TF = "tf2_msgs/msg/TFMessage"
NOETIC.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
COLOR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
COLOR_INFO = "/camera/color/camera_info"
FRAME = "camera_color_optical_frame"
KINDS = ("ros1", "mcap", "sqlite3")

# Time of recording in nanoseconds, topic, and message.
Entry = tuple[int, str, Any]


def write_bag(
    folder: Path, kind: str, entries: Iterable[Entry], name: str = "bag", image_tail: bytes = b""
) -> Path:
    """Write a bag of one of KINDS, and return its path.

    `image_tail` follows each image of ROS 1, as librealsense appends the depth unit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if kind == "ros1":
        path = folder / f"{name}.bag"
        with Writer1(path) as writer:
            links: dict[str, Any] = {}
            for time_ns, topic, message in entries:
                type_name = message.__msgtype__
                if topic not in links:
                    links[topic] = writer.add_connection(topic, type_name, typestore=NOETIC)
                tail = image_tail if type_name == "sensor_msgs/msg/Image" else b""
                body = bytes(STORE.cdr_to_ros1(cdr(message), type_name)) + tail
                writer.write(links[topic], time_ns, body)
        return path
    path = folder / name
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        links = {}
        for time_ns, topic, message in entries:
            if topic not in links:
                links[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(links[topic], time_ns, cdr(message))
    return path


def info_of(camera: Camera, frame_id: str = FRAME) -> Any:
    """Return the camera info of a camera; its matrix P is that of the rectified image."""
    K = camera.matrix
    model = "rational_polynomial" if len(camera.distortion) == 8 else "plumb_bob"
    return camera_info(
        header=header(frame_id=frame_id),
        width=camera.width,
        height=camera.height,
        distortion_model=model,
        d=np.array(camera.distortion, float),
        k=K.reshape(-1),
        p=np.pad(K, ((0, 0), (0, 1))).reshape(-1),
    )


def lossless(raw: RawFrame, is_compressed: bool = False) -> Iterator[tuple[str, Any]]:
    """Yield the topics and messages of a frame, with depth in float32 meters or as PNG."""
    about = header(raw.stamp_ns, FRAME)
    if is_compressed:
        png = cv2.imencode(".png", raw.color[..., ::-1])[1].tobytes()
        yield f"{COLOR}/compressed", compressed("rgb8; png compressed bgr8", png, about)
        depth = np.round(raw.depth_m() * 1000).astype(np.uint16)
        png = bytes(12) + cv2.imencode(".png", depth)[1].tobytes()
        yield f"{DEPTH}/compressedDepth", compressed("16UC1; compressedDepth png", png, about)
    else:
        yield COLOR, image("rgb8", raw.color, about)
        yield DEPTH, image("32FC1", raw.depth_m(), about)


def entries_of(
    sequence: Sequence, indices: Iterable[int], is_compressed: bool = False
) -> Iterator[Entry]:
    """Yield the messages of a camera whose depth is registered to color."""
    for index in indices:
        raw = sequence.read(index)
        for topic, message in lossless(raw, is_compressed):
            yield raw.stamp_ns, topic, message
        yield raw.stamp_ns, COLOR_INFO, info_of(sequence.raw_camera)
