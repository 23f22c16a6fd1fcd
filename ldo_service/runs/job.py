"""What a run is asked to do."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ldo_service.config import Config
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError

from .source import Selection, Warn

Advance = Callable[[int], None]  # called with the number of frames and refinements done

REFINE_ITERATIONS = 25  # asked of the mapper at a time: about a second


@dataclass(frozen=True, slots=True)
class Job:
    """A sequence and which of its frames, the configuration, where the results go, who is warned,
    and how many iterations refine the map after the last frame."""

    sequence: Sequence
    folder: Path
    config: Config
    selection: Selection
    warn: Warn
    refine: int = 0

    def __post_init__(self) -> None:
        if self.refine < 0:
            raise ConfigError(f"--refine {self.refine} must not be negative.")

    @property
    def refinements(self) -> int:
        """In how many requests the iterations are asked for."""
        return -(-self.refine // REFINE_ITERATIONS)

    @property
    def work(self) -> int:
        """Frames and refinements."""
        return len(self.selection.indices(self.sequence)) + self.refinements
