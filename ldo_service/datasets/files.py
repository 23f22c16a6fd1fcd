"""Files that several layouts share: numbered frames, matrices as text, intrinsics as JSON."""

import json
import logging
import re
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, Trajectory, se3

log = logging.getLogger(__name__)

FRAME_RATE_HZ = 30  # without stamps, frame k is said to be taken at k / 30 s


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera and the units of its stored depth per metre."""

    camera: Camera
    depth_scale: float

    def __post_init__(self) -> None:
        if not (isfinite(self.depth_scale) and self.depth_scale > 0):
            raise DataError(
                f"depth scale {self.depth_scale}: expected the positive number of depth units "
                "per metre, such as 5000 (TUM) or 1000 (millimetres)."
            )


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises DataError."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} cannot be read as JSON: {error}.") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} holds a {type(content).__name__}, expected a JSON object.")
    return content


def number(fields: dict[str, Any], key: str, path: Path) -> float:
    """The number under `key`. Raises DataError naming file and key."""
    value = fields.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        found = "it is missing" if key not in fields else f"it is {value!r}"
        raise DataError(f'{path}: expected a finite number under "{key}", but {found}.')
    return float(value)


def pinhole(fields: dict[str, Any], width: str, height: str, path: Path) -> Camera:
    """The camera under fx, fy, cx, cy, `width`, `height` and optional distortion."""
    distortion = fields.get("distortion", [])
    if not isinstance(distortion, list):
        raise DataError(f'{path}: "distortion" is {distortion!r}, expected a list [k1, k2, ...].')
    coefficients = {str(i): value for i, value in enumerate(distortion)}
    fx, fy, cx, cy = (number(fields, key, path) for key in ("fx", "fy", "cx", "cy"))
    size = round(number(fields, width, path)), round(number(fields, height, path))
    try:
        k = tuple(number(coefficients, key, path) for key in coefficients)
        return Camera(*size, fx, fy, cx, cy, k)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def read_matrix(path: Path, size: int) -> np.ndarray:
    """Matrix [size, size] float64, NaN and infinity included. Raises DataError with the line."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as a matrix: {error}.") from error
    rows = [_row(path, k, line, size) for k, line in enumerate(lines, 1) if line.strip()]
    if len(rows) != size:
        raise DataError(
            f"{path}, line {len(lines)}: the file ends after {len(rows)} rows, expected a "
            f"{size}x{size} matrix of one row a line. Export or copy it again."
        )
    return np.array(rows)


def read_transform(path: Path) -> np.ndarray | None:
    """Rigid transform [4, 4]; None where the file holds NaN or infinity: not known.

    Raises DataError for anything else that is not a rigid transform.
    """
    T = read_matrix(path, 4)
    if not np.all(np.isfinite(T)):
        return None
    if not is_rigid(T):
        raise DataError(
            f"{path}, line 1: expected a rigid 4x4 transform by rows, found {T.tolist()}. "
            "Check that it holds a rotation and a translation in metres."
        )
    return se3.orthonormalize(T)


def read_intrinsics(path: Path, size: int, image: tuple[int, int]) -> Camera:
    """The pinhole camera of a matrix [size, size] for an image of (width, height) pixels."""
    K = read_matrix(path, size)
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    try:
        return Camera(*image, fx, fy, cx, cy)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def read_trajectory(stamps_ns: np.ndarray, paths: list[Path]) -> Trajectory | None:
    """`T_world_camera` of the stamps [N] whose file exists and holds a pose; None without any."""
    poses = [read_transform(path) if path.is_file() else None for path in paths]
    known = [k for k, T in enumerate(poses) if T is not None]
    if not known:
        return None
    return Trajectory(stamps_ns[known] / 1e9, np.array([poses[k] for k in known]))


def is_rigid(T: np.ndarray) -> bool:
    """Whether T [4, 4] holds a rotation, to the digits that text files keep."""
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
            f"{path}, line {line_number}: expected a row of {size} numbers, found {line[:80]!r}."
        )
    return row


def _number(word: str) -> float:
    """As Python reads it, and -1.#INF or 1.#IND as Windows programs write what is no number."""
    return float("nan") if ".#" in word else float(word)


@dataclass(frozen=True, slots=True)
class NumberedFrames:
    """The frames that have both colour and depth, in order of their numbers.

    numbers  [N] int64, ascending; gaps where files are missing
    """

    numbers: np.ndarray
    color: list[Path]
    depth: list[Path]

    @property
    def stamps_ns(self) -> np.ndarray:
        """[N] int64; a gap in the numbers is a gap in time."""
        return self.numbers * 10**9 // FRAME_RATE_HZ


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of a folder whose whole name matches; the pattern's group is the number."""
    matches = ((re.fullmatch(pattern, path.name), path) for path in sorted(folder.glob("*")))
    return {int(match[1]): path for match, path in matches if match}


def pair_by_number(color: dict[int, Path], depth: dict[int, Path], folder: Path) -> NumberedFrames:
    """Frames of equal numbers. Raises DataError, which names `folder`, when there are none."""
    numbers = sorted(color.keys() & depth.keys())
    if not numbers:
        raise DataError(
            f"{folder} has {len(color)} images of colour and {len(depth)} of depth, and no number "
            "that has both. Check the names of the files."
        )
    alone = len(color) + len(depth) - 2 * len(numbers)
    if alone:
        log.info("%s: %d images have no partner of their number and are left out", folder, alone)
    return NumberedFrames(
        np.array(numbers, np.int64), [color[k] for k in numbers], [depth[k] for k in numbers]
    )
