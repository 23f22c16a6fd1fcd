"""Frames of a run: selection from a sequence, reading, and odometry prior."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ldo_service.conversions.frames import (
    raw_frame_to_message,
)
from ldo_service.conversions.poses import pose_to_message
from ldo_service.datasets import find_layout
from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.schemas import CameraRgbd, Message, OdometryPrior

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


def layout_of(source: str) -> str:
    """Return the name of the layout of a source, for users; a source that does not exist has none.

    Raises:
        ConfigError: A layout of another package cannot be loaded.
    """
    path = Path(source).expanduser()
    if source.partition(":")[0] == "synthetic":
        return "a built-in scene"
    layout = find_layout(path)
    return "none" if layout is None else layout.name
