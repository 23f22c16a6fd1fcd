"""Options of a run."""

from dataclasses import dataclass
from math import gcd
from pathlib import Path
from typing import Protocol

from ldo_service.config import Config
from ldo_service.errors import ConfigError
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence

from .front_end import FrontEnd
from .source import Selection, Warn, require_overlap

REFINE_ITERATIONS = 25  # Maximum iterations per refinement request, which takes about a second.


class Advance(Protocol):
    """Callback that reports progress.

    The progress counts frames and refinement requests. A refinement request asks the mapper for up
    to `REFINE_ITERATIONS` iterations of the Gaussian optimizer.

    Args:
        done: Number of finished frames and refinement requests.
        total: Number of frames and refinement requests of the whole run. It grows if corrections
            of the pose graph require a refit. None: the number is the same as in the last call.
    """

    def __call__(self, done: int, total: int | None = None, /) -> None: ...


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of a run.

    Attributes:
        sequence: Sequence of frames.
        folder: Folder for the results.
        config: Configuration.
        selection: Selected frames of the sequence.
        warn: Function that receives warnings for the user.
        refine: Number of iterations of the Gaussian optimizer after the last frame.
        prior: Poses T_odom_base of the robot's base in the frame of another odometry; None if there
            is no other odometry.
        front_end: Recorded outputs that replace frame source, tracker and detector; None to run
            these actors.
        keep_front_end: True to record the outputs of frame source, tracker and detector.
    """

    sequence: Sequence
    folder: Path
    config: Config
    selection: Selection
    warn: Warn
    refine: int = 0
    prior: Trajectory | None = None
    front_end: FrontEnd | None = None
    keep_front_end: bool = False

    def __post_init__(self) -> None:
        if self.refine < 0:
            raise ConfigError(f"--refine-iterations {self.refine} must not be negative.")
        if self.prior is not None:
            require_overlap(self.prior, self.sequence, self.selection.indices(self.sequence))

    @property
    def work(self) -> int:
        """Total for progress reports: number of selected frames plus refinement requests."""
        return len(self.selection.indices(self.sequence)) + requests(self.refine)


def requests(iterations: int) -> int:
    """Return the number of refinement requests that `iterations` iterations need.

    Each request asks the mapper for at most `REFINE_ITERATIONS` iterations.
    """
    return -(-iterations // REFINE_ITERATIONS)


def require_held_out(stride: int, hold_out: int) -> None:
    """Check that the stride does not skip all held-out frames.

    Held-out frames are tracked but not mapped. Every `hold_out`-th frame of the whole sequence is
    held out, including frames that the stride skips. If `stride` and `hold_out` have a common
    factor above 1, the stride skips all held-out frames.

    Raises:
        ConfigError: `stride` and `hold_out` have a common factor above 1.
    """
    if hold_out and gcd(stride, hold_out) > 1:
        raise ConfigError(
            f"--stride {stride} and --hold-out-every {hold_out} have a common factor, so "
            "the stride would skip all held-out frames. Choose numbers without a common factor."
        )
