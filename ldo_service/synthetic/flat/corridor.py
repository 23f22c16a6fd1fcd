"""Long corridor with few features, and a walk to its end and back.

World frame: x along the corridor, y across it toward the wall with the doors, z up; the origin is
the center of the floor.

The corridor has 8 sections with weak texture and one door each. A shift along x by the
length of a section maps walls, floor, ceiling and doors onto themselves. Only the objects of
`OBJECTS` differ between the sections. The way back shows the doors and objects from the other side.
"""

import numpy as np

from ldo_service.synthetic.solids import Solid

from .building import HEIGHT_M, WALL_M, Panel, level, wall_slab
from .furnishing import DOOR, RIGHT, TURNED, Row, built, placed_in
from .paint import Materials, materials
from .scene import Flat
from .scene_object import WALL, Placement, SceneObject
from .walk import CameraPath, hand_held

SECTIONS = 8
PITCH_M = 2.0  # Length of a section.
WIDTH_M = 1.7
_LENGTH_M = SECTIONS * PITCH_M
SHELL = Solid("box", (0.0, 0.0, 1.2), (_LENGTH_M + 2.0, 4.0, 4.0), "")  # It is never visible.

# Rows in the frame of a section: origin on the floor in the middle. The walk looks at the wall at
# +y. A closed door stands in each section.
EQUAL: tuple[Row, ...] = (("door", 0, (-0.95, 0.83, 0), RIGHT),)
OBJECTS: tuple[tuple[Row, ...], ...] = (
    (("fire extinguisher", 0, (0.12, 0.72, 0), DOOR), ("potted plant", 2, (0.6, 0.58, 0), DOOR)),
    (("chair", 1, (0.5, 0.58, 0), DOOR), ("clock", 1, (0.5, 0.85, 1.6), DOOR)),
    (("fire extinguisher", 0, (0.12, 0.72, 0), DOOR), ("trash can", 0, (0.62, 0.66, 0), DOOR)),
    (("suitcase", 0, (0.5, 0.64, 0), DOOR),),
    (("fire extinguisher", 0, (0.12, 0.72, 0), DOOR), ("cardboard box", 1, (0.6, 0.62, 0), DOOR)),
    (("bench", 0, (0.45, 0.68, 0), DOOR), ("clock", 0, (0.45, 0.85, 1.6), DOOR)),
    (("fire extinguisher", 0, (0.12, 0.72, 0), DOOR), ("chair", 2, (0.62, 0.56, 0), DOOR)),
    (("potted plant", 0, (0.5, 0.56, 0), TURNED),),
)

FRAMES = 360
WALK_M_S = 1.1  # Speed of walking; the walk through the flat is slower.
# Knots of the walk: y and z of the camera center in meters, then the viewing direction. The way
# back is a mirror image of the way there.
_ALONG = (-0.3, 1.46, 0.75, 0.66, -0.22)
_TURNING = (-0.3, 1.46, 0.1, 0.99, -0.22)
# The walk turns this far from the middle.
_END_M = _LENGTH_M / 2 - 1.2


def section_x_m(number: int) -> float:
    """Return the x coordinate of the center of section `number`."""
    return (number - (SECTIONS - 1) / 2) * PITCH_M


def furnished_corridor(seed: int) -> Flat:
    """Return the corridor; `seed` determines its textures and materials.

    Each of its sections counts as a room; the room numbers are 0 to 7.
    """
    paint = Materials(np.random.default_rng([seed, 0]))
    equal = built(EQUAL, paint)
    things: list[tuple[SceneObject, int]] = []
    for number, rows in enumerate(OBJECTS):
        frame = Placement((section_x_m(number), 0.0, 0.0))
        things += [(thing, number) for thing in placed_in([*equal, *built(rows, paint)], frame)]
    return Flat(
        panels=tuple(panel for number in range(SECTIONS) for panel in _panels(number)),
        things=tuple(thing for thing, _ in things),
        rooms=tuple(room for _, room in things),
        textures=materials(seed),
        lamps_m=tuple((section_x_m(number), 0.0, HEIGHT_M - 0.15) for number in range(SECTIONS)),
        shell=SHELL,
    )


def _panels(number: int) -> list[Panel]:
    """Return the panels of a section, the ends of the corridor included."""
    put = Placement((section_x_m(number), 0.0, 0.0))
    across_m, end_m = (WIDTH_M + WALL_M) / 2, (PITCH_M + WALL_M) / 2
    slabs = [
        (wall_slab((0, across_m), (PITCH_M, WALL_M), "wall_c"), 2),
        (wall_slab((0, -across_m), (PITCH_M, WALL_M), "wall_c"), 3),
    ]
    if number == 0:
        slabs.append((wall_slab((-end_m, 0), (WALL_M, WIDTH_M), "wall_b"), 1))
    if number == SECTIONS - 1:
        slabs.append((wall_slab((end_m, 0), (WALL_M, WIDTH_M), "wall_b"), 0))
    return [
        *(Panel(put(slab), WALL, face, number) for slab, face in slabs),
        *level(put, number, (0, 0), (PITCH_M, WIDTH_M + 2 * WALL_M), "wall_a"),
    ]


def knots() -> np.ndarray:
    """Return the knots of the walk in the world frame, [K, 6].

    The columns are the camera center x, y, z in meters and the viewing direction x, y, z.
    """
    mirror = np.array([-1, 1, 1, -1, 1, 1])
    there_m = np.arange(-_END_M + PITCH_M / 2, _END_M, PITCH_M)
    there = [[-_END_M, *_TURNING], *([x_m, *_ALONG] for x_m in there_m)]
    return np.concatenate([there, np.array(there) * mirror])


def corridor_walk(seed: int) -> CameraPath:
    """Return a walk to the end of the corridor and back; `seed` determines sway and tremor."""
    return hand_held(seed, knots(), FRAMES, WALK_M_S)
