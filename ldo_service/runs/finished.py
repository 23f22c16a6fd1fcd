"""What a run left in its folder, to be worked on."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import DataError
from ldo_service.gaussians.ply import read_ply
from ldo_service.geometry import Camera, Trajectory
from ldo_service.volumes import Viewpoint

from .folder import CAMERA

REFINED = "refined"  # folder in that of the run, with a map, keyframes and trajectory of its own


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """`folder` holds map.ply, trajectory.txt and keyframes.json. Reading them raises DataError."""

    folder: Path

    @classmethod
    def open(cls, folder: Path, online: bool = False) -> "FinishedRun":
        """What was refined after the run, where it was and `online` does not ask for the other."""
        if not (folder / "map.ply").is_file():
            raise DataError(f"{folder} has no map.ply: is it what `ldo run` wrote?")
        refined = folder / REFINED
        return cls(folder if online or not (refined / "map.ply").is_file() else refined)

    def gaussians(self) -> np.ndarray:
        """Rows [N, 16], see `gaussians.model`."""
        return read_ply(self.folder / "map.ply")

    def trajectory(self) -> Trajectory:
        """T_map_camera of every frame that has a pose, after the last correction."""
        return Trajectory.load(self.folder / "trajectory.txt")

    def viewpoints(self) -> list[Viewpoint]:
        """Where the keyframes were taken."""
        path = self.folder / "keyframes.json"
        try:
            return [_viewpoint(path, entry) for entry in json.loads(path.read_text())]
        except OSError as error:
            raise DataError(f"{path} cannot be read: {error.strerror}.") from error
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(f"{path} is not what `ldo run` writes: {error!r}.") from error


def _viewpoint(path: Path, entry: dict[str, Any]) -> Viewpoint:
    if "camera" not in entry:
        raise DataError(
            f"{path} does not say with which camera its keyframes were taken: an older version "
            "wrote it. `ldo run` the sequence again."
        )
    T_map_camera = np.array(entry["T_map_camera"], float)
    if T_map_camera.shape != (4, 4) or not np.all(np.isfinite(T_map_camera)):
        raise ValueError(f"T_map_camera of keyframe {entry['keyframe']} is no finite 4x4 matrix")
    return Viewpoint(Camera(*(entry["camera"][name] for name in CAMERA)), T_map_camera)
