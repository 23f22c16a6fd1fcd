"""Paths of a hand-held camera through the room."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Path:
    """Closed camera path through M knots; world z is up."""

    eyes_m: np.ndarray  # Camera positions [M, 3] in the world.
    targets_m: np.ndarray  # Points [M, 3] in the world that the camera looks at.


# A sweep over the room and back on another path; the camera sees the same walls twice.
LOOK_AROUND = Path(
    eyes_m=np.array(
        [
            [-0.2, -1.1, 1.35],
            [-0.1, -1.15, 1.4],
            [0.1, -1.1, 1.5],
            [0.1, -0.85, 1.45],
            [-0.1, -0.7, 1.3],
            [-0.3, -0.8, 1.25],
            [-0.4, -1.0, 1.3],
        ]
    ),
    targets_m=np.array(
        [
            [-0.9, 1.6, 0.65],
            [0.0, 1.6, 0.7],
            [1.4, 1.2, 0.8],
            [2.3, 0.4, 0.75],
            [1.5, 1.2, 0.7],
            [0.0, 1.4, 0.6],
            [-1.0, 1.3, 0.55],
        ]
    ),
)

# One turn that shows all four walls and ends close to its start.
TOUR = Path(
    eyes_m=np.array(
        [
            [-0.2, -1.0, 1.35],
            [0.3, -0.9, 1.45],
            [0.7, -0.4, 1.5],
            [0.7, 0.3, 1.5],
            [0.3, 0.9, 1.4],
            [-0.4, 1.0, 1.35],
            [-0.9, 0.5, 1.4],
            [-0.8, -0.4, 1.35],
        ]
    ),
    targets_m=np.array(
        [
            [-0.6, 1.8, 0.7],
            [1.3, 1.6, 0.8],
            [2.6, 0.6, 0.8],
            [2.4, -1.3, 0.8],
            [0.9, -2.0, 0.9],
            [-1.2, -2.0, 0.8],
            [-2.6, -0.9, 1.0],
            [-2.3, 1.2, 0.9],
        ]
    ),
)

# Small motion; most surfaces stay in view.
LINGER = Path(
    eyes_m=np.array(
        [
            [-0.4, -1.2, 1.35],
            [-0.1, -1.05, 1.42],
            [0.15, -1.15, 1.48],
            [0.1, -0.95, 1.38],
            [-0.2, -0.9, 1.3],
            [-0.45, -1.05, 1.32],
        ]
    ),
    targets_m=np.array(
        [
            [-0.9, 1.6, 0.8],
            [-0.4, 1.7, 0.9],
            [0.2, 1.6, 0.85],
            [0.7, 1.5, 0.75],
            [0.2, 1.4, 0.7],
            [-0.5, 1.5, 0.75],
        ]
    ),
)

SWAY_FRAMES = 8  # Frames per knot of the hand's sway, 0.27 s at 30 Hz.
SWAY_EYE_M = 0.008
SWAY_TARGET_M = 0.03


def poses(path: Path, count: int, seed: int) -> np.ndarray:
    """Return T_world_camera [count, 4, 4] for a round on a path; `seed` sets the hand's sway."""
    rng = np.random.default_rng(seed)
    along = np.arange(count) * (len(path.eyes_m) / count)
    eyes = closed_spline(path.eyes_m, along) + _sway(rng, count, SWAY_EYE_M)
    targets = closed_spline(path.targets_m, along) + _sway(rng, count, SWAY_TARGET_M)
    return np.array([look_at(eye, target) for eye, target in zip(eyes, targets, strict=True)])


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return T_world_camera [4, 4] at `eye`, with z axis toward `target` and a level horizon."""
    z = _unit(target - eye)
    x = _unit(np.array([z[1], -z[0], 0.0]))
    y = np.array([z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]])
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, y, z, eye
    return T


def looking(eyes: np.ndarray, gazes: np.ndarray, rolls: np.ndarray) -> np.ndarray:
    """Return T_world_camera [N, 4, 4] with the z axis along the gaze, rolled by small angles.

    Args:
        eyes: Camera centers [N, 3].
        gazes: Viewing directions [N, 3], of any length.
        rolls: Angles [N] about the gaze, radians; must be small.
    """
    z = gazes / lengths(gazes)[:, None]
    level = np.stack([z[:, 1], -z[:, 0], np.zeros(len(z))], axis=1)
    level = level / lengths(level)[:, None]
    x = level + rolls[:, None] * _crosses(z, level)
    x = x / lengths(x)[:, None]
    T = np.zeros((len(eyes), 4, 4))
    T[:, 3, 3] = 1.0
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2], T[:, :3, 3] = x, _crosses(z, x), z, eyes
    return T


def lengths(v: np.ndarray) -> np.ndarray:
    """Return the lengths [N] of vectors [N, 3]."""
    x, y, z = v.T
    return np.sqrt(x * x + y * y + z * z)


def _crosses(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    x, y, z = a.T
    p, q, r = b.T
    return np.stack([y * r - z * q, z * p - x * r, x * q - y * p], axis=1)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def _sway(rng: np.random.Generator, count: int, amplitude_m: float) -> np.ndarray:
    knots = rng.random((max(4, count // SWAY_FRAMES), 3)) * 2 - 1
    return amplitude_m * closed_spline(knots, np.arange(count) * (len(knots) / count))


def closed_spline(knots: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return points of the closed Catmull-Rom spline through the knots.

    Args:
        knots: Knots [M, D].
        along: Positions [P] on the spline in 0..M; whole numbers are knots.

    Returns:
        Points [P, D].
    """
    cell = along.astype(np.int64)
    t = (along - cell)[:, None]
    a, b, c, d = (knots[(cell + i) % len(knots)] for i in (-1, 0, 1, 2))
    return b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
