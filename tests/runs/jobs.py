"""Offline runs with quick settings, and frames of a camera that is moved away and returns."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.geometry import RawFrame, Trajectory
from ldo_service.runs.folder import prepare
from ldo_service.runs.job import RunOptions
from ldo_service.runs.source import Selection, Warn
from ldo_service.tracking.submaps import SubmapConfig

ROUGH = "mapper.iterations=1"  # Fast, with every part of the mapper in use.


def job(
    sequence: Sequence,
    folder: Path,
    *settings: str,
    frames: int | None = None,
    warn: Warn = print,
    prior: Trajectory | None = None,
) -> RunOptions:
    """Return the options of a run over the first frames, or all, into a new folder."""
    prepare(folder, overwrite=False)
    config = load_config(settings=(ROUGH, *settings))
    return RunOptions(sequence, folder, config, Selection(max_frames=frames), warn, prior=prior)


EARLY_SUBMAPS = ("tracker.submaps.start_after_lost_frames=9",)
# A short walk from one place to another and back.
OUT_AND_BACK = [*range(0, 24, 2), *range(60, 66), *range(1, 23, 2)]
SHORT_GAP = "loop_closer.retrieval.min_gap_frames=5"  # Allows loops from the end to the start.
HERE, AWAY, BACK = range(12), range(60, 24, -2), range(24, 4, -2)


@contextmanager
def quick_submaps() -> Iterator[None]:
    """Let trackers made from a configuration merge submaps after a few frames."""
    quick = partial(SubmapConfig, search_interval_frames=3, confirm_after=2, confirm_apart_rad=0.05)
    with patch("ldo_service.config.parameters.SubmapConfig", quick):
        yield


class Rearranged(Sequence):
    """Frames of another sequence in another order; the stamps stay ascending."""

    def __init__(self, sequence: Sequence, order: list[int]) -> None:
        super().__init__(sequence.name, sequence.raw_camera, sequence.stamps_ns[: len(order)])
        self._sequence, self._order = sequence, order

    def read(self, index: int) -> RawFrame:
        raw = self._sequence.read(self._order[index])
        return replace(raw, index=index, stamp_ns=int(self.stamps_ns[index]))

    def truth(self) -> Trajectory:
        truth = self._sequence.truth()
        assert truth is not None
        return Trajectory(self.stamps_ns * 1e-9, truth.T_world_camera[self._order])
