"""A very slow labeller: no actor waits for it, and its labels lie on the right regions.

Its latency is counted in keyframes: it answers no request until enough of them were made.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.schemas import CameraRgbd, TrackedPose
from ldo_service.service.diagnostics import ActorStatus, diagnose, notes
from ldo_service.synthetic.flat import FlatSequence
from tests.detection.labellers.server import serving
from tests.service.conftest import PATIENCE, live_service, wait_until
from tests.service.failure_artifacts import Guide, flat, placed
from tests.service.message_inbox import Heard

FRAMES = range(0, 84, 2)
SILENT = 20  # Frames before the first answer.
LATE = 5  # Minimum latency of that answer, in keyframes.
# Time after which a frame is sent again: it was dropped, or came before all consumers.
LOST_AFTER_S = 5.0
LIGHT = ("detector.model=demo", "mapper.iterations=2", "supervision.heartbeat_s=0.1")
PATIENT = (  # Practically no limit.
    *("http.timeout_s=600", "http.deadline_s=600"),
    *("http.max_requests_per_minute=1000000", "http.max_views=1"),
)


class Walk:
    """Camera that sends a frame when the last one is tracked and, if it is a keyframe, mapped.

    The service then receives every frame on any machine, unless an actor waits for the labeller.
    """

    def __init__(self, sequence: FlatSequence, inbox: Heard) -> None:
        self._sequence, self.inbox = sequence, inbox
        self._sent = self._lost = 0

    def send_until_done(self, frame: int) -> None:
        message = raw_frame_to_message(self._sequence.read(frame))
        self._send(message)
        until_s = time.monotonic() + 20 * PATIENCE
        while not self._is_done_soon(frame):
            assert time.monotonic() < until_s, f"frame {frame} is not tracked and mapped"
            self.inbox.ask_again()
            if not self.inbox.poses:
                message = msgspec.structs.replace(message, stamp_ns=message.stamp_ns + 1)
                self._send(message)
            elif self._sent - self._handled() > self._lost:
                self._lost += 1
                self._send(message)

    def _send(self, message: CameraRgbd) -> None:
        self.inbox.service.client.send(message)
        self._sent += 1

    def _handled(self) -> int:
        return self.inbox.input("tracker", "frame/rgbd").delivered

    def _is_done_soon(self, frame: int) -> bool:
        until_s = time.monotonic() + LOST_AFTER_S
        while time.monotonic() < until_s:
            if self._is_done(frame):
                return True
            time.sleep(0.02)
        return False

    def _is_done(self, frame: int) -> bool:
        inbox = self.inbox
        inbox.listen()
        is_tracked = bool(inbox.poses) and inbox.poses[-1].frame == frame
        return is_tracked and inbox.fact("mapper", "keyframes") > max(inbox.frame_of)


@contextmanager
def walk(
    folder: Path, sequence: FlatSequence, *settings: str, guide: Guide | None = None
) -> Iterator[Walk]:
    folder.mkdir()
    words = [word for one in (*LIGHT, *settings) for word in ("--set", one)]
    with live_service(folder, *words) as service, ExitStack() as stack:
        service.wait_for_actors()
        yield Walk(sequence, Heard(service, stack, guide))
        assert service.stop() == 0
        assert "Traceback" not in service.log


def odometry(pose: TrackedPose) -> tuple[Any, ...]:
    """Return the fields of a pose that come from odometry, independent of the pose graph."""
    where = pose.T_odom_camera, pose.T_reference_camera, pose.covariance
    return pose.frame, pose.status, pose.keyframe, pose.reference, *where


def placed_keyframes(inbox: Heard) -> dict[int, np.ndarray]:
    """Return T_map_keyframe [4, 4] by keyframe, once all keyframes have one."""
    wait_until(lambda: inbox.graph().keys() == inbox.frame_of.keys(), 20, "all placed")
    return inbox.graph()


def is_reported_late(inbox: Heard) -> bool:
    """Return whether `ldo doctor` notes that the labeller is late; this must be no problem."""
    seen = ActorStatus("vlm_labeller", True, inbox.service.update_health()["vlm_labeller"], 1.5)
    assert list(diagnose(seen)) == []
    return any("late" in remark for remark in notes(seen))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_slow_labeller_delays_no_actor_and_its_labels_lie_on_their_regions(
    tmp_path: Path,
) -> None:
    sequence = flat()
    with walk(tmp_path / "alone", sequence) as walker:
        reference = walker.inbox
        for frame in FRAMES:
            walker.send_until_done(frame)
        T_reference = placed_keyframes(reference)
    guide = Guide(sequence, range(len(sequence)), waits=True)
    with serving(guide) as server:
        settings_slow = [f"vlm_labeller.{setting}" for setting in (f"url={server.url}", *PATIENT)]
        settings_slow += ["supervision.step_timeout_s=1500", "service.control_timeout_s=1500"]
        with walk(tmp_path / "slow", sequence, *settings_slow, guide=guide) as walker:
            slow = walker.inbox
            # It receives requests and answers none.
            for frame in FRAMES[:SILENT]:
                walker.send_until_done(frame)
            assert server.requests
            assert slow.answers == []
            wait_until(lambda: is_reported_late(slow), 10, "reported late")
            # It answers single requests while the camera moves.
            for frame in FRAMES[SILENT:]:
                guide.allow(1)
                walker.send_until_done(frame)
            # It answers all requests while the camera stands still.
            guide.allow(1000)
            wait_until(slow.has_all_answers, 30, "all answered")
            T_slow, (map_, names) = placed_keyframes(slow), slow.map()
            frames = slow.input("frame_source", "camera/rgbd"), slow.input("tracker", "frame/rgbd")
            assert slow.fact("mapper", "answers_unknown") == 0
    # Poses.
    assert [pose.frame for pose in slow.poses] == list(FRAMES)
    assert [count.dropped for count in frames] == [0, 0]
    assert {pose.status for pose in slow.poses} == {"OK"}
    assert [odometry(pose) for pose in slow.poses] == [odometry(pose) for pose in reference.poses]
    assert T_slow.keys() == T_reference.keys()
    moved_m = [np.linalg.norm(T_slow[k][:3, 3] - T_reference[k][:3, 3]) for k in T_slow]
    assert max(moved_m) < 0.01, "labelled objects are landmarks and may move keyframes a little"
    # Label results.
    assert slow.late[0] >= LATE
    # Labels in the map.
    named = placed(map_, names, sequence, FRAMES[0], FRAMES[::6])
    assert len(named.names) > 3
    assert named.names <= {answer.label for answer in slow.answers}
    assert named.share > 0.8
