"""Live cameras of `ldo publish`: RealSense over USB and topics of ROS 2."""

import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from itertools import islice
from typing import Annotated

import msgspec

from ldo_service.cameras.realsense import RealSenseStream
from ldo_service.cameras.ros2 import RosCamera, RosTopics
from ldo_service.client import Client
from ldo_service.errors import ConfigError
from ldo_service.runs.source import Selection
from ldo_service.schemas import CameraRgbd
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session

from .options import argument, image_size

REALSENSE, ROS2 = "realsense", "ros2"
Notify = Callable[[str], None]


@dataclass(frozen=True)
class RealSenseOptions:
    """Options of `ldo publish realsense`."""

    serial: Annotated[
        str,
        argument(metavar="NUMBER", help="serial number of the camera, if several are connected"),
    ] = ""
    size: Annotated[str, argument(metavar="WxH", help="image size of color and depth")] = "640x480"
    fps: Annotated[int, argument(metavar="HZ", help="frame rate of color and depth")] = 30

    def stream(self) -> RealSenseStream:
        """Return the stream settings that these options select.

        Raises:
            ConfigError: The size or the rate is invalid.
        """
        width, height = image_size(self.size)
        if self.fps <= 0:
            raise ConfigError(f"--fps {self.fps} must be a positive rate in Hz, such as 30.")
        return RealSenseStream(self.serial, width, height, self.fps)


@dataclass(frozen=True)
class RosOptions:
    """Options of `ldo publish ros2`."""

    color: Annotated[
        str,
        argument(
            metavar="TOPIC",
            help="color; type Image, or CompressedImage if the name ends in /compressed",
        ),
    ] = ""
    depth: Annotated[
        str,
        argument(
            metavar="TOPIC",
            help="depth registered to color; type Image, or CompressedImage if the name ends in "
            "/compressed or /compressedDepth",
        ),
    ] = ""
    info: Annotated[
        str,
        argument(
            metavar="TOPIC",
            help="CameraInfo of color; default: camera_info in the namespace of --color",
        ),
    ] = ""
    bridge: Annotated[
        str,
        argument(
            metavar="ADDRESS",
            help="address of the router that the bridge is connected to; default: --endpoint",
        ),
    ] = ""
    max_skew_s: Annotated[
        float,
        argument(metavar="S", help="maximum difference of the stamps of color and depth, s"),
    ] = 0.015
    rectified: Annotated[
        bool, argument(help="images are rectified: use P of the CameraInfo, not K and D")
    ] = False
    registered: Annotated[
        bool, argument(help="depth is registered to color, although the two frame_ids differ")
    ] = False

    def topics(self) -> RosTopics:
        """Return the ROS topics that these options select.

        Raises:
            ConfigError: A topic is missing or has an invalid name.
        """
        if not (self.color and self.depth):
            raise ConfigError("`ldo publish ros2` needs --color TOPIC and --depth TOPIC.")
        names = self.color, self.depth, self.info
        return RosTopics(*names, self.max_skew_s, self.rectified, self.registered)


def frames_of_ros(
    options: RosOptions, service: Endpoint, notify: Notify
) -> Generator[CameraRgbd, None, None]:
    """Return the frames made from ROS 2 messages that a Zenoh bridge forwards.

    Args:
        options: Topics and options.
        service: Endpoint of the service. The topics of ROS 2 are read from the same router, unless
            `options.bridge` gives another one.
        notify: Callback that receives notes for the user.

    Raises:
        ConfigError: The service has keys and `options.bridge` is empty: the router of the
            service then does not forward topics of ROS 2.
    """
    if service.keys is not None and not options.bridge:
        raise ConfigError(
            "the router of the service runs with --keys, so it forwards only the service's own "
            "topics, not those of ROS 2. Run the bridge with its own router, and give that "
            "router's address with --bridge."
        )
    camera = RosCamera(options.topics(), notify)
    bridge = Endpoint(service.robot, options.bridge or service.endpoint)
    return _report_at_end(camera, bridge, notify)


def _report_at_end(
    camera: RosCamera, bridge: Endpoint, notify: Notify
) -> Generator[CameraRgbd, None, None]:
    with open_session(bridge) as session:
        try:
            yield from camera.frames(session)
        finally:
            notify(camera.statistics)


def require_no_sequence(source: str, **options: object) -> None:
    """Check that no option is given that applies only to sequences.

    Raises:
        ConfigError: Such an option is given.
    """
    for name, value in options.items():
        if value:
            raise ConfigError(
                f"--{name} applies to sequences, not to the live camera `{source}`. Remove it."
            )


def relay(
    service: Client, frames: Iterable[CameraRgbd], chosen: Selection, restamp: bool, notify: Notify
) -> None:
    """Send every n-th frame until `chosen.max_frames` are sent or the user presses Ctrl-C.

    Args:
        service: Connection to the service.
        frames: Frames of a live camera.
        chosen: Stride and maximum number of frames.
        restamp: True to replace the stamp of each frame by the time of sending.
        notify: Callback that receives notes for the user.
    """
    if not service.wait_for_subscriber():
        notify("camera/rgbd has no subscriber yet: is the service of this robot running?")
    sent = 0
    try:
        for frame in islice(frames, 0, None, chosen.stride):
            service.send(_stamped_now(frame) if restamp else frame)
            sent += 1
            if sent == chosen.max_frames:
                break
    finally:
        notify(f"{sent} frames published")


def _stamped_now(frame: CameraRgbd) -> CameraRgbd:
    return msgspec.structs.replace(frame, stamp_ns=time.time_ns())
