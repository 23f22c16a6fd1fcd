"""Sequences of RGB-D frames with optional ground truth."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ldo_service.geometry import Camera, RawFrame, Rectifier, RgbdFrame, Trajectory

# Names of classes, in lower case, that data sets give to pixels without a label.
VOID_NAMES = frozenset({"", "undefined", "unknown", "unlabeled", "unlabelled", "void"})


@dataclass(frozen=True, eq=False, slots=True)
class FrameLabels:
    """Ground-truth labels of the pixels of a frame."""

    class_ids: np.ndarray  # [H, W] uint8, index into the class names of the data set.
    instance_ids: np.ndarray  # [H, W] uint16, one number per object; 0 without an object.


@dataclass(frozen=True, eq=False, slots=True)
class TrueLabels:
    """Ground-truth labels of a sequence."""

    class_names: tuple[str, ...]  # Indexed by class id; classes in VOID_NAMES mean no label.
    # Returns the labels of the frame with an index; raises DataError if they cannot be read.
    frame: Callable[[int], FrameLabels]


@dataclass(frozen=True, slots=True)
class Stream:
    """Stream in a recording, such as a topic of a bag.

    Attributes:
        name: Name of the topic, the track or the file.
        kind: Type of the content.
        messages: Number of messages or images in the stream; None if unknown.
        use: Data that is read from the stream, such as "color"; empty if the stream is unused.
    """

    name: str
    kind: str
    messages: int | None
    use: str


class Sequence(ABC):
    """RGB-D frames of one camera in the order of their stamps.

    `read(i)` returns the frame as the camera delivered it, for a publisher of frames. `sequence[i]`
    returns the rectified frame, for tracking and mapping. Both raise FrameError for a frame that
    cannot be read. Callers skip and count such frames.

    Attributes:
        name: Name of the sequence in tables of results.
        raw_camera: Intrinsics with lens distortion.
        stamps_ns: Stamps, [len] int64, ascending.
        depth_offsets_ns: Stamps of the depth images minus `stamps_ns`, [len] int64; None if depth
            has no stamps of its own.
        registration: "source" if depth was already registered to color, "reader" if `read`
            registers it, "none" if it is not registered.
        streams: Streams of the recording, used or not; empty if it has only color and depth.
    """

    depth_offsets_ns: np.ndarray | None = None
    registration: Literal["source", "reader", "none"] = "source"
    streams: tuple[Stream, ...] = ()

    def __init__(self, name: str, raw_camera: Camera, stamps_ns: np.ndarray) -> None:
        self.name = name
        self.raw_camera = raw_camera
        self.stamps_ns = stamps_ns
        self._rectifier = Rectifier()

    @abstractmethod
    def read(self, index: int) -> RawFrame:
        """Return a frame as the camera delivered it.

        Args:
            index: Number of the frame, 0..len-1.

        Raises:
            FrameError: The frame cannot be read.
        """

    @abstractmethod
    def truth(self) -> Trajectory | None:
        """Return the ground-truth `T_world_camera` in the data set's world frame, or None."""

    def odometry(self) -> Trajectory | None:
        """Return the odometry that was recorded with the frames, `T_odom_camera`, or None.

        It is an estimate, such as that of a phone or of wheels, and no ground truth. Its stamps use
        the clock of the frames. Its poses are those of the color camera.

        Raises:
            DataError: The recorded poses are invalid.
        """
        return None

    def true_labels(self) -> TrueLabels | None:
        """Return the ground-truth labels, or None if the sequence has none.

        Raises:
            DataError: A file of the labels is invalid.
        """
        return None

    @property
    def camera(self) -> Camera:
        """Intrinsics of the rectified frames."""
        return self.raw_camera.rectified()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: int) -> RgbdFrame:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has no frame {index}, only frames 0 to {len(self) - 1}.")
        return self._rectifier(self.read(index))

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))


class Cached(Sequence):
    """Sequence that keeps each frame in memory after its first read. It suits short sequences."""

    def __init__(self, sequence: Sequence) -> None:
        super().__init__(sequence.name, sequence.raw_camera, sequence.stamps_ns)
        self.depth_offsets_ns = sequence.depth_offsets_ns
        self.registration = sequence.registration
        self.streams = sequence.streams
        self._sequence = sequence
        self._frames: dict[int, RawFrame] = {}

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        if index not in self._frames:
            self._frames[index] = self._sequence.read(index)
        return self._frames[index]

    def truth(self) -> Trajectory | None:
        """Return the ground-truth trajectory, or None."""
        return self._sequence.truth()

    def odometry(self) -> Trajectory | None:
        """Return the odometry that was recorded with the frames, or None."""
        return self._sequence.odometry()

    def true_labels(self) -> TrueLabels | None:
        """Return the ground-truth labels, or None."""
        return self._sequence.true_labels()


class OdometryAsTruth(Sequence):
    """Sequence whose recorded odometry is returned as the ground truth."""

    def __init__(self, sequence: Sequence) -> None:
        super().__init__(sequence.name, sequence.raw_camera, sequence.stamps_ns)
        self.depth_offsets_ns = sequence.depth_offsets_ns
        self.registration = sequence.registration
        self.streams = sequence.streams
        self._sequence = sequence

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        return self._sequence.read(index)

    def truth(self) -> Trajectory | None:
        """Return the odometry that was recorded with the frames, or None."""
        return self._sequence.odometry()

    def true_labels(self) -> TrueLabels | None:
        """Return the ground-truth labels, or None."""
        return self._sequence.true_labels()
