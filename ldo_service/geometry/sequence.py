"""Sequences of RGB-D frames, and the ground truth that may come with them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera, RawFrame, Rectifier, RgbdFrame, Trajectory

VOID_NAMES = frozenset({"", "undefined", "unknown", "unlabeled", "unlabelled", "void"})


@dataclass(frozen=True, eq=False, slots=True)
class FrameLabels:
    """What each pixel shows.

    class_ids      [H, W] uint8, index into the class names of the data set
    instance_ids   [H, W] uint16, one number for each object; 0 for what is none
    """

    class_ids: np.ndarray
    instance_ids: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class TrueLabels:
    """class_names  by class id; pixels of those among VOID_NAMES may be anything
    frame        the labels of frame `index`, on its pixels; raises FrameError"""

    class_names: tuple[str, ...]
    frame: Callable[[int], FrameLabels]


class Sequence(ABC):
    """RGB-D frames in order of their stamps, from one camera.

    `read(i)` gives what the camera delivered, for a publisher; `sequence[i]` the rectified frame,
    for the numerics. Both raise FrameError for a frame that cannot be read: skip and count it.

    name        what to call it in tables
    raw_camera  intrinsics with lens distortion
    stamps_ns   [len] int64, ascending
    """

    def __init__(self, name: str, raw_camera: Camera, stamps_ns: np.ndarray) -> None:
        self.name = name
        self.raw_camera = raw_camera
        self.stamps_ns = stamps_ns
        self._rectifier = Rectifier()

    @abstractmethod
    def read(self, index: int) -> RawFrame:
        """Frame `index` in 0..len-1 as the camera delivered it. Raises FrameError."""

    @abstractmethod
    def truth(self) -> Trajectory | None:
        """True `T_world_camera`, in a world of the data set's choice; None where unknown."""

    def true_labels(self) -> TrueLabels | None:
        """What the pixels show; None where unknown. Raises DataError for files that are broken."""
        return None

    @property
    def camera(self) -> Camera:
        """Intrinsics of the rectified frames."""
        return self.raw_camera.rectified()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: int) -> RgbdFrame:
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)} in {self.name}")
        return self._rectifier(self.read(index))

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))


class Cached(Sequence):
    """A sequence whose frames are read once and then kept in memory: for short ones."""

    def __init__(self, sequence: Sequence) -> None:
        super().__init__(sequence.name, sequence.raw_camera, sequence.stamps_ns)
        self._sequence = sequence
        self._frames: dict[int, RawFrame] = {}

    def read(self, index: int) -> RawFrame:
        if index not in self._frames:
            self._frames[index] = self._sequence.read(index)
        return self._frames[index]

    def truth(self) -> Trajectory | None:
        return self._sequence.truth()

    def true_labels(self) -> TrueLabels | None:
        return self._sequence.true_labels()
