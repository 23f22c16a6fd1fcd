"""Which frames of a sequence a run takes, reading them ahead, and what another odometry says."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.schemas import CameraRgbd, Message, OdometryPrior
from ldo_service.wire import camera_rgbd_message, pose_message

READ_AHEAD = 3  # frames decoded before they are needed: one decoding, one waiting, one to spare

Warn = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Selection:
    """Which frames of a sequence."""

    stride: int = 1
    max_frames: int | None = None  # None: all

    def __post_init__(self) -> None:
        if self.stride < 1 or (self.max_frames is not None and self.max_frames < 1):
            raise ConfigError(
                f"a stride of {self.stride} and at most {self.max_frames} frames: both must be at "
                "least 1."
            )

    def indices(self, sequence: Sequence) -> range:
        """Raises DataError when nothing is left."""
        chosen = range(0, len(sequence), self.stride)[: self.max_frames]
        if not chosen:
            raise DataError(f"{sequence.name}: the selection leaves no frame to run on.")
        return chosen


class Reader:
    """Frames as camera messages, read ahead in a thread; bad ones are counted and left out."""

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
            return camera_rgbd_message(self._sequence.read(index), compress_depth=False)
        except FrameError as error:
            if self.rejected == 0:
                self._warn(f"{error} It is left out; further bad frames are only counted.")
            self.rejected += 1
            return None


def with_prior(
    frames: Iterable[CameraRgbd], prior: Trajectory | None
) -> Iterator[tuple[Message, ...]]:
    """Each frame behind the poses up to the first that is not before it, as they come live."""
    poses = iter(() if prior is None else map(_prior_message, prior.stamps_s, prior.T_world_camera))
    told_ns = -1
    for frame in frames:
        news: list[Message] = []
        while told_ns < frame.stamp_ns and (pose := next(poses, None)) is not None:
            news.append(pose)
            told_ns = pose.stamp_ns
        yield (*news, frame)


def _prior_message(stamp_s: float, T_odom_base: np.ndarray) -> OdometryPrior:
    return OdometryPrior(stamp_ns=round(1e9 * stamp_s), T_odom_base=pose_message(T_odom_base))


def require_overlap(prior: Trajectory, sequence: Sequence, indices: range) -> None:
    """Raise DataError when no pose is from the time of the frames."""
    first_s, last_s = (1e-9 * float(sequence.stamps_ns[indices[end]]) for end in (0, -1))
    if not np.any((prior.stamps_s >= first_s) & (prior.stamps_s <= last_s)):
        raise DataError(
            f"the prior has no pose between {first_s:.3f} s and {last_s:.3f} s, the stamps of "
            f"{sequence.name}. Give it the stamps of the clock that the frames have."
        )
