"""Walk of a hand-held camera on a closed path.

The default path leads through the flat. It visits each of the two rooms twice and passes the
corridor between the rooms.
"""

from dataclasses import dataclass

import numpy as np

from ldo_service.synthetic.path import closed_spline, lengths, looking

RATE_HZ = 15
FRAMES = 640  # Frames of the walk through the flat.

# Knots of a way around room A and along the corridor to the door of room B. Each knot has the
# camera position x, y, z in meters and the viewing direction x, y, z. A half turn about the world's
# z axis gives the way around room B and back to the door of room A.
FIRST_HALF = np.array(
    [
        # Room A, from left to right.
        [-1.15, 1.00, 1.42, -0.72, 0.69, -0.12],
        [-1.34, 1.55, 1.45, -0.42, 0.91, -0.16],
        [-1.30, 2.10, 1.48, 0.10, 0.99, -0.20],
        [-0.92, 2.45, 1.46, 0.60, 0.80, -0.20],
        [-0.48, 2.25, 1.42, 0.95, 0.31, -0.18],
        [-0.55, 1.70, 1.42, 0.97, -0.26, -0.16],
        [-0.92, 1.20, 1.45, 0.62, -0.78, -0.12],
        # Corridor.
        [-1.02, 0.60, 1.48, 0.50, -0.86, -0.10],
        [-0.72, 0.12, 1.50, 0.87, -0.50, -0.08],
        [-0.15, -0.03, 1.46, 0.99, -0.10, -0.08],
        [0.45, -0.05, 1.44, 0.99, -0.14, -0.10],
        [0.92, -0.38, 1.42, 0.90, -0.44, -0.12],
    ]
)
SECOND_HALF = np.array(
    [
        # Room A, from right to left.
        [-1.05, 1.05, 1.40, -0.18, 0.98, -0.16],
        [-0.80, 1.55, 1.38, -0.10, 0.99, -0.20],
        [-0.82, 2.10, 1.42, -0.50, 0.86, -0.20],
        [-1.20, 2.42, 1.46, -0.86, 0.50, -0.16],
        [-1.58, 2.15, 1.48, -0.99, -0.10, -0.16],
        [-1.50, 1.60, 1.50, -0.72, -0.68, -0.16],
        [-1.22, 1.10, 1.46, -0.10, -0.98, -0.14],
        # Corridor.
        [-1.00, 0.55, 1.42, 0.22, -0.97, -0.08],
        [-0.66, 0.10, 1.44, 0.78, -0.62, -0.10],
        [-0.10, 0.05, 1.48, 0.98, -0.20, -0.08],
        [0.48, 0.02, 1.50, 0.98, -0.20, -0.08],
        [0.95, -0.35, 1.46, 0.60, -0.80, -0.12],
    ]
)
HALF_TURN = np.array([-1, -1, 1, -1, -1, 1])
KNOTS = np.concatenate([FIRST_HALF, FIRST_HALF * HALF_TURN, SECOND_HALF, SECOND_HALF * HALF_TURN])

# Relative speeds of walking and turning. A step takes a time for its length and a time for its
# turn; its duration is the root of the sum of their squares.
WALK_M_S, TURN_RAD_S = 0.63, 1.02
STEPS_PER_KNOT = 64  # Resolution of the table that maps time to a position on the path.

# Hand shake, as a slow sway and a quick tremor: period in seconds, amplitude of the camera
# center in meters, and amplitude of the viewing direction.
SWAY_S, SWAY_EYE_M, SWAY_GAZE = 0.6, 0.012, 0.022
TREMOR_S, TREMOR_EYE_M, TREMOR_GAZE = 0.2, 0.0015, 0.004


@dataclass(frozen=True, slots=True)
class CameraPath:
    """Motion along a closed camera path; one round takes `frames` frames."""

    # Knots of a closed spline in the world frame, [K, 6]: camera center x, y, z in meters, and
    # viewing direction.
    knots: np.ndarray
    frames: int
    # Position on the spline at M + 1 equal steps of time, [M + 1]: 1.5 is halfway from knot 1 to 2.
    along: np.ndarray
    # Hand shake: knots [S, 7] of closed splines, at equal steps of time, that are added to camera
    # center, viewing direction and roll.
    shakes: tuple[np.ndarray, ...]

    def pose(self, frame: float) -> np.ndarray:
        """Return T_world_camera [4, 4] at frame index `frame`, which may be fractional."""
        turn = frame / self.frames % 1.0
        x = turn * (len(self.along) - 1)
        cell = int(x)
        place = self.along[cell] + (x - cell) * (self.along[cell + 1] - self.along[cell])
        state = np.append(_at(self.knots, place), 0.0)
        for knots in self.shakes:
            state = state + _at(knots, turn * len(knots))
        return looking(state[None, :3], state[None, 3:6], state[None, 6])[0]


def hand_held(
    seed: int, knots: np.ndarray = KNOTS, frames: int = FRAMES, walk_m_s: float = WALK_M_S
) -> CameraPath:
    """Return a walk with the sway and tremor of a hand.

    Args:
        seed: Seed of sway and tremor.
        knots: Camera center in meters and viewing direction along the closed path, [K, 6].
        frames: Number of frames of the walk.
        walk_m_s: Speed of walking, m/s. Only the ratio to the speed of turning, TURN_RAD_S,
            matters, because the walk always takes `frames` frames.
    """
    rng = np.random.default_rng([seed, 2])
    sway = _shake(rng, frames, SWAY_S, SWAY_EYE_M, SWAY_GAZE)
    tremor = _shake(rng, frames, TREMOR_S, TREMOR_EYE_M, TREMOR_GAZE)
    return CameraPath(knots, frames, timed_positions(knots, walk_m_s), (sway, tremor))


def _shake(
    rng: np.random.Generator, frames: int, period_s: float, eye_m: float, gaze: float
) -> np.ndarray:
    count = int(frames / RATE_HZ / period_s)
    return (rng.random((count, 7)) * 2 - 1) * ([eye_m] * 3 + [gaze] * 4)


def timed_positions(knots: np.ndarray = KNOTS, walk_m_s: float = WALK_M_S) -> np.ndarray:
    """Return positions on the closed spline through K knots at equal steps of time.

    The walk is divided into 64 * K steps of equal duration. The camera spends more steps on parts
    that are long or have a large turn. Only the ratio of walk_m_s to TURN_RAD_S matters, because
    the sequence scales the walk to the duration of the sequence.

    Args:
        knots: Camera center x, y, z in meters and viewing direction of each knot, [K, 6].
        walk_m_s: Speed of walking, m/s.

    Returns:
        Spline parameters [64 * K + 1] in knots; 1.5 is halfway from knot 1 to knot 2.
    """
    place = np.arange(len(knots) * STEPS_PER_KNOT + 1) / STEPS_PER_KNOT
    state = closed_spline(knots, place[:-1])
    state = np.concatenate([state, state[:1]])
    walked = lengths(np.diff(state[:, :3], axis=0)) / walk_m_s
    gaze = state[:, 3:] / lengths(state[:, 3:])[:, None]
    turned = lengths(np.diff(gaze, axis=0)) / TURN_RAD_S
    time = np.concatenate([[0.0], np.cumsum(np.sqrt(walked * walked + turned * turned))])
    wanted = np.arange(len(time)) * (time[-1] / (len(time) - 1))
    cell = np.clip(np.searchsorted(time, wanted, side="right") - 1, 0, len(time) - 2)
    share = (wanted - time[cell]) / (time[cell + 1] - time[cell])
    return place[cell] + share * (place[cell + 1] - place[cell])


def _at(knots: np.ndarray, place: float) -> np.ndarray:
    return closed_spline(knots, np.array([place % len(knots)]))[0]
