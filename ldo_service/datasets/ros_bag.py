"""Sequences in bags of ROS 1 and ROS 2: RGB-D cameras, and recordings of RealSense Viewer.

A bag needs three topics: color images, depth images, and the camera info of color. This module
finds them by their types and usual names. `SequenceOptions.topics` can name the topics of color and
depth instead. The images are sensor_msgs/Image or sensor_msgs/CompressedImage. A frame has a color
image and the nearest depth image within 20 ms.

Depth counts as registered to color if both images have the same size and the same viewpoint. The
viewpoint is the same if the name of the depth topic says so, if the frame_ids are equal, or if the
transform between them is the identity. Otherwise, this module registers depth to color with the
camera info of depth and this transform, which it reads from /tf_static or from the topics of
RealSense Viewer.

A topic with nav_msgs/Odometry gives the recorded odometry, if /tf_static connects its child frame
with the camera. Inertial measurements and moving transforms are not used. The attribute `streams`
of the sequence lists all topics.
"""

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec import structs

from ldo_service.cameras.ros_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    RosImage,
    camera_model,
    color_image,
    depth_image,
)
from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry import Camera, RawFrame, Trajectory, codecs, se3
from ldo_service.geometry.frames import in_meters
from ldo_service.geometry.sequence import Sequence, Stream

from .bag_file import BagFile, StoredMessage, Topic, is_bag
from .bag_frames import (
    matrix_of,
    odometry_topic,
    read_odometry,
    readable_messages,
    static_transform,
)
from .files import name_of, pair_by_stamp
from .rig import Rig, SequenceOptions

__all__ = ["RosBagSequence", "is_bag"]

log = logging.getLogger(__name__)

TRIES = 10  # Number of first images of a topic of which one must be readable.

# Names of topics, without the suffix of compressed images. An earlier pattern is preferred.
COLOR_NAMES = (
    r"(color|rgb)/image_raw$",
    r"(color|rgb)/image(_raw)?_color$",
    r"(color|rgb)/image_rect(_color|_raw)?$",
    r"Color_\d+/image/data$",
    r"color|rgb",
    r"/image(_raw|_color|_rect_color)?$",
)
DEPTH_NAMES = (
    r"(aligned_depth_to|depth_to)_(color|rgb)/image_raw$",
    r"depth_registered/(\w+/)?image(_raw|_rect|_rect_raw)?$",
    r"depth/image(_raw|_rect|_rect_raw)?$",
    r"Depth_\d+/image/data$",
    r"depth",
    r"stereo/image_raw$",  # DepthAI.
)
REGISTERED = re.compile(r"aligned_depth_to|depth_to_(color|rgb)|depth_registered")
NOT_COLOR = re.compile(r"depth|mono|infra|confidence", re.IGNORECASE)
NOT_DEPTH = re.compile(r"(color|rgb)_to_depth|confidence|points", re.IGNORECASE)
COMPRESSED = re.compile(r"/(compressed|compressedDepth)$")


class RosBagSequence(Sequence):
    """Sequence of the RGB-D camera in a bag; the stamp of a frame is that of the color image."""

    def __init__(self, path: Path, options: SequenceOptions) -> None:
        """Open a bag and read the stamps of its images."""
        self._bag = bag = BagFile(path)
        color, depth = _image_topics(bag, options)
        messages = bag.messages((color, depth))
        colors, depths = (_ascending(messages, topic) for topic in (color, depth))
        stamps_ns, depth_stamps_ns = (
            np.array([message.stamp_ns for message in stream], np.int64)
            for stream in (colors, depths)
        )
        pairs = pair_by_stamp(
            path,
            (f"images of {color.name}", stamps_ns),
            (f"images of {depth.name}", depth_stamps_ns),
            "Check that one clock made the stamps of both.",
        )
        self._frames = [(colors[i], depths[j]) for i, j in pairs]
        camera = options.color_camera or _camera(bag, color)
        images = self._first_images()
        self._rig = _rig(bag, color, depth, images, camera, options)
        self._frame_id = images[0].frame_id.lstrip("/")
        self._odometry = odometry_topic(bag, options.topics.get("odometry", ""))
        self._units_per_m = _realsense_units_per_m(bag, depth)
        super().__init__(name_of(path), camera, stamps_ns[pairs[:, 0]])
        self.depth_offsets_ns = depth_stamps_ns[pairs[:, 1]] - self.stamps_ns
        self.registration = "source" if self._rig is None else "reader"
        self.streams = self._streams(color, depth)

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        color, depth = self._images(index)
        image = color.image
        pixels = codecs.decode_color(image.encoding, image.width, image.height, image.data)
        image = depth.image
        values = codecs.decode_depth(image.encoding, image.width, image.height, image.data)
        is_integer = values.dtype == np.uint16
        depth_scale = (is_integer and self._units_per_m) or depth.depth_scale
        if self._rig is not None:
            values, depth_scale = self._rig.register(in_meters(values, depth_scale)), 1.0
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, pixels, values, depth_scale, self.raw_camera)

    def truth(self) -> Trajectory | None:
        """Return None, because a bag has no ground truth."""
        return None

    def odometry(self) -> Trajectory | None:
        """Return the recorded odometry, or None if there is none.

        Raises:
            DataError: /tf_static does not connect the child frame of the odometry with the camera.
        """
        if self._odometry is None:
            return None
        return read_odometry(self._bag, self._odometry, self._frame_id)

    def _streams(self, color: Topic, depth: Topic) -> tuple[Stream, ...]:
        """Return all topics of the bag, with the use of each."""
        uses = dict.fromkeys(self._bag.read_topics, "calibration")
        if self._odometry:
            uses |= {"/tf_static": "calibration", self._odometry.name: "odometry"}
        uses |= {color.name: "color", depth.name: "depth"}
        return tuple(
            Stream(topic.name, topic.kind.replace("/msg/", "/"), topic.count, uses.get(name, ""))
            for name, topic in self._bag.topics.items()
        )

    def _images(self, index: int) -> tuple[RosImage, RosImage]:
        color, depth = self._frames[index]
        return color_image(self._bag.read(color)), depth_image(self._bag.read(depth))

    def _first_images(self) -> tuple[RosImage, RosImage]:
        """Return the images of the first readable frame.

        Raises:
            DataError: None of the first frames can be read.
        """
        reason = ""
        tries = min(TRIES, len(self._frames))
        for index in range(tries):
            try:
                return self._images(index)
            except FrameError as error:
                reason = reason or str(error)
        raise DataError(
            f"the first frames of {self._bag.path} cannot be read ({tries} tried). The first "
            f"error: {reason}"
        )


def _ascending(messages: list[StoredMessage], topic: Topic) -> list[StoredMessage]:
    """Sort the messages of a topic by stamp, and keep only the first message of each stamp."""
    found: dict[int, StoredMessage] = {}
    for message in messages:
        if message.connection.topic == topic.name:
            found.setdefault(message.stamp_ns, message)
    return [found[stamp_ns] for stamp_ns in sorted(found)]


# --- topics ---------------------------------------------------------------------------------------
def _image_topics(bag: BagFile, options: SequenceOptions) -> tuple[Topic, Topic]:
    """Return the topics of color and depth.

    Raises:
        DataError: A topic is missing, or several fit.
        ConfigError: A topic of the options is not in the bag.
    """
    color = _topic(bag, "color", options.topics.get("color", ""), COLOR_NAMES, NOT_COLOR, None)
    return color, _topic(
        bag, "depth", options.topics.get("depth", ""), DEPTH_NAMES, NOT_DEPTH, color
    )


def _topic(
    bag: BagFile,
    stream: str,
    given: str,
    names: tuple[str, ...],
    excluded: re.Pattern[str],
    beside: Topic | None,
) -> Topic:
    """Return the topic of a stream.

    Args:
        bag: The bag.
        stream: "color" or "depth".
        given: Name of the topic from the options; empty to search for the topic.
        names: Patterns of usual names, the preferred one first.
        excluded: Pattern of names that belong to other streams.
        beside: Topic of the same camera; topics that share its namespace are preferred.
    """
    images = [t for t in bag.topics.values() if t.kind in (IMAGE, COMPRESSED_IMAGE) and t.count]
    if given:
        for topic in images:
            if topic.name == given:
                return topic
        raise ConfigError(
            f"--topic {stream}={given} names no topic with images in {bag.path}. "
            f"{_listed('Its topics with images', images)}."
        )
    ranked: dict[tuple[int, int, int], list[Topic]] = {}
    for topic in images:
        name = COMPRESSED.sub("", topic.name)
        ranks = [k for k, known in enumerate(names) if re.search(known, name, re.IGNORECASE)]
        if topic is beside:
            continue
        # The namespace before the last two parts may name the camera, such as /depth_camera.
        if ranks and not excluded.search("/".join(name.split("/")[-2:])):
            distance = -_common_parts(topic.name, beside.name) if beside else 0
            rank = distance, ranks[0], int(topic.kind == COMPRESSED_IMAGE)
            ranked.setdefault(rank, []).append(topic)
    if not any(topic.count for topic in bag.topics.values()):
        raise DataError(f"{bag.path} has no messages. Check that the topics were published.")
    if not ranked:
        raise DataError(
            f"{bag.path} has no topic that is known to have {stream} images. "
            f"{_listed('Its topics', [t for t in bag.topics.values() if t.count])}. If one of them "
            f"has {stream} images (sensor_msgs/Image or CompressedImage), name it by --topic "
            f"{stream}=/TOPIC."
        )
    best = ranked[min(ranked)]
    if len(best) > 1:
        raise DataError(
            f"{bag.path} has several topics with {stream} images: "
            f"{', '.join(topic.name for topic in best)}. Choose one by --topic "
            f"{stream}={best[0].name}."
        )
    return best[0]


def _common_parts(a: str, b: str) -> int:
    """Return how many leading parts the names of two topics have in common."""
    parts = zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False)
    return next((k for k, (x, y) in enumerate(parts) if x != y), 99)


def _listed(title: str, topics: list[Topic]) -> str:
    if not topics:
        return f"{title}: none"
    shown = ", ".join(f"{topic.name} ({topic.kind.replace('/msg/', '/')})" for topic in topics[:20])
    return f"{title}: {shown}" + (f" and {len(topics) - 20} more" if len(topics) > 20 else "")


# --- calibration ----------------------------------------------------------------------------------
def _info_topic(bag: BagFile, image: Topic) -> Topic | None:
    """Return the topic of the camera info of an image topic, or None if there is none."""
    name = COMPRESSED.sub("", image.name)
    folder = name.rpartition("/")[0]
    for info in (
        f"{folder}/camera_info",
        f"{name}/camera_info",
        f"{folder.removesuffix('/image')}/info/camera_info",  # RealSense Viewer.
        f"{folder.rpartition('/')[0]}/camera_info",
    ):
        topic = bag.topics.get(info)
        if topic is not None and topic.kind == CAMERA_INFO and topic.count:
            return topic
    return None


def _camera(bag: BagFile, image: Topic) -> Camera:
    """Return the camera of an image topic; that of rectified images has no distortion.

    Raises:
        DataError: There is no camera info, or it is invalid.
    """
    topic = _info_topic(bag, image)
    if topic is None:
        folder = COMPRESSED.sub("", image.name).rpartition("/")[0]
        infos = [t for t in bag.topics.values() if t.kind == CAMERA_INFO]
        raise DataError(
            f"{bag.path} has no camera info of {image.name}. Expected sensor_msgs/CameraInfo on "
            f"{folder}/camera_info. {_listed('Its topics of this type', infos)}. Record the camera "
            "info too, or choose other images by --topic."
        )
    is_rectified = "rect" in COMPRESSED.sub("", image.name).rpartition("/")[2]
    try:
        found = bag.messages([topic], limit=1)
        if not found:
            raise DataError(
                "the index lists messages that are not in the file. Copy the bag again."
            )
        model = camera_model(bag.read(found[0]), is_rectified)
        return Camera.of(structs.asdict(model))
    except (FrameError, DataError) as error:
        raise DataError(f"{topic.name} in {bag.path} cannot be used: {error}") from error


def _rig(
    bag: BagFile,
    color: Topic,
    depth: Topic,
    images: tuple[RosImage, RosImage],
    color_camera: Camera,
    options: SequenceOptions,
) -> Rig | None:
    """Return the cameras for the registration of depth, or None if depth is registered already.

    Raises:
        DataError: The transform from depth to color or the camera info of depth is missing.
    """
    T_color_depth = options.T_color_depth
    if T_color_depth is None:
        T_color_depth = _transform(bag, color, depth, images)
    sizes = {(image.image.width, image.image.height) for image in images}
    is_one_view = Rig(color_camera, color_camera, T_color_depth).is_one_view
    if is_one_view and len(sizes) == 1 and not options.register_depth:
        return None
    depth_camera = options.depth_camera or _camera(bag, depth)
    return replace(options.over(Rig(color_camera, depth_camera)), T_color_depth=T_color_depth)


def _transform(
    bag: BagFile, color: Topic, depth: Topic, images: tuple[RosImage, RosImage]
) -> np.ndarray:
    """Return the transform [4, 4] from depth to color coordinates, in meters.

    Raises:
        DataError: The bag does not contain it.
    """
    if REGISTERED.search(depth.name):
        return np.eye(4)
    T_color_ref, T_depth_ref = (_realsense_extrinsics(bag, topic) for topic in (color, depth))
    if T_color_ref is not None and T_depth_ref is not None:
        return T_color_ref @ se3.inverse(T_depth_ref)
    color_frame, depth_frame = (image.frame_id.lstrip("/") for image in images)
    if color_frame == depth_frame:
        return np.eye(4)
    T_color_depth = static_transform(bag, color_frame, depth_frame)
    if T_color_depth is None:
        raise DataError(
            f"{bag.path}: the depth of {depth.name} is not registered to color. The frame of depth "
            f"is {depth_frame!r} and the frame of color is {color_frame!r}, and /tf_static does "
            "not connect them. Record depth that is registered (realsense2_camera: "
            "align_depth.enable:=true), or record /tf_static, or set dataset.T_color_depth."
        )
    return T_color_depth


def _realsense_extrinsics(bag: BagFile, image: Topic) -> np.ndarray | None:
    """Return the transform [4, 4] from the reference stream to a stream.

    RealSense Viewer records it in bags of ROS 1. None if the bag does not contain it.
    """
    base = COMPRESSED.sub("", image.name).removesuffix("/image/data")
    topics = re.compile(re.escape(base) + r"/tf/\d+")
    for message in readable_messages(bag, lambda topic: bool(topics.fullmatch(topic.name))):
        return matrix_of(message) if hasattr(message, "rotation") else None
    return None


def _realsense_units_per_m(bag: BagFile, depth: Topic) -> float | None:
    """Return the depth units per meter that RealSense Viewer recorded; None if there are none."""
    sensor = re.match(r"/device_\d+/sensor_\d+/", depth.name)
    if sensor is None:
        return None
    name = f"{sensor[0]}option/Depth_Units/value"
    for message in readable_messages(bag, lambda topic: topic.name == name):
        try:
            # A float32, or text; rounding restores the decimal value.
            unit_m = round(float(message.data), 9)
        except (AttributeError, ValueError):
            return None
        return 1 / unit_m if 0 < unit_m < 1 else None
    return None
