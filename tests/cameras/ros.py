"""ROS 2 messages as CDR, serialized by rosbags."""

from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

WIDTH, HEIGHT = 8, 6
FRAME_ID = "camera_color_optical_frame"
STORE = get_typestore(Stores.ROS2_HUMBLE)
COLOR = np.arange(HEIGHT * WIDTH * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)
DEPTH_MM = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 300


def cdr(message: Any, *, little_endian: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


def header(stamp_ns: int = 1_500_000_002, frame_id: str = FRAME_ID) -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return STORE.types["std_msgs/msg/Header"](stamp, frame_id)


def image(
    encoding: str, pixels: np.ndarray, about: Any = None, *, padding: int = 0, **changes: Any
) -> Any:
    """Return an Image message; `padding` bytes follow each row."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAA)
    fields = {
        "header": about or header(),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": int(pixels.dtype.byteorder == ">"),
        "step": rows.shape[1],
        "data": rows.reshape(-1),
    }
    return STORE.types["sensor_msgs/msg/Image"](**{**fields, **changes})


def compressed(kind: str, data: bytes, about: Any = None) -> Any:
    array = np.frombuffer(data, np.uint8)
    return STORE.types["sensor_msgs/msg/CompressedImage"](about or header(), kind, array)


def camera_info(**changes: Any) -> Any:
    fields = {
        "header": header(),
        "height": HEIGHT,
        "width": WIDTH,
        "distortion_model": "plumb_bob",
        "d": np.array([0.1, -0.2, 0.001, 0.002, 0.03]),
        "k": np.array([7.0, 0, 3.5, 0, 7.5, 2.5, 0, 0, 1]),
        "r": np.eye(3).reshape(-1),
        "p": np.array([6.0, 0, 3.25, 0, 0, 6.5, 2.25, 0, 0, 0, 1, 0]),
        "binning_x": 0,
        "binning_y": 0,
        "roi": STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    }
    return STORE.types["sensor_msgs/msg/CameraInfo"](**{**fields, **changes})
