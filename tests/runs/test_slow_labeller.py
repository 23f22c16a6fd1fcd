"""A labeller slower than any: who must not wait does not, and its answers lie where it was asked.

Lateness is counted in keyframes: nothing is said until so many were made.
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
SILENT = 20  # of these frames, before the first answer
LATE = 5  # keyframes, at least, of that answer
# A frame that nobody took, and the first while not all are there for its keyframe
LOST_AFTER_S = 5.0
LIGHT = ("detector.model=demo", "mapper.iterations=2", "supervision.heartbeat_s=0.1")
PATIENT = (  # it may take for ever
    *("http.timeout_s=600", "http.deadline_s=600"),
    *("http.max_requests_per_minute=1000000", "http.max_views=1"),
)


class Walk:
    """Sends frames one by one, the next when the last has its pose and, if it is a keyframe, is
    mapped. So all of them are taken, on any machine, unless somebody waits for the labeller."""

    def __init__(self, sequence: FlatSequence, heard: Heard) -> None:
        self._sequence, self.heard = sequence, heard
        self._sent = self._lost = 0

    def go(self, frame: int) -> None:
        message = raw_frame_to_message(self._sequence.read(frame))
        self._send(message)
        until_s = time.monotonic() + 20 * PATIENCE
        while not self._is_done_soon(frame):
            assert time.monotonic() < until_s, f"frame {frame} is not tracked and mapped"
            self.heard.ask_again()
            if not self.heard.poses:
                message = msgspec.structs.replace(message, stamp_ns=message.stamp_ns + 1)
                self._send(message)
            elif self._sent - self._handled() > self._lost:
                self._lost += 1
                self._send(message)

    def _send(self, message: CameraRgbd) -> None:
        self.heard.service.client.send(message)
        self._sent += 1

    def _handled(self) -> int:
        return self.heard.input("tracker", "frame/rgbd").delivered

    def _is_done_soon(self, frame: int) -> bool:
        until_s = time.monotonic() + LOST_AFTER_S
        while time.monotonic() < until_s:
            if self._is_done(frame):
                return True
            time.sleep(0.02)
        return False

    def _is_done(self, frame: int) -> bool:
        heard = self.heard
        heard.listen()
        is_tracked = bool(heard.poses) and heard.poses[-1].frame == frame
        return is_tracked and heard.fact("mapper", "keyframes") > max(heard.frame_of)


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
    """All that a pose says of it, to the bit; the graph has no part in it."""
    where = pose.T_odom_camera, pose.T_reference_camera, pose.covariance
    return pose.frame, pose.status, pose.keyframe, pose.reference, *where


def placed_keyframes(heard: Heard) -> dict[int, np.ndarray]:
    """T_map_keyframe [4, 4] by keyframe, of all."""
    wait_until(lambda: heard.graph().keys() == heard.frame_of.keys(), 20, "all placed")
    return heard.graph()


def is_called_late(heard: Heard) -> bool:
    """By `ldo doctor`, which takes it for no trouble."""
    seen = ActorStatus("vlm_labeller", True, heard.service.update_health()["vlm_labeller"], 1.5)
    assert list(diagnose(seen)) == []
    return any("late" in remark for remark in notes(seen))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_nobody_waits_for_a_slow_labeller_and_its_answers_lie_where_it_was_asked(
    tmp_path: Path,
) -> None:
    sequence = flat()
    with walk(tmp_path / "alone", sequence) as walker:
        alone = walker.heard
        for frame in FRAMES:
            walker.go(frame)
        T_alone = placed_keyframes(alone)
    guide = Guide(sequence, range(len(sequence)), waits=True)
    with serving(guide) as server:
        use = [f"vlm_labeller.{setting}" for setting in (f"url={server.url}", *PATIENT)]
        use += ["supervision.step_timeout_s=1500", "service.control_timeout_s=1500"]
        with walk(tmp_path / "slow", sequence, *use, guide=guide) as walker:
            slow = walker.heard
            # it is asked, and says nothing
            for frame in FRAMES[:SILENT]:
                walker.go(frame)
            assert server.requests
            assert slow.answers == []
            wait_until(lambda: is_called_late(slow), 10, "called late")
            # it says something now and then, while the camera goes on
            for frame in FRAMES[SILENT:]:
                guide.allow(1)
                walker.go(frame)
            # it says all there is to say, while the camera stands still
            guide.allow(1000)
            wait_until(slow.has_all_answers, 30, "all answered")
            T_slow, (map_, names) = placed_keyframes(slow), slow.map()
            frames = slow.input("frame_source", "camera/rgbd"), slow.input("tracker", "frame/rgbd")
            assert slow.fact("mapper", "answers_unknown") == 0
    # poses
    assert [pose.frame for pose in slow.poses] == list(FRAMES)
    assert [count.dropped for count in frames] == [0, 0]
    assert {pose.status for pose in slow.poses} == {"OK"}
    assert [odometry(pose) for pose in slow.poses] == [odometry(pose) for pose in alone.poses]
    assert T_slow.keys() == T_alone.keys()
    moved_m = [np.linalg.norm(T_slow[k][:3, 3] - T_alone[k][:3, 3]) for k in T_slow]
    assert max(moved_m) < 0.01, "what has a name is a landmark"
    # answers
    assert slow.late[0] >= LATE
    # where they lie
    named = placed(map_, names, sequence, FRAMES[0], FRAMES[::6])
    assert len(named.names) > 3
    assert named.names <= {answer.label for answer in slow.answers}
    assert named.share > 0.8
