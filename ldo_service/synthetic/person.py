"""Person who walks through the room, built from upright solids that swing with the steps."""

from dataclasses import dataclass

import numpy as np

from .solids import Shape, Solid

SPEED_M_S = 1.0
STEP_M = 0.7  # Length of a step.
SWING_M = 0.28  # Amplitude of a foot along the path, relative to the hips.
ARM_SWING_M = 0.2  # Amplitude of a forearm along the path, relative to the hips.
# Path of the feet on the floor, x and y in meters. The person enters through the left wall, walks
# past the sofa and leaves through the right wall.
WAY_M = np.array([[-3.1, 0.9], [0.6, 0.9], [1.3, 0.25], [3.2, 0.0]])


@dataclass(frozen=True, slots=True)
class Part:
    """One solid of a body that faces +x and stands at the origin."""

    shape: Shape
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    texture: str
    swing_m: float = 0.0  # Amplitude along x; negative in the opposite phase, 0 for no swing.


def _both_sides(
    shape: Shape,
    center_m: tuple[float, float, float],
    size_m: tuple[float, float, float],
    texture: str,
    swing_m: float,
) -> tuple[Part, Part]:
    x, y, z = center_m
    return (
        Part(shape, (x, y, z), size_m, texture, swing_m),
        Part(shape, (x, -y, z), size_m, texture, -swing_m),
    )


BODY = (
    Part("ball", (0, 0, 1.63), (0.2, 0.17, 0.25), "skin"),
    Part("cylinder", (0, 0, 1.48), (0.11, 0.11, 0.12), "skin"),
    Part("cylinder", (0, 0, 1.19), (0.24, 0.38, 0.52), "shirt"),
    Part("ball", (0, 0, 0.92), (0.26, 0.36, 0.26), "trousers"),
    *_both_sides("cylinder", (0, 0.09, 0.68), (0.17, 0.16, 0.48), "trousers", 0.4 * SWING_M),
    *_both_sides("cylinder", (0, 0.09, 0.26), (0.13, 0.12, 0.44), "trousers", 0.85 * SWING_M),
    *_both_sides("box", (0.05, 0.09, 0.04), (0.26, 0.1, 0.08), "shoes", SWING_M),
    *_both_sides("cylinder", (0, 0.24, 1.26), (0.1, 0.1, 0.34), "shirt", -0.4 * ARM_SWING_M),
    *_both_sides("cylinder", (0, 0.25, 0.97), (0.08, 0.08, 0.3), "skin", -ARM_SWING_M),
)


def person_at(time_s: float) -> tuple[Solid, ...]:
    """Return the solids of the person at `time_s` seconds after the start of the path `WAY_M`.

    After the end of the path, the person stays outside the room, hidden by the wall.
    """
    foot_m, heading, walked_m = _placed(time_s)
    swing = _swing(walked_m / STEP_M)
    return tuple(_in_world(part, foot_m, heading, swing) for part in BODY)


def _placed(time_s: float) -> tuple[np.ndarray, tuple[float, float], float]:
    """Return the position [2] on the floor, the heading and the walked distance in meters."""
    legs = np.diff(WAY_M, axis=0)
    lengths = np.sqrt(legs[:, 0] * legs[:, 0] + legs[:, 1] * legs[:, 1])
    ends = np.cumsum(lengths)
    walked_m = min(max(SPEED_M_S * time_s, 0.0), float(ends[-1]))
    leg = min(int(np.searchsorted(ends, walked_m)), len(legs) - 1)
    direction = legs[leg] / lengths[leg]
    foot_m = WAY_M[leg] + direction * (walked_m - (ends[leg] - lengths[leg]))
    return foot_m, (float(direction[0]), float(direction[1])), walked_m


def _swing(steps: float) -> float:
    """Return the phase of the swing, -1..1, with a period of two steps.

    The curve consists of parabolas, because the bits of a sine differ between machines.
    """
    phase = steps % 2.0
    side, t = (1.0, phase) if phase < 1 else (-1.0, phase - 1.0)
    return side * 4 * t * (1 - t)


def _in_world(part: Part, foot_m: np.ndarray, heading: tuple[float, float], swing: float) -> Solid:
    (c, s), (x, y, z) = heading, part.center_m
    x = x + part.swing_m * swing
    center_m = (float(foot_m[0]) + c * x - s * y, float(foot_m[1]) + s * x + c * y, z)
    return Solid(part.shape, center_m, part.size_m, part.texture, heading)
