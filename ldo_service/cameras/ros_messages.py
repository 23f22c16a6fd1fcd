"""Decoding of ROS 2 images and camera infos from CDR, the format of bridges and bags.

Image encodings are those of `sensor_msgs/image_encodings`. Depth in the encoding 16UC1 is in
millimeters, and depth in 32FC1 is in meters (REP 118).
"""

import struct
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, FrameError, install_command
from ldo_service.geometry.codecs import PNG, decode_depth, read_image_size
from ldo_service.schemas import CameraModel, CameraRgbd, Image
from ldo_service.schemas.frames import MAX_PIXELS, ImageEncoding

# First bytes of CDR, big and little endian. ROS 2 does not send the other versions of CDR.
CDR_HEADERS = (
    b"\0\0",
    b"\0\1",
)
COLOR_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
# Encoding in messages of the service, NumPy type and units per meter, by ROS encoding.
DEPTH_KINDS: dict[str, tuple[ImageEncoding, str, float]] = {
    "16UC1": ("z16", "u2", 1000.0),
    "mono16": ("z16", "u2", 1000.0),
    "32FC1": ("f32", "f4", 1.0),
}
# Number of bytes before the PNG of compressed depth: a format and two quantization parameters.
COMPRESSED_DEPTH_HEADER = 12
PLUMB_BOB, RATIONAL, UNDISTORTED = "plumb_bob", "rational_polynomial", ("", "none")
# Distortion models of librealsense that are read as plumb_bob. The "inverse" model undistorts by
# inverting the polynomial of plumb_bob. For a lens with k1 = -0.06 at 1280x720, the pixels of both
# models agree within 0.03 px (librealsense 2.55).
REALSENSE_PLUMB_BOB = ("Brown Conrady", "Inverse Brown Conrady")
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


@dataclass(frozen=True, slots=True)
class RosImage:
    """Image of a ROS message."""

    stamp_ns: int
    frame_id: str  # ROS name of the camera frame.
    image: Image
    # Number of units of the depth image in a meter: 1000 for millimeters.
    depth_scale: float = 1.0


def is_compressed(topic: str) -> bool:
    """Return whether image_transport uses this topic name for compressed images."""
    return topic.endswith(("/compressed", "/compressedDepth"))


def read_color(body: bytes, topic: str) -> RosImage:
    """Decode a color image from sensor_msgs/Image or sensor_msgs/CompressedImage.

    Args:
        body: The message in CDR.
        topic: Name of the topic, which determines the type of the message.

    Raises:
        FrameError: The message is invalid, or its encoding is not supported.
    """
    return color_image(decoded(body, COMPRESSED_IMAGE if is_compressed(topic) else IMAGE))


def color_image(message: Any) -> RosImage:
    """Convert a decoded sensor_msgs/Image or sensor_msgs/CompressedImage to a color image.

    Raises:
        FrameError: The encoding is not supported, or the size does not fit the data.
    """
    if message.__msgtype__ == COMPRESSED_IMAGE:
        return _compressed(message, 0)
    channels = COLOR_CHANNELS.get(message.encoding)
    if channels is None:
        raise FrameError(
            f"color encoding {message.encoding[:40]!r} is not supported. Set the camera driver to "
            f"one of {', '.join(COLOR_CHANNELS)}."
        )
    pixels = _pixels(message, np.dtype("u1"), channels)
    if channels == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    encoding: ImageEncoding = "bgr8" if message.encoding.startswith("bgr") else "rgb8"
    return _ros_image(message, Image.raw(encoding, pixels[..., :3]))


def read_depth(body: bytes, topic: str) -> RosImage:
    """Decode a depth image from sensor_msgs/Image or sensor_msgs/CompressedImage.

    Args:
        body: The message in CDR.
        topic: Name of the topic, which determines the type of the message.

    Raises:
        FrameError: The message is invalid, or its encoding is not supported.
    """
    return depth_image(decoded(body, COMPRESSED_IMAGE if is_compressed(topic) else IMAGE))


def depth_image(message: Any) -> RosImage:
    """Convert a decoded sensor_msgs/Image or sensor_msgs/CompressedImage to a depth image.

    Raises:
        FrameError: The encoding is not supported, or the size does not fit the data.
    """
    if message.__msgtype__ == COMPRESSED_IMAGE:
        return _compressed_depth(message)
    if message.encoding not in DEPTH_KINDS:
        raise FrameError(
            f"depth encoding {message.encoding[:40]!r} is not supported. Set the camera driver to "
            f"one of {', '.join(DEPTH_KINDS)}."
        )
    encoding, kind, depth_scale = DEPTH_KINDS[message.encoding]
    dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
    depth = _pixels(message, dtype, 1)[..., 0].astype(dtype.newbyteorder("<"))
    return _ros_image(message, Image.raw(encoding, depth), depth_scale)


def read_camera(body: bytes, is_rectified: bool) -> CameraModel:
    """Decode the camera model from sensor_msgs/CameraInfo.

    Args:
        body: The message in CDR.
        is_rectified: True if the images are rectified. The intrinsics are then the left 3x3 block
            of P, without distortion. Otherwise, K is the intrinsics and D is the distortion.

    Raises:
        FrameError: The message is invalid, or its distortion model is not supported.
    """
    return camera_model(decoded(body, CAMERA_INFO), is_rectified)


def camera_model(info: Any, is_rectified: bool) -> CameraModel:
    """Convert a decoded sensor_msgs/CameraInfo to a camera model; see `read_camera`.

    Raises:
        FrameError: The message is invalid, or its distortion model is not supported.
    """
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
        raise FrameError(
            f"the camera info is invalid: {error}. Calibrate the camera, or correct its driver."
        ) from error


def joined(
    color: RosImage, depth: RosImage, camera: CameraModel, frame: int, is_registered: bool
) -> CameraRgbd:
    """Combine a color image and a depth image into a frame with the stamp of the color image.

    Args:
        color: Color image.
        depth: Depth image.
        camera: The color camera.
        frame: Number of the frame.
        is_registered: True declares depth to be registered to color even if the frame_ids differ.

    Raises:
        FrameError: The frame_ids differ, or the size of an image is wrong.
    """
    if depth.frame_id != color.frame_id and not is_registered:
        raise FrameError(
            f"the frame_id of depth is {depth.frame_id!r}, but that of color is "
            f"{color.frame_id!r}. Subscribe to depth that is registered to color: set "
            "align_depth.enable:=true for realsense2_camera, or use the node `register` of "
            "depth_image_proc. If this depth is already registered, add --registered."
        )
    if (color.image.width, color.image.height) != (camera.width, camera.height):
        raise FrameError(
            f"the color image has {color.image.width}x{color.image.height} pixels, but its camera "
            f"info states {camera.width}x{camera.height}. Check that the camera info belongs to "
            "this color topic."
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
        raise FrameError(
            f"color and depth cannot form a frame: {error}. Check the settings of the camera "
            "driver."
        ) from error


# --- CDR ------------------------------------------------------------------------------------------
@cache
def typestore() -> Any:
    """Return the type store of rosbags, which decodes CDR.

    Raises:
        ConfigError: The extra `ros2` is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError(
            f"reading ROS 2 needs the extra `ros2`. Install it by {install_command('ros2')}."
        ) from error
    return get_typestore(Stores.ROS2_HUMBLE)  # Later versions did not change these messages.


def decoded(body: bytes, kind: str) -> Any:
    """Decode a message of a type, such as sensor_msgs/msg/Image, from CDR.

    Raises:
        FrameError: The bytes are not CDR of ROS 2, or not a message of this type.
    """
    if body[:2] not in CDR_HEADERS:
        raise FrameError(
            f"{len(body)} bytes that begin with {body[:4].hex()} are not CDR of ROS 2. Check that "
            "the bridge is zenoh-bridge-ros2dds, or that the bag was made by ROS 2."
        )
    store = typestore()
    try:
        return store.deserialize_cdr(body, kind)
    except Exception as error:  # rosbags does not convert all errors of decoding to its own.
        raise FrameError(
            f"{len(body)} bytes cannot be decoded as {kind}: {error}. Check that the topic has "
            "this message type."
        ) from error


def _ros_image(message: Any, image: Image, depth_scale: float = 1.0) -> RosImage:
    stamp = message.header.stamp
    stamp_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec)
    return RosImage(stamp_ns, message.header.frame_id, image, depth_scale)


def _pixels(message: Any, dtype: np.dtype, channels: int) -> np.ndarray:
    """Return the pixels [H, W, channels] of a message, without the padding of rows."""
    height, width, step = message.height, message.width, message.step
    row_bytes = width * channels * dtype.itemsize
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameError(
            f"an image has {width}x{height} pixels, expected 1 to {MAX_PIXELS} in total. Lower "
            "the resolution in the camera driver."
        )
    if step < row_bytes or len(message.data) != step * height:
        raise FrameError(
            f"a {message.encoding} image of {width}x{height} pixels needs {height} rows of at "
            f"least {row_bytes} bytes, but has {len(message.data)} bytes with {step} per row. "
            "Check the camera driver."
        )
    rows = np.reshape(message.data, (height, step))[:, :row_bytes]
    return np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)


def _compressed(message: Any, start: int, depth_scale: float = 1.0) -> RosImage:
    """Wrap a compressed image without decoding it; the receiving service decodes it.

    Args:
        message: The message, a sensor_msgs/CompressedImage.
        start: Number of bytes before the PNG or JPEG.
        depth_scale: Units of a depth image per meter.
    """
    data = memoryview(message.data.tobytes())[start:]
    size = read_image_size(data)
    if size is None:
        raise FrameError(
            f"a compressed image of format {message.format[:40]!r} is neither PNG nor JPEG. "
            "Publish PNG or JPEG images."
        )
    encoding: ImageEncoding = "jpeg" if bytes(data[:2]) == b"\xff\xd8" else "png"
    try:
        image = Image(encoding=encoding, width=size[0], height=size[1], data=data)
    except ValueError as error:
        raise FrameError(
            f"a compressed image is invalid: {error}. Check the settings of the camera driver."
        ) from error
    return _ros_image(message, image, depth_scale)


def _compressed_depth(message: Any) -> RosImage:
    """Wrap compressed depth in millimeters, or decode compressed depth in meters.

    The transport `compressedDepth` stores float depth as the 16-bit integers A / depth + B. Its
    header has a format and the float32 numbers A and B. The integer 0 marks an unmeasured pixel.

    Raises:
        FrameError: The format is not supported, or the data are invalid.
    """
    if message.format.startswith("16UC1"):
        # The transport `compressed` stores depth as plain PNG, without the header.
        is_plain = message.data[: len(PNG)].tobytes() == PNG
        return _compressed(message, 0 if is_plain else COMPRESSED_DEPTH_HEADER, 1000.0)
    if not message.format.startswith("32FC1"):
        raise FrameError(
            f"compressed depth format {message.format[:40]!r} is not supported. Publish depth as "
            "16UC1 or 32FC1."
        )
    stored = _compressed(message, COMPRESSED_DEPTH_HEADER)
    image = stored.image
    values = decode_depth(image.encoding, image.width, image.height, image.data).astype(np.float32)
    _, A, B = struct.unpack("<iff", message.data[:COMPRESSED_DEPTH_HEADER].tobytes())
    with np.errstate(all="ignore"):
        depth_m = np.where(values > 0, np.float32(A) / (values - np.float32(B)), np.float32("nan"))
    return replace(stored, image=Image.raw("f32", depth_m.astype(np.float32)))


def _distortion(info: Any) -> tuple[float, ...]:
    """Return the distortion coefficients in the order of OpenCV, which ROS uses too.

    Raises:
        FrameError: The distortion model is not supported.
    """
    d = tuple(float(number) for number in info.d)
    if not any(d) or info.distortion_model in UNDISTORTED:
        return ()
    if info.distortion_model not in (PLUMB_BOB, RATIONAL, *REALSENSE_PLUMB_BOB):
        raise FrameError(
            f"distortion model {info.distortion_model!r} is not supported, expected {PLUMB_BOB} or "
            f"{RATIONAL}. Use topics of rectified images; for `ldo publish ros2`, add --rectified."
        )
    return d
