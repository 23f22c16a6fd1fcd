"""Calls of the tracker actor into `ldo_service.tracking`: one per frame."""

import sys
from collections.abc import Sequence as Many
from pathlib import Path
from types import FrameType

import pytest

from ldo_service.actors.tracker import Tracker, TrackerConfig
from ldo_service.runtime.actor import FlowStatus
from ldo_service.schemas import FrameRgbd, Keyframe, Message, OdometryPrior, TrackedPose
from ldo_service.schemas.pose import IDENTITY
from ldo_service.schemas.topics import KEYFRAME_NEW

ACTOR, TRACKING = "ldo_service.actors.tracker", "ldo_service.tracking."


def calls_into_tracking(tracker: Tracker, message: Message) -> tuple[list[str], list[Message]]:
    """Return the functions of tracking that the actor's module calls, and its messages.

    Calls by `ldo_service.conversions` do not count: they read a result. Constructors would count,
    and the actor needs none.
    """
    calls: list[str] = []

    def record_call(frame: FrameType, event: str, _: object) -> None:
        caller = frame.f_back
        if event != "call" or caller is None or caller.f_globals.get("__name__") != ACTOR:
            return
        if frame.f_globals.get("__name__", "").startswith(TRACKING):
            calls.append(frame.f_code.co_qualname)

    sys.setprofile(record_call)
    try:
        made = list(tracker.handle(message))
    finally:
        sys.setprofile(None)
    return calls, made


def kind_of(made: Many[Message], tracker: Tracker) -> str:
    """Return the kind of result that a frame gave."""
    keyframes = [message for message in made if isinstance(message, Keyframe)]
    if not made:
        return "nothing"
    if not keyframes:
        return "pose"
    is_reference = tracker._odometry.reference == keyframes[0].keyframe
    return "reference keyframe" if is_reference else "mapping keyframe"


def test_each_frame_enters_tracking_once(frames: Many[FrameRgbd]) -> None:
    tracker, kinds = Tracker(), set()
    for frame in frames[:16]:
        calls, made = calls_into_tracking(tracker, frame)
        kinds.add(kind_of(made, tracker))
        assert calls == ["Odometry.process"]
    assert kinds == {"pose", "reference keyframe", "mapping keyframe"}


def test_a_frame_that_may_not_be_mapped_enters_tracking_once(frames: Many[FrameRgbd]) -> None:
    tracker = Tracker()
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    assert calls_into_tracking(tracker, frames[0]) == (["Odometry.process"], [])


def test_a_frame_with_a_prior_enters_tracking_once(frames: Many[FrameRgbd]) -> None:
    tracker = Tracker()
    for frame in frames[:3]:
        list(tracker.handle(OdometryPrior(stamp_ns=frame.stamp_ns, T_prior_base=IDENTITY)))
        calls, _ = calls_into_tracking(tracker, frame)
        assert calls == ["Odometry.process"]
    assert tracker.metrics()["frames_with_prior"] == 3


@pytest.mark.parametrize("frame", [0, 5])
def test_a_frame_in_a_finished_map_enters_tracking_once(
    frames: Many[FrameRgbd], finished_run: Path, frame: int
) -> None:
    tracker = Tracker(TrackerConfig(localize=str(finished_run)))
    calls, (pose,) = calls_into_tracking(tracker, frames[frame])
    assert calls == ["Localizer.process"]
    assert isinstance(pose, TrackedPose)
