"""Sequences of ICL-NUIM (Handa et al., ICRA 2014), in both of its layouts.

TUM-compatible PNGs:
associations.txt              lines of `1 depth/1.png 1 rgb/1.png`; depth in units of 1/5000 m
Files of the renderer:
scene_00_0000.png             color
scene_00_0000.depth           distance from the camera center in meters, as text, row by row
Both:
livingRoom0.gt.freiburg       or traj0.gt.freiburg, optional: lines of `number tx ty tz qx qy qz qw`

The data set's camera has fy = -480, because its y axis points up in the image. This project uses
fy = 480 and a y axis that points down. The images are upright and need no change. The poses are
mirrored at the plane y = 0: with M = diag(1, -1, 1, 1), T_world_camera becomes M T_world_camera M.
This turns the left-handed coordinates into right-handed ones. Frame k gets the stamp k / 30 s.
"""

from pathlib import Path

import numpy as np

from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.camera import rays
from ldo_service.geometry.sequence import Sequence

from .files import (
    FRAME_RATE_HZ,
    NumberedFrames,
    inside,
    name_of,
    numbered,
    pair_by_number,
    read_lines,
)
from .images import read_color, read_depth

CAMERA = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
DEPTH_SCALE = 5000.0  # Units per meter of the PNGs.
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
MAX_BYTES = 1 << 24  # Maximum size of a .depth file; the published ones have about 3 MB.
ASSOCIATIONS = "associations.txt"


class IclNuimSequence(Sequence):
    """Sequence of ICL-NUIM: frames with both color and depth, in the order of their numbers."""

    def __init__(self, folder: Path) -> None:
        """Open the sequence of a folder."""
        self._folder = folder
        is_rendered = not (folder / ASSOCIATIONS).is_file()
        self._files = (
            pair_by_number(
                numbered(folder, r"scene_\d+_(\d+)\.png"),
                numbered(folder, r"scene_\d+_(\d+)\.depth"),
                folder,
            )
            if is_rendered
            else _associated(folder / ASSOCIATIONS)
        )
        super().__init__(name_of(folder), CAMERA, self._files.stamps_ns)

    @staticmethod
    def matches(folder: Path) -> bool:
        """Return whether a folder has one of the layouts of ICL-NUIM."""
        is_tum = (folder / "rgb.txt").is_file()
        if (folder / ASSOCIATIONS).is_file() and (folder / "rgb").is_dir() and not is_tum:
            return True
        return any(folder.glob("scene_*_*.depth"))

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        color, path = read_color(self._files.color[index]), self._files.depth[index]
        stamp_ns = int(self.stamps_ns[index])
        if path.suffix == ".depth":
            return RawFrame(index, stamp_ns, color, _z_of_distances(path), 1.0, CAMERA)
        return RawFrame(index, stamp_ns, color, read_depth(path), DEPTH_SCALE, CAMERA)

    def truth(self) -> Trajectory | None:
        """Return the ground-truth trajectory of the file *.gt.freiburg; None if it does not exist.

        Raises:
            DataError: The file is invalid, or the folder has several such files.
        """
        paths = sorted(self._folder.glob("*.gt.freiburg"))
        if len(paths) > 1:
            raise DataError(
                f"{self._folder} has {len(paths)} files *.gt.freiburg: "
                f"{', '.join(path.name for path in paths)}. Keep only the file of this sequence."
            )
        if not paths:
            return None
        numbers = Trajectory.load(paths[0])
        T_world_camera = MIRROR @ numbers.T_world_camera @ MIRROR
        return Trajectory(numbers.stamps_s / FRAME_RATE_HZ, T_world_camera)


def _associated(path: Path) -> NumberedFrames:
    """Return the files of associations.txt by their numbers.

    Raises:
        DataError: The file cannot be read, or a line is invalid.
    """
    color: dict[int, Path] = {}
    depth: dict[int, Path] = {}
    for line_number, line in read_lines(path):
        words = line.split()
        files = [inside(path.parent, name) for name in words[1::2]]
        if len(words) != 4 or None in files or not words[0].isdecimal() or len(words[0]) > 9:
            raise DataError(
                f"{path}, line {line_number}: expected a line such as `1 depth/1.png 1 rgb/1.png`, "
                f"found {line[:80]!r}. Download the file again."
            )
        for file in files:
            assert file is not None
            (depth if file.parent.name == "depth" else color)[int(words[0])] = file
    return pair_by_number(color, depth, path.parent)


def _z_of_distances(path: Path) -> np.ndarray:
    """Return z [480, 640] float32 in meters from the distances of a .depth file.

    Raises:
        FrameError: The file cannot be read, or it does not have 640x480 numbers.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"the file has more than {MAX_BYTES} bytes")
        distance_m = np.array(path.read_bytes().split(), np.float32)
    except (OSError, ValueError) as error:
        raise FrameError(
            f"{path} cannot be read as numbers: {error}. Download it again."
        ) from error
    if distance_m.size != CAMERA.width * CAMERA.height:
        raise FrameError(
            f"{path} has {distance_m.size} numbers, expected {CAMERA.width}x{CAMERA.height}. "
            "Download it again."
        )
    x, y = rays(CAMERA)
    return distance_m.reshape(CAMERA.height, CAMERA.width) / np.sqrt(x * x + y * y + 1)
