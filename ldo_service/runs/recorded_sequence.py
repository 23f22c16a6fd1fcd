"""Sequence of the camera frames in a recording that `ldo record` has made."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from ldo_service.actors.frame_source import FrameSource, FrameSourceConfig, join_halves
from ldo_service.actors.topology import GRAPH
from ldo_service.conversions.frames import camera_from_message, raw_frame_from_message
from ldo_service.datasets import Layout
from ldo_service.datasets.files import name_of
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.geometry.stamps import StreamPairer
from ldo_service.recordings.mcap_file import MessageLocation
from ldo_service.recordings.recording import JournalFile, recorded_actors
from ldo_service.schemas import CameraColor, CameraDepth, CameraRgbd, Message, decode
from ldo_service.schemas.message import LAST_INTEGER
from ldo_service.schemas.topics import CAMERA_COLOR, CAMERA_DEPTH, CAMERA_RGBD

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """Message in a recording."""

    file: JournalFile
    place: MessageLocation

    @property
    def stamp_ns(self) -> int:
        return self.place.stamp_ns

    def message(self, kind: type[M], index: int) -> M:
        """Return the decoded message.

        Raises:
            FrameError: The message cannot be decoded.
        """
        try:
            return decode(self.file.body(self.place), kind)
        except msgspec.DecodeError as error:
            raise FrameError(
                f"frame {index} of {self.file.path} cannot be decoded: {error}. Copy the recording "
                "again."
            ) from error


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """Frame in a recording.

    Attributes:
        color: Message with the color image, or with both images.
        depth: Message with the depth image; None if `color` contains both images.
    """

    color: RecordedMessage
    depth: RecordedMessage | None = None

    def message(self, index: int) -> CameraRgbd | CameraColor:
        return self.color.message(CameraColor if self.depth else CameraRgbd, index)

    def read(self, index: int) -> RawFrame:
        message = self.message(index)
        if isinstance(message, CameraRgbd):
            return raw_frame_from_message(message, index)
        assert self.depth is not None
        return replace(join_halves(message, self.depth.message(CameraDepth, index)), index=index)


class RecordingSequence(Sequence):
    """Recording as a sequence of frames.

    Color and depth images are paired as in the service with default settings. Frames whose stamp is
    not later than that of the previous frame are skipped. If the camera was restarted during the
    recording, only the frames before the restart are used.
    """

    def __init__(self, folder: Path) -> None:
        paths = recorded_actors(folder).get(FrameSource.name, [])
        self._frames: list[RecordedFrame] = []
        files = map(JournalFile, paths)
        for frame in _frames(
            RecordedMessage(file, place) for file in files for place in file.messages
        ):
            last_ns = self._frames[-1].color.stamp_ns if self._frames else -1
            if last_ns < frame.color.stamp_ns <= LAST_INTEGER:
                self._frames.append(frame)
        if not self._frames:
            raise DataError(
                f"{folder} holds no {CAMERA_RGBD.name} messages, and no pairs of "
                f"{CAMERA_COLOR.name} and {CAMERA_DEPTH.name} messages. Check that the actor "
                "frame_source was recorded."
            )
        stamps_ns = np.array([frame.color.stamp_ns for frame in self._frames], np.int64)
        super().__init__(name_of(folder), self._camera(folder), stamps_ns)
        if all(frame.depth for frame in self._frames):
            depth_stamps_ns = [frame.depth.stamp_ns for frame in self._frames if frame.depth]
            self.depth_offsets_ns = np.array(depth_stamps_ns, np.int64) - stamps_ns
            self.registration = "reader"

    def _camera(self, folder: Path) -> Camera:
        """Return the camera of the first frame that can be read."""
        for index, frame in enumerate(self._frames):
            with suppress(FrameError):
                return camera_from_message(frame.message(index).camera)
        raise DataError(
            f"{folder}: none of its {len(self._frames)} frames can be read. Record again."
        )

    def read(self, index: int) -> RawFrame:
        return self._frames[index].read(index)

    def truth(self) -> Trajectory | None:
        return None  # A recording has no ground truth.


def _frames(messages: Iterator[RecordedMessage]) -> Iterator[RecordedFrame]:
    config = FrameSourceConfig()
    skew_ns = round(config.max_skew_s * 1e9)
    pairing: StreamPairer[RecordedMessage, RecordedMessage] = StreamPairer(
        skew_ns, config.pair_buffer
    )
    for stored in messages:
        try:
            match stored.place.topic:
                case CAMERA_RGBD.name:
                    yield RecordedFrame(stored)
                case CAMERA_COLOR.name:
                    yield from (RecordedFrame(*pair) for pair in pairing.add_a(stored))
                case CAMERA_DEPTH.name:
                    yield from (RecordedFrame(*pair) for pair in pairing.add_b(stored))
        except FrameError:
            # An image was received again after a crash if its stamp is not later than the
            # stamp of the previous image.
            continue


def _is_recording(path: Path) -> bool:
    """Return whether a folder is a recording, which has .mcap files of actors.

    Other .mcap files are bags of ROS.
    """
    return any(spec.name in recorded_actors(path) for spec in GRAPH)


# Registered as an entry point of the group `ldo.sequences`, because `datasets` may not import the
# package of recordings.
LAYOUT = Layout(
    "a recording of `ldo record`",
    "frame_source.mcap",
    _is_recording,
    lambda path, _options: RecordingSequence(path),
)
