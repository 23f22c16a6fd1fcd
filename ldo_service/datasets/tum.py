"""Sequences in the layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012).

The benchmarks of Bonn (Palazzolo et al., IROS 2019) and ETH3D SLAM (Schoeps et al., CVPR 2019) have
the same layout.

rgb.txt depth.txt        lines of `stamp file`; stamps in seconds, `#` starts a comment
groundtruth.txt          optional: lines of `stamp tx ty tz qx qy qz qw`, camera to world
camera.json              optional for the original recordings; see CAMERA_JSON
calibration.txt          of ETH3D SLAM: `fx fy cx cy`; used if there is no camera.json
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence

from .files import (
    Calibration,
    inside,
    name_of,
    number,
    pair_by_stamp,
    parse_stamp,
    pinhole,
    read_json,
    read_lines,
)
from .images import first_size, read_color, read_depth

CAMERA_JSON = (
    '{"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, '
    '"distortion": [k1, k2, p1, p2, k3], "depth_scale": 5000}, the last two optional'
)
DEPTH_SCALE = 5000.0  # Units per meter in all recordings of the benchmark.

# Published calibrations of the color cameras of the benchmarks, by a part of the folder's name;
# fr3 is rectified already.
PUBLISHED_CAMERAS = {
    "freiburg1": Camera(
        *(640, 480, 517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "freiburg2": Camera(
        *(640, 480, 520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    "freiburg3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
    "rgbd_bonn": Camera(
        *(640, 480, 542.822841, 542.576870, 315.593520, 237.756098),
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    ),
}


@dataclass(frozen=True, slots=True)
class _Listing:
    """Contents of rgb.txt or depth.txt."""

    stamps_ns: np.ndarray  # [N] int64, ascending.
    files: list[str]  # Paths of the N images, relative to the folder of the sequence.


class TumSequence(Sequence):
    """TUM sequence of color images, each with the nearest depth image within 20 ms.

    The stamp of a frame is the stamp of the color image.
    """

    def __init__(self, folder: Path) -> None:
        """Open the sequence of a folder."""
        self._folder = folder
        color, depth = _listing(folder / "rgb.txt"), _listing(folder / "depth.txt")
        pairs = pair_by_stamp(
            folder,
            ("color images", color.stamps_ns),
            ("depth images", depth.stamps_ns),
            "Check the stamps in rgb.txt and depth.txt.",
        )
        self._files = [(color.files[i], depth.files[j]) for i, j in pairs]
        calibration = _calibration(folder, [folder / file for file, _ in self._files])
        self.depth_scale = calibration.depth_scale
        super().__init__(name_of(folder), calibration.camera, color.stamps_ns[pairs[:, 0]])
        self.depth_offsets_ns = depth.stamps_ns[pairs[:, 1]] - self.stamps_ns

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        color_file, depth_file = self._files[index]
        return RawFrame(
            index,
            int(self.stamps_ns[index]),
            read_color(self._folder / color_file),
            read_depth(self._folder / depth_file),
            self.depth_scale,
            self.raw_camera,
        )

    def truth(self) -> Trajectory | None:
        """Return the trajectory of groundtruth.txt, or None if the file does not exist."""
        path = self._folder / "groundtruth.txt"
        return Trajectory.load(path) if path.is_file() else None


def _listing(path: Path) -> _Listing:
    """Read rgb.txt or depth.txt: lines of `stamp file`, which are sorted by stamp.

    Raises:
        DataError: The file cannot be read, or a line is invalid.
    """
    rows = sorted(_row(path, line_number, line) for line_number, line in read_lines(path))
    return _Listing(np.array([stamp for stamp, _ in rows], np.int64), [file for _, file in rows])


def _row(path: Path, line_number: int, line: str) -> tuple[int, str]:
    words = line.split(maxsplit=1)
    try:
        stamp_ns, name = parse_stamp(words[0]), words[1].strip()
        if "\0" in name:
            raise ValueError(line)
    except (ValueError, IndexError):
        raise DataError(
            f"{path}, line {line_number}: expected `stamp file`, such as `1305031102.175 "
            f"rgb/1.png`, found {line[:80]!r}. Correct this line."
        ) from None
    if inside(path.parent, name) is None:
        raise DataError(
            f"{path}, line {line_number}: {name[:80]} is outside the folder. Copy or link the "
            "images into the folder."
        )
    return stamp_ns, name


def _calibration(folder: Path, color: list[Path]) -> Calibration:
    path = folder / "camera.json"
    if path.is_file():
        fields = read_json(path)
        scale = number(fields, "depth_scale", path) if "depth_scale" in fields else DEPTH_SCALE
        return Calibration(pinhole(fields, "width", "height", path), scale)
    eth3d = folder / "calibration.txt"
    if eth3d.is_file():
        return Calibration(_pinhole_of_eth3d(eth3d, first_size(color)), DEPTH_SCALE)
    names = f"{name_of(folder)} {folder.resolve().name}"
    recording = re.search("|".join(PUBLISHED_CAMERAS), names)
    if recording is None:
        raise DataError(
            f"the intrinsics of {folder} are missing: it has no camera.json, and its name contains "
            "none of freiburg1, freiburg2, freiburg3 and rgbd_bonn (recordings with published "
            f"intrinsics). Create {path} with content such as {CAMERA_JSON}."
        )
    return Calibration(PUBLISHED_CAMERAS[recording[0]], DEPTH_SCALE)


def _pinhole_of_eth3d(path: Path, size: tuple[int, int]) -> Camera:
    """Read the camera of calibration.txt, for images of a width and a height."""
    try:
        fx, fy, cx, cy = (float(word) for word in path.read_text().split())
    except (OSError, ValueError) as error:
        raise DataError(
            f"{path} cannot be read as the four numbers `fx fy cx cy`: {error}. Copy or download "
            "the file again."
        ) from error
    try:
        return Camera(*size, fx, fy, cx, cy)
    except DataError as error:
        raise DataError(f"{path} has invalid intrinsics: {error}") from error
