"""Topics of ROS 2 on a Zenoh router, published as the bridge does, as frames."""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count, cycle
from pathlib import Path

import numpy as np
import pytest
import zenoh

from ldo_service.cameras.ros2 import KEEP, Inbox, RosCamera, RosTopics, key_of
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError
from ldo_service.schemas import CameraRgbd, TrackedPose, decode
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_endpoint
from tests.service.conftest import LDO, live_service

from .ros import COLOR, DEPTH_MM, camera_info, cdr, header, image

TOPICS = RosTopics("/camera/color/image_raw", "/camera/depth/image_raw")
MS = 10**6


def color(stamp_ns: int) -> bytes:
    return cdr(image("rgb8", COLOR, header(stamp_ns)))


def depth(stamp_ns: int) -> bytes:
    return cdr(image("16UC1", DEPTH_MM, header(stamp_ns)))


class CameraFeed:
    """A ROS camera with the frames that it gives and the lines that it logs."""

    def __init__(self, topics: RosTopics = TOPICS, has_info: bool = True) -> None:
        self.log: list[str] = []
        self.camera, self.topics = RosCamera(topics, self.log.append), topics
        self.frames: list[CameraRgbd] = []
        if has_info:
            self.take(topics.camera_info, cdr(camera_info()))

    def take(self, topic: str, body: bytes) -> None:
        self.frames += self.camera.take(topic, body)

    def pair(self, color_ns: int, depth_ns: int) -> None:
        self.take(self.topics.color, color(color_ns))
        self.take(self.topics.depth, depth(depth_ns))


def test_camera_info_topic_is_next_to_the_image_topic() -> None:
    assert TOPICS.camera_info == "/camera/color/camera_info"
    assert RosTopics("/a/image_raw/compressed", "/d").camera_info == "/a/camera_info"
    assert RosTopics("/a/image_raw", "/d", "/b/info").camera_info == "/b/info"


@pytest.mark.parametrize("topic", ["", "/", "/a//b", "/a/*", "a b", "/a/**", "/a/$*", "/ä"])
def test_invalid_topic_is_rejected(topic: str) -> None:
    with pytest.raises(ConfigError, match="not a valid ROS topic"):
        key_of(topic)


def test_halves_are_paired_by_stamp_within_the_skew() -> None:
    feed = CameraFeed()
    feed.pair(100 * MS, 104 * MS)
    feed.pair(133 * MS, 160 * MS)  # 27 ms apart; the next color image is nearer.
    feed.take(TOPICS.color, color(166 * MS))
    assert [frame.stamp_ns for frame in feed.frames] == [100 * MS, 166 * MS]
    assert [frame.frame for frame in feed.frames] == [0, 1]
    assert feed.log == []


def test_missing_camera_info_is_reported_once() -> None:
    feed = CameraFeed(has_info=False)
    feed.pair(100 * MS, 100 * MS)
    feed.pair(133 * MS, 133 * MS)
    assert (len(feed.frames), feed.camera.rejected, len(feed.log)) == (0, 2, 1)
    assert "no camera info was received on /camera/color/camera_info yet" in feed.log[0]
    feed.take(TOPICS.camera_info, cdr(camera_info()))
    feed.pair(166 * MS, 166 * MS)
    assert len(feed.frames) == 1


def test_malformed_messages_are_counted_and_each_reason_reported_once() -> None:
    feed = CameraFeed()
    for number in range(40):
        feed.take(TOPICS.color, color(1)[: 40 + number % 2])
    feed.pair(100 * MS, 100 * MS)
    assert (len(feed.frames), feed.camera.rejected) == (1, 40)
    assert len(feed.log) <= 2
    assert "40 images rejected" in feed.camera.statistics


def test_restarted_camera_is_accepted() -> None:
    feed = CameraFeed()
    feed.pair(9_000 * MS, 9_000 * MS)
    feed.pair(100 * MS, 100 * MS)
    feed.pair(133 * MS, 133 * MS)
    assert len(feed.frames) == 3
    assert feed.log == ["The stamps went back: the camera has restarted. No action needed."]


def test_full_inbox_keeps_the_newest_samples() -> None:
    class Sample:
        def __init__(self, body: bytes) -> None:
            self.payload = self
            self.to_bytes = lambda: body

    inbox = Inbox()
    inbox.put("info", Sample(b"i"))  # type: ignore[arg-type]
    for number in range(KEEP + 2):
        inbox.put("color", Sample(bytes([number])))  # type: ignore[arg-type]
    taken = [inbox.take(0) for _ in range(KEEP + 2)]
    assert taken == [("info", b"i"), *(("color", bytes([n])) for n in range(2, KEEP + 2)), None]
    assert inbox.dropped == 2


# --- over the network -----------------------------------------------------------------------------
@contextmanager
def publisher(endpoint: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    topics = "--color", TOPICS.color, "--depth", TOPICS.depth
    process = subprocess.Popen(
        [*LDO, "publish", "ros2", *topics, "--endpoint", endpoint, *arguments],
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def test_publisher_forwards_the_topics_of_a_bridge() -> None:
    endpoint = free_endpoint()
    with open_session(Endpoint("robot", endpoint), router=True) as session:
        channel = zenoh.handlers.FifoChannel(64)
        frames = session.declare_subscriber("ldo/robot/camera/rgbd", channel)
        with publisher(endpoint, "--max-frames", "5") as process:
            stamps_ns = count(33 * MS, 33 * MS)
            while process.poll() is None:  # A bridge publishes without subscribers too.
                put(session, next(stamps_ns))
                time.sleep(0.05)
            assert process.stderr is not None
            stderr = process.stderr.read()
        got = [
            decode(sample.payload.to_bytes(), CameraRgbd) for sample in iter(frames.try_recv, None)
        ]
    assert process.returncode == 0, stderr
    assert "5 frames published" in stderr
    assert len(got) == 5
    assert [frame.frame for frame in got] == sorted(frame.frame for frame in got)
    assert got[0].camera.fx == 7.0
    assert bytes(got[0].color.data) == COLOR.tobytes()
    assert bytes(got[0].depth.data) == DEPTH_MM.tobytes()


def put(session: zenoh.Session, stamp_ns: int) -> None:
    session.put("camera/color/camera_info", cdr(camera_info()))
    session.put("camera/color/image_raw", color(stamp_ns))
    session.put("camera/depth/image_raw", depth(stamp_ns + MS))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_camera_of_a_ros_robot_is_tracked(room: Sequence, tmp_path: Path) -> None:
    camera = room.camera
    info = camera_info(
        width=camera.width,
        height=camera.height,
        d=np.zeros(5),
        k=np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0]),
    )
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        with (
            publisher(service.endpoint),
            open_session(Endpoint("robot", service.endpoint)) as bridge,
        ):
            frames, poses = cycle(range(20)), list[TrackedPose]()
            for number in count(1):  # A camera publishes without subscribers too.
                frame, stamp_ns = room[next(frames)], 66 * MS * number
                bridge.put("camera/color/camera_info", cdr(info))
                bridge.put(
                    "camera/color/image_raw", cdr(image("rgb8", frame.color, header(stamp_ns)))
                )
                bridge.put(
                    "camera/depth/image_raw", cdr(image("32FC1", frame.depth_m, header(stamp_ns)))
                )
                poses += service.poses()
                if len(poses) >= 5:
                    break
                assert number < 2000, service.log
                time.sleep(0.066)
        assert {pose.status for pose in poses[:5]} == {"OK"}
