"""What a run is asked to do."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from ldo_service.config import Config
from ldo_service.errors import ConfigError
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence

from .front_end import FrontEnd
from .source import Selection, Warn, require_overlap

REFINE_ITERATIONS = 25  # asked of the mapper at a time: about a second


class Advance(Protocol):
    """Told how many frames and refinements are done, and of how many, where corrections left more
    to do than was asked for."""

    def __call__(self, done: int, total: int | None = None, /) -> None: ...


@dataclass(frozen=True, slots=True)
class RunOptions:
    """A sequence and which of its frames, the configuration, where the results go, who is warned,
    how many iterations refine the map after the last frame, and where another odometry had the
    robot's base; a front end that another run kept, in place of one over the frames, or whether to
    keep this one's."""

    sequence: Sequence
    folder: Path
    config: Config
    selection: Selection
    warn: Warn
    refine: int = 0
    prior: Trajectory | None = None  # T_odom_base, in a frame of its own
    front_end: FrontEnd | None = None
    keep_front_end: bool = False

    def __post_init__(self) -> None:
        if self.refine < 0:
            raise ConfigError(f"--refine-iterations {self.refine} must not be negative.")
        if self.prior is not None:
            require_overlap(self.prior, self.sequence, self.selection.indices(self.sequence))

    @property
    def work(self) -> int:
        """Frames and refinements."""
        return len(self.selection.indices(self.sequence)) + requests(self.refine)


def requests(iterations: int) -> int:
    """In how many the mapper is asked for so many iterations."""
    return -(-iterations // REFINE_ITERATIONS)
