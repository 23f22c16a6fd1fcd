"""What actors say, played without a runtime: `list(actor.handle(message))`."""

from collections.abc import Iterable, Iterator

import pytest

from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.tracker import Tracker
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import Sequence
from ldo_service.schemas import CameraRgbd, FrameRgbd, Keyframe, Message, TrackedPose


def camera_messages(sequence: Sequence, indices: Iterable[int]) -> list[CameraRgbd]:
    return [raw_frame_to_message(sequence.read(i), compress_depth=False) for i in indices]


def handled(actor, messages: Iterable[Message]) -> Iterator[Message]:
    for message in messages:
        yield from actor.handle(message)


@pytest.fixture(scope="session")
def frames(room: Sequence) -> list[FrameRgbd]:
    return list(handled(FrameSource(), camera_messages(room, range(40))))


@pytest.fixture(scope="session")
def tracked(frames: list[FrameRgbd]) -> list[TrackedPose | Keyframe]:
    return list(handled(Tracker(), frames))


@pytest.fixture(scope="session")
def keyframes(tracked: list[TrackedPose | Keyframe]) -> list[Keyframe]:
    return [message for message in tracked if isinstance(message, Keyframe)]
