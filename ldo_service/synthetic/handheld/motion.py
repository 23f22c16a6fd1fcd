"""Motion of a hand-held camera as a function of time."""

from dataclasses import dataclass

import numpy as np

from ldo_service.synthetic.flat.walk import KNOTS, timed_positions
from ldo_service.synthetic.path import Path, closed_spline, lengths, looking

# Hand shake, as a slow sway and a quick tremor: period in seconds, amplitude of the camera
# center in meters, and amplitude of viewing direction and roll in radians.
SWAY_S, SWAY_EYE_M, SWAY_RAD = 0.6, 0.02, 0.06
TREMOR_S, TREMOR_EYE_M, TREMOR_RAD = 0.2, 0.002, 0.008


@dataclass(frozen=True, slots=True)
class HandMotion:
    """Motion along a closed camera path; one round takes `duration_s`."""

    # Knots of a closed spline in the world frame, [M, 6]: camera center x, y, z in meters, and
    # viewing direction.
    knots: np.ndarray
    # Position on the spline at K + 1 equal steps of time, [K + 1]: 1.5 is halfway from knot 1 to 2.
    along: np.ndarray
    duration_s: float
    # Hand shake: knots [S, 7] of closed splines, at equal steps of time, that are added to camera
    # center, viewing direction and roll.
    shakes: tuple[np.ndarray, ...]

    def poses(self, times_s: np.ndarray) -> np.ndarray:
        """Return T_world_camera [N, 4, 4] at times [N], seconds."""
        turn = times_s / self.duration_s
        turn = turn - np.floor(turn)
        x = turn * (len(self.along) - 1)
        cell = np.minimum(x.astype(np.int64), len(self.along) - 2)
        before, after = self.along[cell], self.along[cell + 1]
        place = before + (x - cell) * (after - before)
        state = np.zeros((len(times_s), 7))
        state[:, :6] = closed_spline(self.knots, _wrapped(place, len(self.knots)))
        state[:, 3:6] /= lengths(state[:, 3:6])[:, None]
        for knots in self.shakes:
            state += closed_spline(knots, _wrapped(turn * len(knots), len(knots)))
        return looking(state[:, :3], state[:, 3:6], state[:, 6])


def room_motion(path: Path, duration_s: float, seed: int) -> HandMotion:
    """Return the motion along a path through the room; `seed` determines the hand shake."""
    knots = np.concatenate([path.eyes_m, path.targets_m - path.eyes_m], axis=1)
    knots[:, 3:] /= lengths(knots[:, 3:])[:, None]
    along = np.arange(len(knots) + 1.0)
    return HandMotion(knots, along, duration_s, _shakes(duration_s, seed))


def flat_motion(duration_s: float, seed: int) -> HandMotion:
    """Return the walk through the flat; `seed` determines the hand shake."""
    return HandMotion(KNOTS, timed_positions(), duration_s, _shakes(duration_s, seed))


def _shakes(duration_s: float, seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng([seed, 7])
    periods = ((SWAY_S, SWAY_EYE_M, SWAY_RAD), (TREMOR_S, TREMOR_EYE_M, TREMOR_RAD))
    return tuple(
        (rng.random((int(duration_s / period_s), 7)) * 2 - 1) * ([eye_m] * 3 + [angle_rad] * 4)
        for period_s, eye_m, angle_rad in periods
    )


def _wrapped(place: np.ndarray, count: int) -> np.ndarray:
    return place - np.floor(place / count) * count
