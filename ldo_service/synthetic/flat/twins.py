"""Four offices that look alike, along a corridor of four sections that look alike.

World frame: x along the corridor, y across the corridor toward the offices, z up; the origin is the
center of the corridor's floor.

A shift along x by the width of an office maps the building onto itself, except for its two ends.
The same holds for the textures and for the furniture that all offices or all sections have. Only
the objects of `OFFICE_OBJECTS` and `SECTION_OBJECTS` differ. Geometry and most of the appearance
of a view therefore fit every office equally well.
"""

import numpy as np

from ldo_service.synthetic.solids import Solid

from .building import HEIGHT_M, WALL_M, Panel, level, wall_slab
from .furnishing import ASKEW, BACK, DOOR, LEFT, RIGHT, TURNED, Row, built, placed_in
from .paint import Materials, materials
from .scene import Flat
from .scene_object import WALL, Placement, SceneObject

OFFICES = 4
PITCH_M = 2.4  # Distance between the centers of two neighboring offices.
OFFICE_SIZE_M = (PITCH_M - 2 * WALL_M, 2.7)
CORRIDOR_WIDTH_M = 1.7
DOORWAY_M, LINTEL_M = 1.2, 2.1  # Width and height of the doorways.
_DOOR_WALL_M = CORRIDOR_WIDTH_M / 2 + 2 * WALL_M  # y of the office side of the door wall.
_LENGTH_M = OFFICES * PITCH_M
SHELL = Solid("box", (0.0, 1.0, 1.2), (_LENGTH_M + 2.0, 8.0, 4.0), "")  # It is never visible.

# Rows in the frame of an office: origin on the floor at the middle of the door wall, y into the
# office.
OFFICE: tuple[Row, ...] = (
    ("dining table", 2, (0.0, 2.34, 0), DOOR),
    ("chair", 2, (0.05, 1.75, 0), BACK),
    ("keyboard", 0, (0.0, 2.2, 0.74), DOOR),
    ("picture frame", 1, (-0.1, 2.7, 1.75), DOOR),
    ("shelf", 0, (-0.96, 1.75, 0), RIGHT),
    ("book", 2, (-0.98, 1.7, 1.465), RIGHT),
    ("book", 2, (-0.98, 1.82, 1.125), RIGHT),
    ("book", 1, (-0.96, 1.95, 0.785), RIGHT),
    ("cabinet", 0, (0.9, 1.2, 0), LEFT),
    ("picture frame", 0, (1.14, 1.2, 1.75), LEFT),
    ("radiator", 0, (-1.08, 0.75, 0), RIGHT),
    ("rug", 1, (0.0, 0.9, 0), ASKEW),
)
OFFICE_OBJECTS: tuple[tuple[Row, ...], ...] = (
    (
        ("globe", 0, (-0.5, 2.4, 0.74), DOOR),
        ("printer", 0, (0.46, 2.42, 0.74), DOOR),
        ("teddy bear", 0, (0.9, 0.95, 0.84), LEFT),
        ("vase", 0, (0.92, 1.5, 0.84), LEFT),
        ("potted plant", 0, (-0.85, 0.35, 0), TURNED),
        ("clock", 0, (0.72, 2.7, 1.7), DOOR),
    ),
    (
        ("toaster", 0, (-0.5, 2.4, 0.74), ASKEW),
        ("tv", 1, (0.42, 2.6, 0.74), DOOR),
        ("microwave", 0, (0.92, 1.35, 0.84), LEFT),
        ("backpack", 0, (-0.85, 0.35, 0), RIGHT),
        ("fan", 0, (0.92, 2.3, 0), LEFT),
    ),
    (
        ("speaker", 1, (-0.52, 2.42, 0.74), DOOR),
        ("lamp", 1, (0.46, 2.4, 0.74), DOOR),
        ("bowl", 0, (0.9, 0.95, 0.84), LEFT),
        ("globe", 0, (0.92, 1.45, 0.84), LEFT),
        ("fire extinguisher", 0, (-0.9, 0.3, 0), RIGHT),
        ("clock", 1, (0.72, 2.7, 1.7), DOOR),
    ),
    (
        ("microwave", 0, (-0.45, 2.42, 0.74), DOOR),
        ("vase", 1, (0.46, 2.4, 0.74), DOOR),
        ("printer", 0, (0.9, 1.3, 0.84), LEFT),
        ("suitcase", 0, (-0.88, 0.35, 0), RIGHT),
        ("trash can", 1, (0.92, 2.3, 0), DOOR),
    ),
)
# Rows in the frame of a section of the corridor: origin on the floor in the middle. The walk
# looks at the door wall, at +y.
SECTION: tuple[Row, ...] = (
    ("radiator", 0, (0.0, -0.78, 0), BACK),
    ("picture frame", 1, (0.0, -0.85, 1.7), BACK),
    ("picture frame", 2, (0.92, 0.85, 1.6), DOOR),
)
SECTION_OBJECTS: tuple[tuple[Row, ...], ...] = (
    (("fire extinguisher", 0, (0.72, 0.72, 0), DOOR), ("umbrella", 0, (-0.85, 0.72, 0), DOOR)),
    (("cardboard box", 1, (-0.8, 0.64, 0), DOOR),),
    (("trash can", 0, (0.95, 0.68, 0), DOOR), ("coat rack", 0, (-0.95, 0.62, 0), DOOR)),
    (("potted plant", 2, (-0.9, 0.62, 0), DOOR), ("suitcase", 0, (0.95, 0.68, 0), DOOR)),
)


def section_x_m(number: int) -> float:
    """Return the x coordinate of the center of office `number` and of its corridor section."""
    return (number - (OFFICES - 1) / 2) * PITCH_M


def furnished_twins(seed: int) -> Flat:
    """Return the building of four equal offices; `seed` determines its textures and materials.

    Rooms 0 to 3 are the offices, rooms 4 to 7 the sections of the corridor.
    """
    paint = Materials(np.random.default_rng([seed, 0]))
    office, section = built(OFFICE, paint), built(SECTION, paint)
    things: list[tuple[SceneObject, int]] = []
    for number in range(OFFICES):
        inside, outside = _frames(number)
        own = built(OFFICE_OBJECTS[number], paint), built(SECTION_OBJECTS[number], paint)
        things += [(thing, number) for thing in placed_in([*office, *own[0]], inside)]
        things += [(thing, OFFICES + number) for thing in placed_in([*section, *own[1]], outside)]
    centers_m = [(section_x_m(k), _DOOR_WALL_M + OFFICE_SIZE_M[1] / 2) for k in range(OFFICES)]
    centers_m += [(section_x_m(k), 0.0) for k in range(OFFICES)]
    return Flat(
        panels=tuple(panel for number in range(OFFICES) for panel in _panels(number)),
        things=tuple(thing for thing, _ in things),
        rooms=tuple(room for _, room in things),
        textures=materials(seed),
        lamps_m=tuple((x, y, HEIGHT_M - 0.15) for x, y in centers_m),
        shell=SHELL,
    )


def _frames(number: int) -> tuple[Placement, Placement]:
    """Return the frames of an office and of its section of the corridor."""
    x_m = section_x_m(number)
    return Placement((x_m, _DOOR_WALL_M, 0.0)), Placement((x_m, 0.0, 0.0))


def _panels(number: int) -> list[Panel]:
    """Return the panels of an office and of its section, the ends of the corridor included."""
    inside, outside = _frames(number)
    width_m, depth_m = OFFICE_SIZE_M
    office = [
        *((slab, 3) for slab in _door_wall(width_m, -WALL_M / 2, "wall_a")),
        (wall_slab((0, depth_m + WALL_M / 2), (width_m, WALL_M), "wall_a"), 2),
        (wall_slab((-(width_m + WALL_M) / 2, depth_m / 2), (WALL_M, depth_m), "wall_a"), 1),
        (wall_slab(((width_m + WALL_M) / 2, depth_m / 2), (WALL_M, depth_m), "wall_a"), 0),
    ]
    half_m = CORRIDOR_WIDTH_M / 2
    section = [
        *((slab, 2) for slab in _door_wall(PITCH_M, half_m + WALL_M / 2, "wall_c")),
        (wall_slab((0, -half_m - WALL_M / 2), (PITCH_M, WALL_M), "wall_c"), 3),
    ]
    end_m = (PITCH_M + WALL_M) / 2
    if number == 0:
        section.append((wall_slab((-end_m, 0), (WALL_M, CORRIDOR_WIDTH_M), "wall_b"), 1))
    if number == OFFICES - 1:
        section.append((wall_slab((end_m, 0), (WALL_M, CORRIDOR_WIDTH_M), "wall_b"), 0))
    return [
        *(Panel(inside(slab), WALL, face, number) for slab, face in office),
        *level(inside, number, (0, depth_m / 2), (PITCH_M, depth_m + 2 * WALL_M), "floor_a"),
        *(Panel(outside(slab), WALL, face, OFFICES + number) for slab, face in section),
        *level(outside, OFFICES + number, (0, 0), (PITCH_M, 2 * half_m + 2 * WALL_M), "floor_c"),
    ]


def _door_wall(length_m: float, y_m: float, paint: str) -> list[Solid]:
    """Return the slabs left of, right of and above a doorway in the middle of a wall along x."""
    side_m = (length_m - DOORWAY_M) / 2
    at_m = (DOORWAY_M + side_m) / 2
    above_m = HEIGHT_M - LINTEL_M
    return [
        wall_slab((-at_m, y_m), (side_m, WALL_M), paint),
        wall_slab((at_m, y_m), (side_m, WALL_M), paint),
        Solid("box", (0.0, y_m, HEIGHT_M - above_m / 2), (DOORWAY_M, WALL_M, above_m), paint),
    ]
