"""File readers that several layouts share: numbered frames, matrices, intrinsics as JSON."""

import json
import logging
import os
import re
from dataclasses import dataclass
from decimal import Decimal
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, Trajectory, associate, se3

log = logging.getLogger(__name__)

# Maximum stamp difference of paired color and depth images; the value of TUM's associate.py.
MAX_SKEW_NS = 20_000_000
LAST_STAMP_NS = 2**63 - 1  # Maximum of int64, in the year 2262.
FRAME_RATE_HZ = 30  # Assumed rate of data sets without stamps: frame k is at k / 30 s.


def name_of(folder: Path) -> str:
    """Return the name of a folder as the user gave it; a link is not followed."""
    return Path(os.path.abspath(folder)).name


def parse_stamp(seconds: str) -> int:
    """Parse a stamp in seconds, and return it in nanoseconds.

    Raises:
        ValueError: The text is not a number, or the number is too large.
    """
    try:
        # The stamp is parsed as Decimal, because a float cannot hold nanoseconds since 1970.
        stamp_ns = int(Decimal(seconds.strip()) * 10**9)
    except ArithmeticError as error:
        raise ValueError(seconds) from error
    if abs(stamp_ns) > LAST_STAMP_NS:
        raise ValueError(seconds)
    return stamp_ns


def inside(folder: Path, name: str) -> Path | None:
    """Return the path of a file in a folder, or None if its name leads outside of the folder.

    Args:
        folder: Folder of the data set.
        name: Path of the file relative to `folder`, as the data set lists it.
    """
    path = Path(name)
    return None if path.is_absolute() or ".." in path.parts or "\0" in name else folder / path


@dataclass(frozen=True, slots=True)
class Calibration:
    """Intrinsics of a camera, with the scale of its stored depth."""

    camera: Camera
    depth_scale: float  # Units of the stored depth per meter.

    def __post_init__(self) -> None:
        if not (isfinite(self.depth_scale) and self.depth_scale > 0):
            raise DataError(
                f"the depth scale is {self.depth_scale}, expected the positive number of depth "
                "units per meter, such as 5000 (TUM) or 1000 (millimeters)."
            )


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that contains an object.

    Raises:
        DataError: The file cannot be read, or it does not contain an object.
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(
            f"{path} cannot be read as JSON: {error}. Copy or export it again."
        ) from error
    if not isinstance(content, dict):
        raise DataError(
            f"{path} contains a {type(content).__name__}, expected a JSON object. Copy or export "
            "it again."
        )
    return content


def number(fields: dict[str, Any], key: str, path: Path) -> float:
    """Return the number under a key of a JSON object.

    Args:
        fields: The object.
        key: The key.
        path: File of the object, for the error.

    Raises:
        DataError: The value is missing or not a finite number.
    """
    value = fields.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        found = "it is missing" if key not in fields else f"it is {value!r}"
        raise DataError(
            f'{path}: expected a finite number under "{key}", but {found}. Correct or replace '
            "the file."
        )
    return float(value)


def pinhole(fields: dict[str, Any], width: str, height: str, path: Path) -> Camera:
    """Return the camera that a JSON object describes.

    Args:
        fields: Object with the keys fx, fy, cx, cy and optionally distortion.
        width: Key of the width.
        height: Key of the height.
        path: File of the object, for errors.

    Raises:
        DataError: A value is missing or invalid.
    """
    distortion = fields.get("distortion", [])
    if not isinstance(distortion, list):
        raise DataError(
            f'{path}: "distortion" is {distortion!r}, expected a list [k1, k2, ...]. Correct the '
            "file."
        )
    coefficients = {f"distortion[{i}]": value for i, value in enumerate(distortion)}
    fx, fy, cx, cy = (number(fields, key, path) for key in ("fx", "fy", "cx", "cy"))
    size = _pixels(fields, width, path), _pixels(fields, height, path)
    k = tuple(number(coefficients, key, path) for key in coefficients)
    try:
        return Camera(*size, fx, fy, cx, cy, k)
    except DataError as error:
        raise DataError(f"{path} has invalid intrinsics: {error}") from error


def _pixels(fields: dict[str, Any], key: str, path: Path) -> int:
    """Return the number of pixels under a key of a JSON object; see `number`."""
    size = number(fields, key, path)
    if not size.is_integer():
        raise DataError(
            f'{path}: expected an integer under "{key}", found {size:g}. Correct the file.'
        )
    return int(size)


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines of a text file with their numbers, without empty lines and comments (#).

    Raises:
        DataError: The file cannot be read.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as text: {error}. Copy it again.") from error
    numbered_lines = ((number, line.strip()) for number, line in enumerate(lines, 1))
    return [(number, line) for number, line in numbered_lines if line and line[0] != "#"]


def read_matrix(path: Path, size: int) -> np.ndarray:
    """Read a matrix [size, size] float64 from a text file.

    The values may be NaN or infinity.

    Raises:
        DataError: The file cannot be read, or a line is invalid.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path} cannot be read as a matrix: {error}. Copy or export it again."
        ) from error
    rows = [_row(path, k, line, size) for k, line in enumerate(lines, 1) if line.strip()]
    if len(rows) != size:
        raise DataError(
            f"{path}, line {len(lines)}: the file has {len(rows)} rows, expected a {size}x{size} "
            "matrix with one row per line. Export or copy it again."
        )
    return np.array(rows)


def read_transform(path: Path) -> np.ndarray | None:
    """Read a rigid transform [4, 4] from a text file.

    Returns:
        The transform, or None if the file contains NaN or infinity, which mark an unknown pose.

    Raises:
        DataError: The file cannot be read, or the matrix is not a rigid transform.
    """
    T = read_matrix(path, 4)
    if not np.all(np.isfinite(T)):
        return None
    if not is_rigid(T):
        raise DataError(
            f"{path}, line 1: expected a rigid 4x4 transform by rows, found {T.tolist()}. "
            "Check that it consists of a rotation and a translation in meters."
        )
    return se3.orthonormalize(T)


def read_intrinsics(path: Path, size: int, image: tuple[int, int]) -> Camera:
    """Read a pinhole camera from an intrinsic matrix in a text file.

    Args:
        path: The file.
        size: Number of rows and columns of the matrix, 3 or 4.
        image: Width and height of the image in pixels.

    Raises:
        DataError: The file cannot be read, or the intrinsics are implausible.
    """
    K = read_matrix(path, size)
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    try:
        return Camera(*image, fx, fy, cx, cy)
    except DataError as error:
        raise DataError(f"{path} has invalid intrinsics: {error}") from error


def read_trajectory(stamps_ns: np.ndarray, paths: list[Path]) -> Trajectory | None:
    """Read the poses `T_world_camera` from one file per frame.

    Args:
        stamps_ns: Stamps of the frames, [N] int64.
        paths: Files of the poses, one per stamp. Frames without a file, or with an unknown pose,
            are skipped.

    Returns:
        The trajectory, or None if no frame has a pose.

    Raises:
        DataError: A file cannot be read, or it contains no rigid transform.
    """
    poses = [read_transform(path) if path.is_file() else None for path in paths]
    known = [k for k, T in enumerate(poses) if T is not None]
    if not known:
        return None
    return Trajectory(stamps_ns[known] / 1e9, np.array([poses[k] for k in known]))


def from_opengl(T_world_camera: np.ndarray) -> np.ndarray:
    """Convert camera poses [..., 4, 4] from the axes of OpenGL and ARKit to those of this project.

    The camera axes of OpenGL and ARKit are x right, y up, z backward. Those of this project are
    x right, y down, z forward.
    """
    return T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0])


def valid_trajectory(stamps_ns: np.ndarray, poses: list[np.ndarray | None]) -> Trajectory | None:
    """Return the trajectory of all poses that are rigid transforms; None if no pose is rigid.

    Args:
        stamps_ns: Stamps, [N] int64, ascending.
        poses: Transforms [4, 4], one per stamp; None where unknown.
    """
    valid = {k: se3.orthonormalize(T) for k, T in enumerate(poses) if T is not None and is_rigid(T)}
    if not valid:
        return None
    return Trajectory(stamps_ns[list(valid)] / 1e9, np.array(list(valid.values())))


def is_rigid(T: np.ndarray) -> bool:
    """Return whether T [4, 4] is a rigid transform, within the precision of text files."""
    if T.shape != (4, 4) or not np.all(np.isfinite(T)):
        return False
    R = T[:3, :3]
    return bool(
        np.allclose(R @ R.T, np.eye(3), atol=1e-3)
        and np.linalg.det(R) > 0
        and np.allclose(T[3], [0, 0, 0, 1], atol=1e-6)
    )


def _row(path: Path, line_number: int, line: str, size: int) -> list[float]:
    try:
        row = [_number(word) for word in line.split()]
    except ValueError:
        row = []
    if len(row) != size:
        raise DataError(
            f"{path}, line {line_number}: expected a row of {size} numbers, found {line[:80]!r}. "
            "Copy or export the file again."
        )
    return row


def _number(word: str) -> float:
    """Parse a number; -1.#INF and 1.#IND, as Windows programs write them, become NaN."""
    return float("nan") if ".#" in word else float(word)


@dataclass(frozen=True, slots=True)
class NumberedFrames:
    """Frames with both color and depth, in the order of the numbers in their file names."""

    numbers: np.ndarray  # [N] int64, ascending, with gaps where files are missing.
    color: list[Path]
    depth: list[Path]

    @property
    def stamps_ns(self) -> np.ndarray:
        """Stamps [N] int64 from the frame numbers; a missing number is a gap in time."""
        return self.numbers * 10**9 // FRAME_RATE_HZ


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Return the files of a folder by the number in the file name.

    Args:
        folder: The folder.
        pattern: Regular expression of the whole file name; its first group is the number.
    """
    matches = ((re.fullmatch(pattern, path.name), path) for path in sorted(folder.glob("*")))
    return {int(match[1]): path for match, path in matches if match}


def pair_by_number(color: dict[int, Path], depth: dict[int, Path], folder: Path) -> NumberedFrames:
    """Pair color and depth images whose file names contain the same number.

    Args:
        color: Files of color images by number.
        depth: Files of depth images by number.
        folder: Folder of the files, for messages.

    Raises:
        DataError: No number has both a color image and a depth image.
    """
    numbers = sorted(color.keys() & depth.keys())
    if not numbers:
        raise DataError(
            f"{folder} has {len(color)} color and {len(depth)} depth images, but no color image "
            "has the same number in its file name as a depth image. Check the file names."
        )
    alone = len(color) + len(depth) - 2 * len(numbers)
    if alone:
        log.info(
            "%s: skipping %d images; the color or depth image of the same number is missing.",
            *(folder, alone),
        )
    return NumberedFrames(
        np.array(numbers, np.int64), [color[k] for k in numbers], [depth[k] for k in numbers]
    )


def pair_by_stamp(
    source: Path, color: tuple[str, np.ndarray], depth: tuple[str, np.ndarray], advice: str
) -> np.ndarray:
    """Pair each color image with the nearest depth image within MAX_SKEW_NS.

    Args:
        source: Path of the recording, for messages.
        color: Name of the color images, and their stamps in ns, [N] int64.
        depth: Name of the depth images, and their stamps in ns, [M] int64.
        advice: What a user can do if no images can be paired.

    Returns:
        Indices of color and depth image, [K, 2].

    Raises:
        DataError: No color image has a depth image.
    """
    (color_name, color_ns), (depth_name, depth_ns) = color, depth
    pairs = associate(color_ns, depth_ns, MAX_SKEW_NS)
    if len(pairs) == 0:
        raise DataError(
            f"{source}: none of the {len(color_ns)} {color_name} is within 20 ms of any of the "
            f"{len(depth_ns)} {depth_name}. {advice}"
        )
    if len(pairs) < len(color_ns):
        log.info(
            "%s: skipping %d of %d %s, which have no depth image within 20 ms.",
            *(source, len(color_ns) - len(pairs), len(color_ns), color_name),
        )
    return pairs
