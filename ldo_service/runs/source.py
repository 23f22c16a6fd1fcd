"""Frames of a run: selection from a sequence or a recording, reading, and odometry prior."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from ldo_service.actors.frame_source import FrameSource, FrameSourceConfig, join_halves
from ldo_service.conversions.frames import (
    camera_from_message,
    raw_frame_from_message,
    raw_frame_to_message,
)
from ldo_service.conversions.poses import pose_to_message
from ldo_service.datasets import SequenceOptions, find_layout, open_sequence
from ldo_service.datasets.bag_file import is_bag
from ldo_service.datasets.files import name_of
from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.geometry.stamps import StreamPairer
from ldo_service.recordings.mcap_file import MessageLocation
from ldo_service.recordings.recording import JournalFile, recorded_actors
from ldo_service.schemas import CameraColor, CameraDepth, CameraRgbd, Message, OdometryPrior, decode
from ldo_service.schemas.message import LAST_INTEGER
from ldo_service.schemas.topics import CAMERA_COLOR, CAMERA_DEPTH, CAMERA_RGBD

# Frames that are decoded in advance: one is being decoded, one is queued, and one is in reserve.
READ_AHEAD = 3
MAX_NAMED = 5  # Number of bad frames that are reported one by one.

M = TypeVar("M", bound=Message)


Warn = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Selection:
    """Selection of frames of a sequence."""

    stride: int = 1
    max_frames: int | None = None  # Unlimited if None.

    def __post_init__(self) -> None:
        if self.stride < 1 or (self.max_frames is not None and self.max_frames < 1):
            raise ConfigError(
                f"--stride {self.stride} and --max-frames {self.max_frames}: both must be at least "
                "1."
            )

    def indices(self, sequence: Sequence) -> range:
        """Return the indices of the selected frames.

        Raises:
            DataError: The sequence has no frames.
        """
        chosen = range(0, len(sequence), self.stride)[: self.max_frames]
        if not chosen:
            raise DataError(f"{sequence.name} has no frames. Give another source.")
        return chosen


class FrameReader:
    """Reader of frames as camera messages.

    A thread reads frames in advance. Frames that cannot be read are skipped and counted.
    """

    def __init__(self, sequence: Sequence, indices: range, warn: Warn) -> None:
        self._sequence, self._indices, self._warn = sequence, indices, warn
        self.rejected = 0

    def __iter__(self) -> Iterator[CameraRgbd]:
        with ThreadPoolExecutor(1, "reader") as thread:
            ahead = [thread.submit(self._read, i) for i in self._indices[:READ_AHEAD]]
            for position in range(len(self._indices)):
                message = ahead.pop(0).result()
                following = position + READ_AHEAD
                if following < len(self._indices):
                    ahead.append(thread.submit(self._read, self._indices[following]))
                if message is not None:
                    yield message

    def _read(self, index: int) -> CameraRgbd | None:
        try:
            return raw_frame_to_message(self._sequence.read(index), compress_depth=False)
        except FrameError as error:
            self.rejected += 1
            if self.rejected < MAX_NAMED:
                self._warn(f"{error} The frame is skipped.")
            elif self.rejected == MAX_NAMED:
                self._warn(f"{error} The frame is skipped; further bad frames are only counted.")
            return None


def interleave_prior(
    frames: Iterable[CameraRgbd], prior: Trajectory | None
) -> Iterator[tuple[Message, ...]]:
    """Yield each frame with the poses of the odometry prior that precede it.

    These are the poses that a live service would receive before the frame: all remaining poses, up
    to and including the first one that is not older than the frame.

    Args:
        frames: The frames.
        prior: Poses T_odom_base of another odometry; None if there is none.

    Yields:
        For each frame: the messages of the poses, then the frame.
    """
    poses = iter(() if prior is None else map(_prior_message, prior.stamps_s, prior.T_world_camera))
    last_ns = -1
    for frame in frames:
        news: list[Message] = []
        while last_ns < frame.stamp_ns and (pose := next(poses, None)) is not None:
            news.append(pose)
            last_ns = pose.stamp_ns
        yield (*news, frame)


def _prior_message(stamp_s: float, T_odom_base: np.ndarray) -> OdometryPrior:
    return OdometryPrior(stamp_ns=round(1e9 * stamp_s), T_prior_base=pose_to_message(T_odom_base))


def require_overlap(prior: Trajectory, sequence: Sequence, indices: range) -> None:
    """Check that the odometry prior has a pose between the first and the last selected frame.

    Raises:
        DataError: The prior has no such pose.
    """
    first_s, last_s = (1e-9 * float(sequence.stamps_ns[indices[end]]) for end in (0, -1))
    if not np.any((prior.stamps_s >= first_s) & (prior.stamps_s <= last_s)):
        raise DataError(
            f"the odometry prior has no pose between {first_s:.3f} s and {last_s:.3f} s, the first "
            f"and the last frame of {sequence.name}. The stamps of prior and frames must come from "
            "the same clock."
        )


def open_source(source: str, options: SequenceOptions | None = None) -> Sequence:
    """Open a recording, or a data set that `open_sequence` supports, as a sequence of frames.

    Raises:
        DataError: The source cannot be read.
    """
    folder = Path(source).expanduser()
    return RecordingSequence(folder) if _is_recording(folder) else open_sequence(source, options)


def layout_of(source: str) -> str:
    """Return the name of the layout of a source, for users; a source that does not exist has none.

    Raises:
        ConfigError: A layout of another package cannot be loaded.
    """
    path = Path(source).expanduser()
    if source.partition(":")[0] == "synthetic":
        return "a built-in scene"
    if _is_recording(path):
        return "a recording of `ldo record`"
    layout = find_layout(path)
    return "none" if layout is None else layout.name


def _is_recording(folder: Path) -> bool:
    """Return whether a folder is a recording, and no bag of ROS 2 with files of similar names."""
    return bool(recorded_actors(folder)) and not is_bag(folder)


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
                f"{self.file.path}, frame {index} cannot be decoded: {error}."
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
                f"{folder} holds no {CAMERA_RGBD.name}, nor pairs of {CAMERA_COLOR.name} and "
                f"{CAMERA_DEPTH.name}. Check that frame_source was recorded."
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
            # The stamp is not later than that of the previous image: the image was received
            # again after a crash.
            continue
