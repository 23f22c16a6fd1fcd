"""Walk past four offices that look alike, with returns to offices that it has visited before.

The offices are visited in the order 0, 2, 1, 3, 2, 1, 0. The last three visits are returns.
"""

import numpy as np

from .twins import section_x_m
from .walk import CameraPath, hand_held

FRAMES = 720
WALK_M_S = 1.1  # Speed of walking; the walk through the flat is slower.

# Knots of a visit relative to the section: x, y, z in meters, then the viewing direction. The
# camera looks to the left first; a visit that goes the other way is a mirror image.
VISIT = np.array(
    [
        [-0.55, -0.15, 1.46, 0.62, 0.78, -0.10],
        [-0.10, 0.45, 1.44, 0.05, 0.99, -0.14],
        [0.00, 1.15, 1.45, -0.55, 0.83, -0.20],
        [0.06, 1.50, 1.47, 0.05, 0.97, -0.24],
        [0.02, 1.20, 1.45, 0.66, 0.74, -0.20],
        [0.08, 0.50, 1.44, 0.35, 0.93, -0.12],
        [0.45, -0.10, 1.46, 0.72, 0.69, -0.08],
    ]
)
MIRROR = np.array([-1, 1, 1, -1, 1, 1])
# Stations of the walk: the number of an office, and the direction along x in which the walk
# goes on. A station with `False` is passed without a visit.
STATIONS = (
    (0, 1, True),
    (1, 1, False),
    (2, 1, True),
    (3, 1, False),
    (3, -1, False),
    (2, -1, False),
    (1, -1, False),
    (0, -1, False),
    (0, 1, False),
    (1, 1, True),
    (2, 1, False),
    (3, 1, True),
    (3, -1, False),
    (2, -1, True),
    (1, -1, True),
    (0, -1, True),
)
# Knot of a section that is passed without a visit.
PASSED = np.array([0.0, -0.2, 1.46, 0.87, 0.48, -0.10])


def knots() -> np.ndarray:
    """Return the knots of the walk in the world frame, [K, 6].

    The columns are the camera center x, y, z in meters and the viewing direction x, y, z.
    """
    rows = []
    for office, direction, visited in STATIONS:
        there = VISIT if visited else PASSED[None]
        there = there * MIRROR if direction < 0 else there
        rows.append(there + np.array([section_x_m(office), 0, 0, 0, 0, 0]))
    return np.concatenate(rows)


def twins_walk(seed: int) -> CameraPath:
    """Return a walk along the four equal offices; `seed` determines sway and tremor of the hand."""
    return hand_held(seed, knots(), FRAMES, WALK_M_S)
