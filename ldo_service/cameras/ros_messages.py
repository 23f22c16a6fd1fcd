"""Images and camera infos of ROS 2, out of the CDR that a bridge forwards.

Encodings are those of `sensor_msgs/image_encodings`; depth is in millimetres as 16UC1 and in metres
as 32FC1 (REP 118).
"""

import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, FrameError
from ldo_service.geometry.codecs import read_image_size
from ldo_service.schemas import CameraModel, CameraRgbd, Image
from ldo_service.schemas.frames import MAX_PIXELS, ImageEncoding

CDR_HEADERS = (
    b"\0\0",
    b"\0\1",
)  # big and little endian; others are versions that ROS 2 does not send
COLOR_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
DEPTH_KINDS: dict[str, tuple[ImageEncoding, str, float]] = {  # ours, NumPy's, units per metre
    "16UC1": ("z16", "u2", 1000.0),
    "mono16": ("z16", "u2", 1000.0),
    "32FC1": ("f32", "f4", 1.0),
}
COMPRESSED_DEPTH_HEADER = 12  # bytes before the PNG: a format and two quantisation parameters
PLUMB_BOB, RATIONAL, UNDISTORTED = "plumb_bob", "rational_polynomial", ("", "none")


@dataclass(frozen=True, slots=True)
class RosImage:
    """frame_id: of whose camera it is, as ROS names it; depth_scale: of depth, units per metre."""

    stamp_ns: int
    frame_id: str
    image: Image
    depth_scale: float = 1.0


def is_compressed(topic: str) -> bool:
    """As image_transport names topics."""
    return topic.endswith(("/compressed", "/compressedDepth"))


def read_color(body: bytes, topic: str) -> RosImage:
    """Of sensor_msgs/Image, or sensor_msgs/CompressedImage where the topic's name says so. Raises
    FrameError."""
    if is_compressed(topic):
        return _compressed(_message(body, "sensor_msgs/msg/CompressedImage"), 0)
    message = _message(body, "sensor_msgs/msg/Image")
    channels = COLOR_CHANNELS.get(message.encoding)
    if channels is None:
        raise FrameError(
            f"colour cannot be encoded as {message.encoding[:40]!r}: only as "
            f"{', '.join(COLOR_CHANNELS)}."
        )
    pixels = _pixels(message, np.dtype("u1"), channels)
    if channels == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    encoding: ImageEncoding = "bgr8" if message.encoding.startswith("bgr") else "rgb8"
    return _ros_image(message, Image.raw(encoding, pixels[..., :3]))


def read_depth(body: bytes, topic: str) -> RosImage:
    """The same of depth."""
    if is_compressed(topic):
        message = _message(body, "sensor_msgs/msg/CompressedImage")
        if not message.format.startswith("16UC1"):
            raise FrameError(f"compressed depth is read as 16UC1, and this is {message.format!r}.")
        return _compressed(message, COMPRESSED_DEPTH_HEADER, 1000.0)
    message = _message(body, "sensor_msgs/msg/Image")
    if message.encoding not in DEPTH_KINDS:
        raise FrameError(
            f"depth cannot be encoded as {message.encoding[:40]!r}: only as "
            f"{', '.join(DEPTH_KINDS)}."
        )
    encoding, kind, depth_scale = DEPTH_KINDS[message.encoding]
    dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
    depth = _pixels(message, dtype, 1)[..., 0].astype(dtype.newbyteorder("<"))
    return _ros_image(message, Image.raw(encoding, depth), depth_scale)


def read_camera(body: bytes, is_rectified: bool) -> CameraModel:
    """Of sensor_msgs/CameraInfo: K and D, or of rectified images the left of P. Raises
    FrameError."""
    info = _message(body, "sensor_msgs/msg/CameraInfo")
    matrix = np.reshape(info.p, (3, 4)) if is_rectified else np.reshape(info.k, (3, 3))
    try:
        return CameraModel(
            width=info.width,
            height=info.height,
            fx=float(matrix[0, 0]),
            fy=float(matrix[1, 1]),
            cx=float(matrix[0, 2]),
            cy=float(matrix[1, 2]),
            distortion=() if is_rectified else _distortion(info),
        )
    except ValueError as error:
        raise FrameError(f"the camera info makes no camera: {error}.") from error


def joined(
    color: RosImage, depth: RosImage, camera: CameraModel, frame: int, is_registered: bool
) -> CameraRgbd:
    """One frame of both, stamped by colour. Raises FrameError for halves that do not fit.

    is_registered  the user says that depth lies on the pixels of colour, whatever its frame_id
    """
    if depth.frame_id != color.frame_id and not is_registered:
        raise FrameError(
            f"depth is of frame {depth.frame_id!r} and colour of {color.frame_id!r}: subscribe to "
            "depth that is registered to colour (realsense2_camera: align_depth.enable:=true; else "
            "the node `register` of depth_image_proc), or say --registered where it is."
        )
    if (color.image.width, color.image.height) != (camera.width, camera.height):
        raise FrameError(
            f"colour has {color.image.width}x{color.image.height} pixels and its camera info says "
            f"{camera.width}x{camera.height}: is it the info of this topic?"
        )
    try:
        return CameraRgbd(
            stamp_ns=color.stamp_ns,
            frame=frame,
            camera=camera,
            color=color.image,
            depth=depth.image,
            depth_scale=depth.depth_scale,
        )
    except ValueError as error:
        raise FrameError(f"colour and depth make no frame: {error}.") from error


# --- CDR ------------------------------------------------------------------------------------------
@cache
def typestore() -> Any:
    """What reads CDR. Raises ConfigError without the extra `ros2`."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError(
            "reading ROS 2 needs the extra `ros2`: "
            f"`{sys.executable} -m pip install 'ldo-slam[ros2]'`."
        ) from error
    return get_typestore(Stores.ROS2_HUMBLE)  # these messages have not changed since


def _message(body: bytes, kind: str) -> Any:
    if body[:2] not in CDR_HEADERS:
        raise FrameError(f"{len(body)} bytes that begin with {body[:4].hex()} are no CDR of ROS 2.")
    store = typestore()
    try:
        return store.deserialize_cdr(body, kind)
    except Exception as error:  # rosbags has one of its own, and lets others through
        raise FrameError(f"{len(body)} bytes are no {kind} in CDR: {error}.") from error


def _ros_image(message: Any, image: Image, depth_scale: float = 1.0) -> RosImage:
    stamp = message.header.stamp
    stamp_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec)
    return RosImage(stamp_ns, message.header.frame_id, image, depth_scale)


def _pixels(message: Any, dtype: np.dtype, channels: int) -> np.ndarray:
    """[H, W, channels], without what pads the rows."""
    height, width, step = message.height, message.width, message.step
    row_bytes = width * channels * dtype.itemsize
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameError(f"an image of {width}x{height} pixels is empty or over {MAX_PIXELS}.")
    if step < row_bytes or len(message.data) != step * height:
        raise FrameError(
            f"a {message.encoding} image of {width}x{height} has rows of {row_bytes} bytes; this "
            f"one has {len(message.data)} bytes in steps of {step}."
        )
    rows = np.reshape(message.data, (height, step))[:, :row_bytes]
    return np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)


def _compressed(message: Any, start: int, depth_scale: float = 1.0) -> RosImage:
    """Passed on as it is: the service decompresses it."""
    data = memoryview(message.data.tobytes())[start:]
    size = read_image_size(data)
    if size is None:
        raise FrameError(
            f"{len(data)} bytes, said to be {message.format[:40]!r}, are neither PNG nor JPEG."
        )
    encoding: ImageEncoding = "jpeg" if bytes(data[:2]) == b"\xff\xd8" else "png"
    try:
        image = Image(encoding=encoding, width=size[0], height=size[1], data=data)
    except ValueError as error:
        raise FrameError(f"a compressed image cannot be used: {error}.") from error
    return _ros_image(message, image, depth_scale)


def _distortion(info: Any) -> tuple[float, ...]:
    """As OpenCV has it, which is ROS' own order."""
    d = tuple(float(number) for number in info.d)
    if not any(d) or info.distortion_model in UNDISTORTED:
        return ()
    if info.distortion_model not in (PLUMB_BOB, RATIONAL):
        raise FrameError(
            f"its lens is of the model {info.distortion_model!r}; {PLUMB_BOB} and {RATIONAL} are "
            "known: subscribe to rectified images, with --rectified."
        )
    return d
