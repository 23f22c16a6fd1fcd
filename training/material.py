"""Training frames of many rooms, rendered by several processes and stored in a folder."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import views
from views import Views, VisibleBoxes


@dataclass(frozen=True, slots=True)
class Rooms:
    """Set of rooms, defined by their seeds and the number of frames per room."""

    seeds: range  # Seed of each room.
    frames: int  # Number of frames per room.

    def load(self, folder: Path) -> Views:
        """Return the frames of all rooms, in the order of the seeds.

        Frames that are missing in the folder are rendered and stored first.
        """
        parts = [views.cached(folder, seed, self.frames) for seed in self.seeds]
        return Views(
            np.concatenate([part.colors for part in parts]),
            np.concatenate([part.instances for part in parts]),
            self._joined([part.seen for part in parts]),
            self._joined([part.regions for part in parts]),
        )

    def _joined(self, parts: list[VisibleBoxes]) -> VisibleBoxes:
        tables = [part.table() for part in parts]
        for k, table in enumerate(tables):
            table[:, 0] += k * self.frames
        return VisibleBoxes.of(np.concatenate(tables))


def render_all(rooms: list[Rooms], folder: Path, processes: int) -> None:
    """Render every room that is not in the folder yet."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for part in rooms:
            render_one = partial(_render_one, folder, part.frames)
            for _ in pool.map(render_one, part.seeds):
                pass


def _render_one(folder: Path, frames: int, seed: int) -> None:
    views.cached(folder, seed, frames)
