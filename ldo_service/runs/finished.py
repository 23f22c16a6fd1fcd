"""Functions that read the folder of a finished run.

The module `runs.folder` lists the files of the folder. A function raises DataError if a file that
it needs is missing or has an invalid format.
"""

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.calibration.correction import read_correction
from ldo_service.conversions.poses import pose_from_message
from ldo_service.errors import DataError
from ldo_service.evaluation.finished_run import Exposures, FinishedRun, PosedMap, RunFrame
from ldo_service.evaluation.instances import SavedObjects
from ldo_service.gaussians.file_formats import read_ply
from ldo_service.geometry import Camera, Trajectory
from ldo_service.semantics.semantics_file import SavedSemantics, read_semantics
from ldo_service.volumes import Viewpoint

from .folder import CAMERA, REFINED, SEMANTICS
from .records import OBJECTS, read_loops, read_objects


def read_run(folder: Path, *, has_map: bool = True) -> FinishedRun:
    """Read all data of a run that the evaluation needs.

    Args:
        folder: Folder of the run.
        has_map: False for a run with --localize, which makes no map.
    """
    frames = _frames(require_file(folder, "frames.csv"))
    estimates = {
        "online": Trajectory.load(require_file(folder, "trajectory_online.txt")),
        "final": Trajectory.load(require_file(folder, "trajectory.txt")),
    }
    if not has_map:
        return FinishedRun(folder, frames, estimates, ())
    calls = vlm_calls(folder)
    maps = [MapFolder(folder).posed("online")]
    if has_refined(folder):
        maps.append(MapFolder(folder / REFINED).posed("refined"))
        estimates["refined"] = maps[1].trajectory
    loops, keyframes = read_loops(folder), MapFolder(folder).keyframes()
    return FinishedRun(folder, frames, estimates, tuple(maps), calls, loops, keyframes)


def vlm_calls(folder: Path) -> int | None:
    """Return the number of requests to the labeller; None if summary.json does not state it."""
    path = folder / "summary.json"
    try:
        found = json.loads(path.read_text())["labeller_requests"] if path.is_file() else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return found if isinstance(found, int) else None


def newest_map(folder: Path) -> "MapFolder":
    """Return the refined map of a run if there is one, else the map before refinement."""
    return MapFolder(folder / REFINED if has_refined(folder) else folder)


def has_refined(folder: Path) -> bool:
    """Return whether the run has a refined map.

    A refinement writes trajectory.txt and keyframes.json before map.ply. If map.ply exists, these
    two files are therefore complete.
    """
    return (folder / REFINED / "map.ply").is_file()


def require_file(folder: Path, name: str) -> Path:
    """Return the path of a file that every run writes.

    Raises:
        DataError: The file does not exist.
    """
    if not (folder / name).is_file():
        raise DataError(f"{folder} has no {name}. Give the folder of a finished `ldo run`.")
    return folder / name


@dataclass(frozen=True, slots=True)
class MapFolder:
    """Folder with map.ply, trajectory.txt and keyframes.json of a run or of its refinement.

    Only map.ply must exist. Each file is read when its content is requested.
    """

    folder: Path

    def __post_init__(self) -> None:
        if not (self.folder / "map.ply").is_file():
            raise DataError(
                f"{self.folder} has no map.ply. Give the folder of a finished `ldo run`. A run "
                "with --localize makes no map."
            )

    def gaussians(self) -> np.ndarray:
        """Return the rows of all Gaussians, [N, 16], see `gaussians.rows`."""
        return read_ply(self.folder / "map.ply")

    def semantics(self) -> SavedSemantics | None:
        """Return the labels of the Gaussians, in the order of `gaussians`.

        Return None if the run had neither a detector nor a labeller.
        """
        return self._semantics(len(self.gaussians()))

    def _semantics(self, gaussians: int) -> SavedSemantics | None:
        path = self.folder / SEMANTICS
        return read_semantics(path, gaussians) if path.is_file() else None

    def objects(self) -> SavedObjects | None:
        """Return the objects of the map, or None if the run had no detector and no labeller."""
        if not (self.folder / OBJECTS).is_file():
            return None
        objects = read_objects(self.folder).objects
        return SavedObjects(
            tuple(one.name for one in objects),
            np.array([one.confidence for one in objects], float),
            np.reshape([pose_from_message(one.T_map_object) for one in objects], (-1, 4, 4)),
            np.reshape([one.size for one in objects], (-1, 3)),
        )

    def trajectory(self) -> Trajectory:
        """Return T_map_camera of every frame with a pose, after the last correction."""
        return Trajectory.load(require_file(self.folder, "trajectory.txt"))

    def viewpoints(self) -> list[Viewpoint]:
        """Return the viewpoints of all keyframes that have a pose in the map."""
        return list(read_viewpoints(self.folder).values())

    def exposures(self) -> Exposures:
        """Return the exposures of the keyframes; empty if an older LDO-SLAM wrote the run."""
        with _keyframes(self.folder) as (_, keyframes):
            exposed = [keyframe for keyframe in keyframes if "exposure" in keyframe]
            stamps_ns = np.array([int(keyframe["stamp_ns"]) for keyframe in exposed], np.int64)
            matrices = np.array([keyframe["exposure"] for keyframe in exposed], float)
            return Exposures(stamps_ns, matrices.reshape(-1, 2, 3))

    def keyframes(self) -> dict[int, int]:
        """Return the frame index of each keyframe, by keyframe id."""
        with _keyframes(self.folder) as (_, keyframes):
            return {int(k["keyframe"]): int(k["frame_index"]) for k in keyframes}

    def posed(self, name: str) -> PosedMap:
        """Return the map with its trajectory, exposures, labels and objects.

        Args:
            name: Name of the map in the evaluation, "online" or "refined".
        """
        rows = self.gaussians()
        labels = self._semantics(len(rows))
        about = labels, read_correction(self.folder), self.objects()
        return PosedMap(name, rows, self.trajectory(), self.exposures(), *about)


def read_viewpoints(folder: Path) -> dict[int, Viewpoint]:
    """Return the viewpoints of all keyframes that have a pose in the map, by keyframe id.

    The folder needs keyframes.json, but no map.
    """
    with _keyframes(folder) as (path, keyframes):
        mapped = [k for k in keyframes if _submap(k) == 0]
        return {int(k["keyframe"]): _viewpoint(path, k) for k in mapped}


def _submap(keyframe: dict[str, Any]) -> int:
    """Return the submap of a keyframe in keyframes.json; 0 if an old version did not write it.

    Version 0.1 wrote `segment` instead of `submap`.
    """
    return next((keyframe[name] for name in ("submap", "segment") if name in keyframe), 0)


@contextmanager
def _keyframes(folder: Path) -> Iterator[tuple[Path, list[dict[str, Any]]]]:
    """Open a context that provides the path and the content of keyframes.json.

    If the code inside the context fails to interpret the content, the error names the file.

    Raises:
        DataError: The file cannot be read, or its content is invalid.
    """
    path = require_file(folder, "keyframes.json")
    try:
        yield path, json.loads(path.read_text())
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}. Give the folder of a finished `ldo run`."
        ) from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(
            f"{path} does not have the format that `ldo run` writes ({error!r}). Give the folder "
            "of a finished `ldo run`."
        ) from error


def _viewpoint(path: Path, keyframe: dict[str, Any]) -> Viewpoint:
    if "camera" not in keyframe:
        raise DataError(
            f"{path} has no cameras of the keyframes, because an older version of LDO-SLAM wrote "
            "it. Run `ldo run` on the sequence again."
        )
    T_map_camera = np.array(keyframe["T_map_camera"], float)
    if T_map_camera.shape != (4, 4) or not np.all(np.isfinite(T_map_camera)):
        raise DataError(
            f"{path}: T_map_camera of keyframe {keyframe['keyframe']} must be a 4x4 matrix of "
            "finite numbers. Repeat the run."
        )
    return Viewpoint(Camera(*(keyframe["camera"][name] for name in CAMERA)), T_map_camera)


def _frames(path: Path) -> tuple[RunFrame, ...]:
    try:
        with path.open(newline="") as file:
            return tuple(_frame(row) for row in csv.DictReader(file))
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise DataError(
            f"{path} cannot be read as the list of frames of a run ({error!r}). Give the folder of "
            "a finished `ldo run`."
        ) from error


def _frame(row: dict[str, str]) -> RunFrame:
    is_held_out = bool(int(row["held_out"]))
    return RunFrame(int(row["frame"]), int(row["stamp_ns"]), row["status"], is_held_out)
