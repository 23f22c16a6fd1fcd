"""Sequences of Replica in the layout of NICE-SLAM (Zhu et al., CVPR 2022).

    results/frame*.jpg results/depth*.png    numbered images
    traj.txt                                 optional: 16 numbers per line, camera to world by rows
    cam_params.json                          in this folder or one folder up: {"camera": {"w", "h",
                                             "fx", "fy", "cx", "cy", "scale"}}; scale is the number
                                             of depth units per meter

Optional labels, as Habitat renders them:

    semantic_class/*.png                     8 bits per pixel: the class; named by frame number
    instance/*.png                           16 bits per pixel: the object; named by frame number
    labels.json                              {"classes": {"<class>": name}}
"""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import RawFrame, Trajectory, se3
from ldo_service.geometry.sequence import FrameLabels, Sequence, TrueLabels

from .files import (
    Calibration,
    is_rigid,
    name_of,
    number,
    numbered,
    pair_by_number,
    pinhole,
    read_json,
)
from .images import read_color, read_depth, read_labels

MAX_CLASSES = 256  # Limit of 8-bit images.


class ReplicaLabels:
    """Reader of the ground-truth labels of a Replica sequence."""

    def __init__(self, folder: Path, numbers: np.ndarray) -> None:
        """Open the labels of a folder.

        Args:
            folder: The folder.
            numbers: Numbers of the frames, [N].
        """
        self._folder, self._numbers = folder, numbers

    def read(self) -> TrueLabels | None:
        """Return the labels, or None if there is no labels.json.

        Raises:
            DataError: The class names are invalid.
        """
        path = self._folder / "labels.json"
        return TrueLabels(_class_names(path), self.frame) if path.is_file() else None

    def frame(self, index: int) -> FrameLabels:
        """Read the labels of a frame.

        Raises:
            DataError: The frame has no labels.
            FrameError: An image cannot be read.
        """
        number = int(self._numbers[index])
        classes, instances = self._files
        if number not in classes or number not in instances:
            raise DataError(
                f"{self._folder} has a labels.json, but no labels of frame {number}: expected "
                f"semantic_class/{number:06d}.png and instance/{number:06d}.png. Copy these files "
                "again."
            )
        class_ids = read_labels(classes[number], np.uint8)
        return FrameLabels(class_ids, read_labels(instances[number], np.uint16))

    @cached_property
    def _files(self) -> tuple[dict[int, Path], dict[int, Path]]:
        classes, instances = self._folder / "semantic_class", self._folder / "instance"
        return numbered(classes, r"(\d+)\.png"), numbered(instances, r"(\d+)\.png")


def _class_names(path: Path) -> tuple[str, ...]:
    """Read the class names, indexed by class id; an id without a name gets an empty name."""
    found: Any = read_json(path).get("classes")
    try:
        names = {int(number): str(name) for number, name in found.items()}
    except (AttributeError, TypeError, ValueError):
        names = {}
    if not names or not 0 <= min(names) <= max(names) < MAX_CLASSES:
        raise DataError(
            f'{path}: expected "classes", an object that maps numbers from 0 to '
            f"{MAX_CLASSES - 1} to names. Correct the file."
        )
    return tuple(names.get(number, "") for number in range(max(names) + 1))


class ReplicaSequence(Sequence):
    """Replica sequence: frames with both color and depth, in the order of their numbers."""

    def __init__(self, folder: Path) -> None:
        """Open the sequence of a folder."""
        self._folder = folder
        color = numbered(folder / "results", r"frame(\d+)\.(?:jpg|jpeg|png)")
        depth = numbered(folder / "results", r"depth(\d+)\.png")
        self._files = pair_by_number(color, depth, folder / "results")
        calibration = _calibration(folder)
        self.depth_scale = calibration.depth_scale
        super().__init__(name_of(folder), calibration.camera, self._files.stamps_ns)

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        return RawFrame(
            index,
            int(self.stamps_ns[index]),
            read_color(self._files.color[index]),
            read_depth(self._files.depth[index]),
            self.depth_scale,
            self.raw_camera,
        )

    def truth(self) -> Trajectory | None:
        """Return the trajectory of traj.txt, or None if the file does not exist."""
        path = self._folder / "traj.txt"
        if not path.is_file():
            return None
        poses = _poses(path)
        # traj.txt has one line per frame. If files of frames were removed, it may still have the
        # lines of these frames; line k, counted from 0, then belongs to frame number k.
        lines = self._files.numbers if len(poses) > len(self) else np.arange(len(self))
        known = lines < len(poses)
        return Trajectory(self.stamps_ns[known] / 1e9, poses[lines[known]])

    def true_labels(self) -> TrueLabels | None:
        """Return the ground-truth labels, or None if there is no labels.json."""
        return ReplicaLabels(self._folder, self._files.numbers).read()


def _calibration(folder: Path) -> Calibration:
    candidates = [folder / "cam_params.json", folder.resolve().parent / "cam_params.json"]
    path = next((path for path in candidates if path.is_file()), None)
    if path is None:
        raise DataError(
            f"the intrinsics are missing: neither {candidates[0]} nor {candidates[1]} exists. Copy "
            "the cam_params.json of the data set to one of these paths."
        )
    fields = read_json(path).get("camera")
    if not isinstance(fields, dict):
        raise DataError(
            f'{path}: expected a JSON object under "camera". Copy the cam_params.json of the data '
            "set again."
        )
    return Calibration(pinhole(fields, "w", "h", path), number(fields, "scale", path))


def _poses(path: Path) -> np.ndarray:
    """Read T_world_camera [K, 4, 4] from a file with one pose per line.

    Raises:
        DataError: The file cannot be read, or a line is invalid.
    """
    try:
        lines = [line for line in path.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as poses: {error}. Copy it again.") from error
    return np.array([_pose(path, k, line) for k, line in enumerate(lines, 1)]).reshape(-1, 4, 4)


def _pose(path: Path, line_number: int, line: str) -> np.ndarray:
    try:
        T_world_camera = np.array([float(word) for word in line.split()]).reshape(4, 4)
    except ValueError:
        T_world_camera = np.full((4, 4), np.nan)
    if not is_rigid(T_world_camera):
        raise DataError(
            f"{path}, line {line_number}: expected the 16 numbers of a rigid 4x4 camera-to-world "
            f"matrix by rows, found {line[:80]!r}. Copy the file again."
        )
    return se3.orthonormalize(T_world_camera)
