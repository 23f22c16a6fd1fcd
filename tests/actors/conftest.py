"""Actors called without a runtime, and the messages that they publish over the room."""

from collections.abc import Iterable

import pytest

from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.tracker import Tracker
from ldo_service.conversions.frames import keyframe_measurements_message, raw_frame_to_message
from ldo_service.datasets import Sequence
from ldo_service.maps.replica import MapReplica
from ldo_service.schemas import (
    CameraRgbd,
    FrameRgbd,
    Keyframe,
    MapDelta,
    MapSnapshot,
    Message,
    TrackedPose,
)
from tests.actors.loop_walks import DRIFT, FIRST_WALK, LONG_AFTER, SECOND_WALK, keyframes_of


def camera_messages(sequence: Sequence, indices: Iterable[int]) -> list[CameraRgbd]:
    return [raw_frame_to_message(sequence.read(i), compress_depth=False) for i in indices]


def handle_all(actor, messages: Iterable[Message]) -> list:
    """Return all messages that an actor publishes for the given inputs."""
    return [out for message in messages for out in actor.handle(message)]


def without_images(messages: Iterable[Message]) -> list[Message]:
    """Return the messages, with the measurements of each keyframe in place of the keyframe."""
    return [keyframe_measurements_message(m) if isinstance(m, Keyframe) else m for m in messages]


def replicate(messages: Iterable[Message], replica: MapReplica | None = None) -> MapReplica:
    """Apply all deltas and snapshots among the messages to a replica, by default a new one."""
    replica = replica or MapReplica()
    for message in messages:
        if isinstance(message, MapDelta | MapSnapshot):
            replica.apply(message)
    return replica


@pytest.fixture(scope="session")
def frames(room: Sequence) -> list[FrameRgbd]:
    return handle_all(FrameSource(), camera_messages(room, range(40)))


@pytest.fixture(scope="session")
def tracked(frames: list[FrameRgbd]) -> list[TrackedPose | Keyframe]:
    return handle_all(Tracker(), frames)


@pytest.fixture(scope="session")
def keyframes(tracked: list[TrackedPose | Keyframe]) -> list[Keyframe]:
    return [message for message in tracked if isinstance(message, Keyframe)]


@pytest.fixture(scope="session")
def first_walk(room: Sequence) -> list[Keyframe]:
    return keyframes_of(room, FIRST_WALK, 0, 0)


@pytest.fixture(scope="session")
def second_walk(room: Sequence) -> list[Keyframe]:
    """Return keyframes of the path of the first walk, long after it and with drifted odometry."""
    return keyframes_of(room, SECOND_WALK, len(FIRST_WALK), LONG_AFTER, DRIFT)
