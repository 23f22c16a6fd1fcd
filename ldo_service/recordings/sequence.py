"""A recording as a data set: what the frame source took, frame by frame."""

from pathlib import Path

import msgspec
import numpy as np

from ldo_service.actors.frame_source import FrameSource
from ldo_service.datasets import Sequence, SequenceOptions, open_sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import RawFrame, Trajectory
from ldo_service.runtime.mcap_index import Place
from ldo_service.runtime.recording import JournalFile, recorded_actors
from ldo_service.schemas import CameraRgbd, decode
from ldo_service.schemas.message import LAST_INTEGER
from ldo_service.schemas.topics import CAMERA_RGBD
from ldo_service.wire import camera_of, raw_frame_of


def open_source(source: str, options: SequenceOptions | None = None) -> Sequence:
    """The frames of a recording, or of what `open_sequence` knows. Raises what it raises."""
    folder = Path(source).expanduser()
    return RecordingSequence(folder) if recorded_actors(folder) else open_sequence(source, options)


class RecordingSequence(Sequence):
    """Frames whose stamp is not after the one before are left out: of a camera that started again,
    the first session is the data set."""

    def __init__(self, folder: Path) -> None:
        paths = recorded_actors(folder).get(FrameSource.name, [])
        self._frames: list[tuple[JournalFile, Place]] = []
        for file in map(JournalFile, paths):
            for place in file.messages:
                last_ns = self._frames[-1][1].stamp_ns if self._frames else -1
                is_later = last_ns < place.stamp_ns <= LAST_INTEGER
                if place.topic == CAMERA_RGBD.name and is_later:
                    self._frames.append((file, place))
        if not self._frames:
            raise DataError(f"{folder} holds no {CAMERA_RGBD.name}: was frame_source recorded?")
        stamps_ns = np.array([place.stamp_ns for _, place in self._frames], np.int64)
        super().__init__(folder.resolve().name, camera_of(self._message(0).camera), stamps_ns)

    def _message(self, index: int) -> CameraRgbd:
        file, place = self._frames[index]
        try:
            return decode(file.body(place), CameraRgbd)
        except msgspec.DecodeError as error:
            raise FrameError(f"{file.path}, frame {index}: {error}.") from error

    def read(self, index: int) -> RawFrame:
        return raw_frame_of(self._message(index), index)

    def truth(self) -> Trajectory | None:
        return None  # nobody told the robot
