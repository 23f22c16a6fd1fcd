"""Matrices and poses written as text, one row a line."""

from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, Trajectory, se3


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
    return se3.orthonormalised(T)


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
