"""A recording as a data set: what the frame source took, frame by frame."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from ldo_service.actors.frame_source import FrameSource, FrameSourceConfig, joined
from ldo_service.datasets import SequenceOptions, open_sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.geometry.stamps import Pairing
from ldo_service.runtime.mcap_index import Place
from ldo_service.runtime.recording import JournalFile, recorded_actors
from ldo_service.schemas import CameraColor, CameraDepth, CameraRgbd, Message, decode
from ldo_service.schemas.message import LAST_INTEGER
from ldo_service.schemas.topics import CAMERA_COLOR, CAMERA_DEPTH, CAMERA_RGBD
from ldo_service.wire import camera_of, raw_frame_of

M = TypeVar("M", bound=Message)


def open_source(source: str, options: SequenceOptions | None = None) -> Sequence:
    """The frames of a recording, or of what `open_sequence` knows. Raises what it raises."""
    folder = Path(source).expanduser()
    return RecordingSequence(folder) if recorded_actors(folder) else open_sequence(source, options)


@dataclass(frozen=True, slots=True)
class Stored:
    """A message on the disk."""

    file: JournalFile
    place: Place

    @property
    def stamp_ns(self) -> int:
        return self.place.stamp_ns

    def message(self, kind: type[M], index: int) -> M:
        try:
            return decode(self.file.body(self.place), kind)
        except msgspec.DecodeError as error:
            raise FrameError(f"{self.file.path}, frame {index}: {error}.") from error


@dataclass(frozen=True, slots=True)
class StoredFrame:
    """depth: None where colour is a whole frame."""

    color: Stored
    depth: Stored | None = None

    def message(self, index: int) -> CameraRgbd | CameraColor:
        return self.color.message(CameraColor if self.depth else CameraRgbd, index)

    def read(self, index: int) -> RawFrame:
        message = self.message(index)
        if isinstance(message, CameraRgbd):
            return raw_frame_of(message, index)
        assert self.depth is not None
        return replace(joined(message, self.depth.message(CameraDepth, index)), index=index)


class RecordingSequence(Sequence):
    """Halves are paired as the service pairs them by default.

    Frames whose stamp is not after the one before are left out: of a camera that started again,
    the first session is the data set.
    """

    def __init__(self, folder: Path) -> None:
        paths = recorded_actors(folder).get(FrameSource.name, [])
        self._frames: list[StoredFrame] = []
        files = map(JournalFile, paths)
        for frame in _frames(Stored(file, place) for file in files for place in file.messages):
            last_ns = self._frames[-1].color.stamp_ns if self._frames else -1
            if last_ns < frame.color.stamp_ns <= LAST_INTEGER:
                self._frames.append(frame)
        if not self._frames:
            raise DataError(
                f"{folder} holds no {CAMERA_RGBD.name}, nor pairs of {CAMERA_COLOR.name} and "
                f"{CAMERA_DEPTH.name}: was frame_source recorded?"
            )
        stamps_ns = np.array([frame.color.stamp_ns for frame in self._frames], np.int64)
        super().__init__(folder.resolve().name, self._camera(folder), stamps_ns)

    def _camera(self, folder: Path) -> Camera:
        """That of the first frame that can be read."""
        for index, frame in enumerate(self._frames):
            with suppress(FrameError):
                return camera_of(frame.message(index).camera)
        raise DataError(f"{folder}: none of its {len(self._frames)} frames can be read.")

    def read(self, index: int) -> RawFrame:
        return self._frames[index].read(index)

    def truth(self) -> Trajectory | None:
        return None  # nobody told the robot


def _frames(messages: Iterator[Stored]) -> Iterator[StoredFrame]:
    config = FrameSourceConfig()
    skew_ns = round(config.max_skew_s * 1e9)
    pairing: Pairing[Stored, Stored] = Pairing(skew_ns, config.pair_buffer)
    for stored in messages:
        try:
            match stored.place.topic:
                case CAMERA_RGBD.name:
                    yield StoredFrame(stored)
                case CAMERA_COLOR.name:
                    yield from (StoredFrame(*pair) for pair in pairing.add_a(stored))
                case CAMERA_DEPTH.name:
                    yield from (StoredFrame(*pair) for pair in pairing.add_b(stored))
        except FrameError:  # its stamp goes back: taken again after a crash
            continue
