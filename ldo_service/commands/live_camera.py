"""`ldo publish realsense` and `ldo publish ros2`: frames of a camera that is there, passed on."""

import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from itertools import islice
from typing import Annotated

import msgspec
import tyro

from ldo_service.cameras.realsense import RealSenseStream
from ldo_service.cameras.ros2 import RosCamera, RosTopics
from ldo_service.client import Client
from ldo_service.errors import ConfigError
from ldo_service.runs.source import Selection
from ldo_service.schemas import CameraRgbd
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session

REALSENSE, ROS2 = "realsense", "ros2"
Say = Callable[[str], None]


@dataclass(frozen=True)
class RealSenseOptions:
    """Of `ldo publish realsense`."""

    serial: Annotated[
        str, tyro.conf.arg(metavar="NUMBER", help="of the device, where there are several")
    ] = ""
    size: Annotated[str, tyro.conf.arg(metavar="WxH", help="of colour and depth")] = "640x480"
    fps: Annotated[int, tyro.conf.arg(metavar="HZ", help="of both")] = 30

    def stream(self) -> RealSenseStream:
        """Raises ConfigError for a size or a rate that is none."""
        width, _, height = self.size.partition("x")
        if not (width.isdecimal() and height.isdecimal() and self.fps > 0):
            raise ConfigError(
                f"--size {self.size} --fps {self.fps}: write them like 640x480 and 30."
            )
        return RealSenseStream(self.serial, int(width), int(height), self.fps)


@dataclass(frozen=True)
class RosOptions:
    """Of `ldo publish ros2`."""

    color: Annotated[
        str,
        tyro.conf.arg(metavar="TOPIC", help="Image; CompressedImage where it ends in /compressed"),
    ] = ""
    depth: Annotated[
        str,
        tyro.conf.arg(metavar="TOPIC", help="registered to colour; or one in /compressedDepth"),
    ] = ""
    info: Annotated[
        str,
        tyro.conf.arg(metavar="TOPIC", help="CameraInfo of colour; default: camera_info beside it"),
    ] = ""
    bridge: Annotated[
        str,
        tyro.conf.arg(
            metavar="ADDRESS", help="of a bridge with a router of its own; default: --endpoint"
        ),
    ] = ""
    max_skew_s: Annotated[
        float, tyro.conf.arg(metavar="S", help="most between the stamps of colour and depth")
    ] = 0.015
    rectified: Annotated[
        bool, tyro.conf.arg(help="images are rectified: take P of the CameraInfo, not K and D")
    ] = False
    registered: Annotated[
        bool, tyro.conf.arg(help="depth is registered, though its frame_id is not that of colour")
    ] = False

    def topics(self) -> RosTopics:
        """Raises ConfigError for what is missing, or no topic."""
        if not (self.color and self.depth):
            raise ConfigError("`ldo publish ros2` needs --color TOPIC and --depth TOPIC.")
        names = self.color, self.depth, self.info
        return RosTopics(*names, self.max_skew_s, self.rectified, self.registered)


def frames_of_ros(
    options: RosOptions, service: Endpoint, say: Say
) -> Generator[CameraRgbd, None, None]:
    """Raises ConfigError where nobody could get them."""
    if service.keys is not None and not options.bridge:
        raise ConfigError(
            "a router with keys lets through the service's topics alone: run the bridge with a "
            "router of its own, and name its address with --bridge."
        )
    camera = RosCamera(options.topics(), say)
    bridge = Endpoint(service.robot, options.bridge or service.endpoint)
    return _report_at_end(camera, bridge, say)


def _report_at_end(
    camera: RosCamera, bridge: Endpoint, say: Say
) -> Generator[CameraRgbd, None, None]:
    with open_session(bridge) as session:
        try:
            yield from camera.frames(session)
        finally:
            say(camera.statistics)


def require_no_sequence(source: str, **options: object) -> None:
    """Raises ConfigError for options that only recorded frames have a use for."""
    for name, value in options.items():
        if value:
            raise ConfigError(
                f"--{name} is for sequences: `ldo publish {source}` sends what comes."
            )


def relay(
    service: Client, frames: Iterable[CameraRgbd], chosen: Selection, restamp: bool, say: Say
) -> None:
    """Send every n-th frame, until there are `chosen.max_frames`, or Ctrl-C."""
    if not service.wait_for_subscriber():
        say("nobody listens to camera/rgbd yet: is the service of this robot running?")
    sent = 0
    try:
        for frame in islice(frames, 0, None, chosen.stride):
            service.send(_stamped_now(frame) if restamp else frame)
            sent += 1
            if sent == chosen.max_frames:
                break
    finally:
        say(f"{sent} frames published")


def _stamped_now(frame: CameraRgbd) -> CameraRgbd:
    return msgspec.structs.replace(frame, stamp_ns=time.time_ns())
