"""Description of a source of frames: rate, gaps, calibration, depth, odometry and ground truth."""

import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ldo_service.config import Config
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry.sequence import Sequence, Stream

from .job import RunOptions
from .offline import run_offline
from .source import Selection

log = logging.getLogger(__name__)

MIN_GAP_PERIODS = 1.5  # An interval longer than this many median intervals is a gap.
SAMPLES = 5  # Number of frames that are read, evenly spaced.


@dataclass(frozen=True, slots=True)
class Timing:
    """Stamps of the frames of a source."""

    frames: int  # Number of frames.
    first_stamp_s: float
    duration_s: float  # Last stamp minus first stamp.
    rate_hz: float | None  # Inverse of the median interval; None for a single frame.
    gaps: int  # Number of intervals longer than MIN_GAP_PERIODS median intervals.
    longest_interval_s: float | None  # Longest interval; None for a single frame.


@dataclass(frozen=True, slots=True)
class DepthInfo:
    """Properties of the depth images of a source."""

    registration: str  # See `Sequence.registration`.
    # Stamp of depth minus stamp of color: median, and largest absolute value; None if unknown.
    offset_ms: float | None
    max_offset_ms: float | None
    # Values of the sampled frames that can be read; None if there is none.
    valid_ratio: float | None  # Fraction of the pixels with a depth.
    median_m: float | None  # Median depth.


@dataclass(frozen=True, slots=True)
class SourceInfo:
    """Description of a source of frames."""

    name: str
    streams: tuple[Stream, ...]  # See `Sequence.streams`.
    timing: Timing
    camera: dict[str, Any]  # Fields of `Camera`.
    depth: DepthInfo
    sampled_frames: int  # Number of frames that were read for the description.
    unreadable_frames: int  # Number of sampled frames that cannot be read.
    why_unreadable: str | None  # Problem of the first of these; None if there is none.
    true_poses: int  # Number of poses of the ground truth; 0 if there is none.
    odometry_poses: int  # Number of poses of a recorded odometry; 0 if there is none.
    has_true_labels: bool


def describe(sequence: Sequence) -> SourceInfo:
    """Describe a sequence from its metadata and from `SAMPLES` evenly spaced frames.

    Raises:
        DataError: The ground truth is invalid.
    """
    indices = np.unique(np.linspace(0, len(sequence) - 1, SAMPLES).round().astype(int))
    read = [_depth_m(sequence, int(index)) for index in indices if len(sequence)]
    depths_m = [depth_m for depth_m in read if not isinstance(depth_m, str)]
    reasons = [reason for reason in read if isinstance(reason, str)]
    truth = sequence.truth()
    return SourceInfo(
        name=sequence.name,
        streams=sequence.streams,
        timing=_timing(sequence.stamps_ns),
        camera=asdict(sequence.raw_camera),
        depth=_depth(sequence, depths_m),
        sampled_frames=len(read),
        unreadable_frames=len(reasons),
        why_unreadable=reasons[0] if reasons else None,
        true_poses=0 if truth is None else len(truth.stamps_s),
        odometry_poses=_odometry_poses(sequence),
        has_true_labels=_has_true_labels(sequence),
    )


def _has_true_labels(sequence: Sequence) -> bool:
    """Return whether the true labels of a source can be read."""
    try:
        return sequence.true_labels() is not None
    except DataError:
        return False


def estimated_run_s(sequence: Sequence, config: Config, frames: int) -> float:
    """Estimate the time of an offline run over all frames, by a run over the first frames.

    Args:
        sequence: The sequence.
        config: Configuration of the run.
        frames: Number of frames of the short run.

    Returns:
        The time in seconds.

    Raises:
        LdoError: The short run fails. A run over all frames would fail in the same way.
    """
    selection = Selection(max_frames=frames)
    with TemporaryDirectory() as name:
        job = RunOptions(sequence, Path(name), config, selection, lambda _: None)
        summary = run_offline(job, lambda *_: None).summary
    return len(sequence) / summary["fps"]


def _odometry_poses(sequence: Sequence) -> int:
    """Return the number of poses of the recorded odometry; 0 if it cannot be used."""
    try:
        odometry = sequence.odometry()
    except DataError as error:
        log.warning("the recorded odometry of %s cannot be used: %s", sequence.name, error)
        return 0
    return 0 if odometry is None else len(odometry)


def _depth_m(sequence: Sequence, index: int) -> np.ndarray | str:
    """Return the depth of a frame as the camera delivered it, or a text why it is unreadable."""
    try:
        return sequence.read(index).depth_m()
    except FrameError as error:
        return str(error)


def _timing(stamps_ns: np.ndarray) -> Timing:
    intervals_s = np.diff(stamps_ns) * 1e-9
    period_s = float(np.median(intervals_s)) if len(intervals_s) else None
    return Timing(
        frames=len(stamps_ns),
        first_stamp_s=float(stamps_ns[0]) * 1e-9 if len(stamps_ns) else 0.0,
        duration_s=float(intervals_s.sum()),
        rate_hz=1 / period_s if period_s else None,
        gaps=int((intervals_s > MIN_GAP_PERIODS * period_s).sum()) if period_s else 0,
        longest_interval_s=float(intervals_s.max()) if len(intervals_s) else None,
    )


def _depth(sequence: Sequence, depths_m: list[np.ndarray]) -> DepthInfo:
    offsets_ns = sequence.depth_offsets_ns
    valid = [depth_m[depth_m > 0] for depth_m in depths_m]
    measured = np.concatenate(valid) if valid else np.empty(0)
    pixels = sum(depth_m.size for depth_m in depths_m)
    offsets_ms = None if offsets_ns is None or not len(offsets_ns) else offsets_ns * 1e-6
    return DepthInfo(
        registration=sequence.registration,
        offset_ms=None if offsets_ms is None else float(np.median(offsets_ms)),
        max_offset_ms=None if offsets_ms is None else float(np.abs(offsets_ms).max()),
        valid_ratio=len(measured) / pixels if pixels else None,
        median_m=float(np.median(measured)) if len(measured) else None,
    )
