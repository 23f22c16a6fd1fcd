"""Frames of a run: selection from a sequence, reading, and odometry prior."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.config import Config, actor_parameters
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.conversions.poses import pose_to_message
from ldo_service.datasets import find_layout
from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry import Trajectory, se3
from ldo_service.geometry.sequence import Sequence
from ldo_service.schemas import CameraRgbd, Message, OdometryPrior

# Frames that are decoded in advance: one is being decoded, one is queued, and one is in reserve.
READ_AHEAD = 3
MAX_NAMED = 5  # Number of bad frames that are reported one by one.

Warn = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Selection:
    """Selection of frames of a sequence."""

    stride: int = 1  # Every `stride`-th frame is selected.
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
    """Reader that yields the selected frames of a sequence as camera messages.

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


def recorded_prior(
    sequence: Sequence, indices: range, config: Config, warn: Warn
) -> Trajectory | None:
    """Return the recorded odometry of a sequence: poses T_odom_base, or None.

    The result is None if the sequence has no odometry at the time of the selected frames. The user
    is then warned.

    Args:
        sequence: The sequence.
        indices: Indices of the selected frames.
        config: Configuration, with the pose of the camera on the base.
        warn: Function that receives warnings for the user.

    Raises:
        DataError: The recorded odometry cannot be read.
    """
    camera = sequence.odometry()
    if camera is None or not _overlaps(camera, sequence, indices):
        warn(
            f"{sequence.name} has no odometry at the time of its frames, so --recorded-odometry "
            "has no effect; no action needed."
        )
        return None
    T_camera_base = se3.inverse(T_base_camera(config))
    return Trajectory(camera.stamps_s, camera.T_world_camera @ T_camera_base)


def T_base_camera(config: Config) -> np.ndarray:
    """Return the configured pose of the camera on the base of the robot, [4, 4]."""
    return actor_parameters(config).tracker.T_base_camera.matrix()


def interleave_prior(
    frames: Iterable[CameraRgbd], prior: Trajectory | None
) -> Iterator[tuple[Message, ...]]:
    """Yield each frame, preceded by the poses of the odometry prior that its tracking needs.

    A frame needs all remaining poses with earlier stamps, and the first pose whose stamp is not
    earlier. The tracker can then interpolate the pose at the stamp of the frame.

    Args:
        frames: The frames.
        prior: Poses T_odom_base of another odometry; None if there is none.

    Yields:
        For each frame: the messages of the poses, then the frame.
    """
    source = PriorSource(prior)
    for frame in frames:
        yield (*source.until(frame.stamp_ns), frame)


class PriorSource:
    """Messages of an odometry prior in the order of their stamps."""

    def __init__(self, prior: Trajectory | None) -> None:
        """Begin with the first of the poses T_odom_base; `prior` is None if there are no poses."""
        stamps_s, poses = ((), ()) if prior is None else (prior.stamps_s, prior.T_world_camera)
        self._poses = iter(map(prior_message, stamps_s, poses))
        self._last_ns = -1

    def until(self, stamp_ns: int) -> list[OdometryPrior]:
        """Return the remaining poses before a stamp, and the first pose at or after the stamp."""
        news = []
        while self._last_ns < stamp_ns and (pose := next(self._poses, None)) is not None:
            news.append(pose)
            self._last_ns = pose.stamp_ns
        return news


def prior_message(stamp_s: float, T_odom_base: np.ndarray) -> OdometryPrior:
    """Return the message of a pose T_odom_base [4, 4] at a time in seconds."""
    return OdometryPrior(stamp_ns=round(1e9 * stamp_s), T_prior_base=pose_to_message(T_odom_base))


def require_overlap(prior: Trajectory, sequence: Sequence, indices: range) -> None:
    """Check that the odometry prior has a pose between the first and the last selected frame.

    Raises:
        DataError: The prior has no such pose.
    """
    if not _overlaps(prior, sequence, indices):
        first_s, last_s = _times_s(sequence, indices)
        raise DataError(
            f"the odometry prior has no pose between {first_s:.3f} s and {last_s:.3f} s, the first "
            f"and the last frame of {sequence.name}. The stamps of prior and frames must come from "
            "the same clock."
        )


def _overlaps(prior: Trajectory, sequence: Sequence, indices: range) -> bool:
    """Return whether a prior has a pose between the first and the last selected frame."""
    first_s, last_s = _times_s(sequence, indices)
    return bool(np.any((prior.stamps_s >= first_s) & (prior.stamps_s <= last_s)))


def _times_s(sequence: Sequence, indices: range) -> tuple[float, float]:
    """Return the times of the first and the last selected frame, s."""
    first_ns, last_ns = sequence.stamps_ns[[indices[0], indices[-1]]]
    return 1e-9 * float(first_ns), 1e-9 * float(last_ns)


def layout_of(source: str) -> str:
    """Return the display name of a source's file layout; "none" if no known layout fits.

    Raises:
        ConfigError: A layout that another package provides cannot be loaded.
    """
    path = Path(source).expanduser()
    if source.partition(":")[0] == "synthetic":
        return "a built-in scene"
    layout = find_layout(path)
    return "none" if layout is None else layout.name
