"""Scene of a run folder, whose files are read when they appear or change."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ldo_service.errors import DataError
from ldo_service.gaussians.file_formats import read_ply
from ldo_service.gaussians.pruning import weightiest
from ldo_service.geometry import Trajectory
from ldo_service.runs.finished import has_refined, read_viewpoints
from ldo_service.runs.folder import REFINED
from ldo_service.runs.records import LOOPS, OBJECTS, read_loops, read_objects, refuse_state

from . import panel
from .scene import Layer, Scene, detections_of, thinned
from .view_config import ViewerConfig

Signature = tuple[int, int]  # Time of the last change, ns, and size, bytes.


class RunFolder:
    """Source of the scene of a run folder; each `update` checks the folder for changes.

    A file that cannot be read is reported in the panel, and read again when it changes.
    """

    def __init__(self, folder: Path, config: ViewerConfig) -> None:
        """Open the folder.

        Raises:
            DataError: The folder does not exist, or was not written by a run.
        """
        if not folder.is_dir():
            raise DataError(
                f"{folder} is not a folder. Give the --out folder of a run, or `live` for a "
                "running service."
            )
        self._folder, self._config = folder, config
        self._begin()
        if not any(_signature(folder / name) for name in PARTS):
            refuse_state(folder)
        if not any(_signature(folder / name) for name in ("config.yaml", *PARTS)):
            raise DataError(
                f"{folder} holds nothing that `ldo run` writes, such as map.ply or trajectory.txt. "
                "Give the --out folder of a run."
            )

    def _begin(self) -> None:
        """Start with an empty scene."""
        self.scene = Scene()
        self._seen: dict[str, tuple[Path, Signature]] = {}
        self._problems: dict[str, str] = {}  # Error messages by file.
        self._summary: dict[str, Any] | None = None
        self._frames = self._gaussians = 0

    def update(self, *, is_watched: bool = True) -> set[Layer]:
        """Read all new and changed files.

        Args:
            is_watched: False if no browser is connected; nothing is read then.

        Returns:
            The layers that have changed.
        """
        if not is_watched:
            return set()
        changed: set[Layer] = set()
        if any(_signature(self._path(name)) is None for name in self._seen):
            self._begin()  # Another run writes to this folder now.
            changed |= set(get_args(Layer))
        for name, (layers, read) in PARTS.items():
            if self._is_news(name):
                self._read(name, read)
                changed |= {*layers, "facts"}
        if changed:
            self.scene.facts = self._facts()
        return changed

    def _is_news(self, name: str) -> bool:
        path = self._path(name)
        signature = _signature(path)
        if signature is None or self._seen.get(name) == (path, signature):
            return False
        self._seen[name] = path, signature
        return True

    def _path(self, name: str) -> Path:
        """Return the path of a file: in the refined map's folder if it exists, else the run's."""
        refined = self._folder / REFINED / name
        return refined if has_refined(self._folder) and refined.is_file() else self._folder / name

    def _read(self, name: str, read: Callable[["RunFolder", Path], None]) -> None:
        try:
            read(self, self._path(name))
            self._problems.pop(name, None)
        except DataError as error:
            self._problems[name] = str(error)

    def _facts(self) -> str:
        status = panel.of_summary(self._summary) if self._summary else panel.under_way(self._frames)
        shown = panel.share_shown(len(self.scene.rows), self._gaussians)
        return "\n\n".join(
            filter(None, (status, shown, *map(panel.escaped, self._problems.values())))
        )

    # --- one for each file ------------------------------------------------------------------------
    def read_summary(self, path: Path) -> None:
        try:
            value = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise DataError(f"{path} cannot be read: {error}. Repeat the run.") from error
        if not isinstance(value, dict):
            raise DataError(f"{path} must be a JSON object, as `ldo run` writes. Repeat the run.")
        self._summary = value

    def read_frames(self, path: Path) -> None:
        """Count the frames for the panel: the lines of frames.csv below the column names."""
        try:
            self._frames = max(0, path.read_bytes().count(b"\n") - 1)
        except OSError as error:
            raise DataError(
                f"{path} cannot be read: {error.strerror}. Check its permissions."
            ) from error

    def read_online(self, path: Path) -> None:
        self.scene.online = self._positions(path)

    def read_final(self, path: Path) -> None:
        self.scene.final = self._positions(path)

    def _positions(self, path: Path) -> np.ndarray:
        T_map_camera = Trajectory.load(path).T_world_camera
        if len(T_map_camera):
            self.scene.T_map_camera = T_map_camera[-1]
        return thinned(T_map_camera[:, :3, 3], self._config.max_poses)

    def read_keyframes(self, path: Path) -> None:
        viewpoints = read_viewpoints(path.parent)
        self.scene.keyframes = {k: one.T_map_camera for k, one in viewpoints.items()}
        self.scene.camera = next((one.camera for one in viewpoints.values()), None)

    def read_map(self, path: Path) -> None:
        rows = read_ply(path)
        self._gaussians = len(rows)
        self.scene.rows = rows[weightiest(rows, self._config.max_gaussians)]

    def read_objects(self, path: Path) -> None:
        """Read the objects, and the detections of each object in its best keyframes."""
        self.scene.objects = read_objects(path.parent)
        self.scene.detections = detections_of(self.scene.objects)

    def read_loops(self, path: Path) -> None:
        found = read_loops(path.parent)
        closures = found.closures if found else ()
        self.scene.loops = tuple((loop.reference, loop.keyframe) for loop in closures)


PARTS: dict[str, tuple[tuple[Layer, ...], Callable[[RunFolder, Path], None]]] = {
    "frames.csv": (("facts",), RunFolder.read_frames),
    "summary.json": (("facts",), RunFolder.read_summary),
    "trajectory_online.txt": (("online", "camera"), RunFolder.read_online),
    "trajectory.txt": (("final", "camera"), RunFolder.read_final),
    "keyframes.json": (("keyframes",), RunFolder.read_keyframes),
    OBJECTS: (("objects", "keyframes"), RunFolder.read_objects),
    LOOPS: (("loops",), RunFolder.read_loops),
    "map.ply": (("gaussians",), RunFolder.read_map),
}


def _signature(path: Path) -> Signature | None:
    """Return a signature that changes with the file; None if the file does not exist."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size
