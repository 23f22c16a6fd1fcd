"""Furniture of the flat: one row per object with class, shape number, position and heading.

Positions (meters) and headings are in the frame of the room.
"""

import numpy as np

from ldo_service.synthetic.flat.catalog import CATALOG

from .building import CORRIDOR, CORRIDOR_SIZE_M, ROOM_A, ROOM_B
from .paint import Materials
from .scene_object import Heading, Placement, SceneObject

Row = tuple[str, int, tuple[float, float, float], Heading]

# Headings, named after the wall that the front (-y) of an object faces: DOOR the door wall at -y,
# BACK the back wall at +y, RIGHT the wall at +x, LEFT the wall at -x. ASKEW and TURNED are oblique.
DOOR, BACK, RIGHT, LEFT = (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)
ASKEW, TURNED = (0.96, 0.28), (0.8, -0.6)

LIVING_ROOM: tuple[Row, ...] = (
    ("bed", 0, (-1.68, 2.78, 0), DOOR),
    ("teddy bear", 0, (-1.55, 2.6, 0.51), ASKEW),
    ("picture frame", 0, (-1.68, 3.8, 1.95), DOOR),
    ("lamp", 0, (-0.97, 3.5, 0), DOOR),
    ("couch", 0, (0.2, 3.36, 0), DOOR),
    ("cushion", 0, (0.72, 3.42, 0.47), ASKEW),
    ("cushion", 1, (-0.3, 3.42, 0.47), TURNED),
    ("remote", 0, (0.2, 3.15, 0.48), ASKEW),
    ("picture frame", 1, (0.2, 3.8, 1.85), DOOR),
    ("speaker", 0, (1.4, 3.64, 0), DOOR),
    ("cabinet", 0, (1.95, 3.0, 0), LEFT),
    ("tv", 0, (1.98, 3.0, 0.84), LEFT),
    ("window", 0, (2.2, 1.5, 1.5), LEFT),
    ("dining table", 0, (1.6, 1.5, 0), RIGHT),
    ("chair", 0, (1.6, 0.62, 0), BACK),
    ("chair", 1, (1.55, 2.35, 0), ASKEW),
    ("laptop", 0, (1.62, 1.25, 0.74), LEFT),
    ("cup", 0, (1.4, 1.62, 0.74), DOOR),
    ("bottle", 0, (1.75, 1.68, 0.74), DOOR),
    ("book", 0, (1.48, 1.9, 0.74), TURNED),
    ("cell phone", 0, (1.42, 1.42, 0.74), ASKEW),
    ("vase", 0, (1.8, 1.95, 0.74), DOOR),
    ("suitcase", 0, (2.0, 0.2, 0), BACK),
    ("shelf", 0, (-2.03, 0.75, 0), RIGHT),
    ("book", 2, (-2.05, 0.68, 1.465), RIGHT),
    ("book", 2, (-2.05, 0.8, 1.125), RIGHT),
    ("book", 1, (-2.03, 0.9, 0.785), RIGHT),
    ("speaker", 1, (-2.03, 0.5, 0.785), RIGHT),
    ("globe", 0, (-2.03, 0.8, 1.8), RIGHT),
    ("vase", 1, (-2.03, 0.5, 1.8), RIGHT),
    ("handbag", 0, (-2.02, 0.75, 0.105), RIGHT),
    ("potted plant", 1, (-1.9, 1.5, 0), TURNED),
    ("backpack", 0, (-1.4, 1.55, 0), RIGHT),
    ("sports ball", 0, (-1.45, 0.3, 0), DOOR),
    ("skateboard", 0, (-1.05, 0.04, 0), BACK),
    ("clock", 1, (-1.45, 0.0, 1.75), BACK),
    ("picture frame", 2, (-0.9, 0.0, 1.65), BACK),
    ("rug", 0, (0.1, 1.5, 0), ASKEW),
    ("door", 0, (0.4, 0.04, 0), RIGHT),
)

KITCHEN: tuple[Row, ...] = (
    ("refrigerator", 0, (-1.86, 3.46, 0), DOOR),
    ("cabinet", 1, (-0.86, 3.54, 0), DOOR),
    ("microwave", 0, (-1.15, 3.56, 0.84), DOOR),
    ("toaster", 0, (-0.5, 3.5, 0.84), ASKEW),
    ("oven", 0, (0.1, 3.5, 0), DOOR),
    ("cabinet", 1, (1.05, 3.54, 0), DOOR),
    ("sink", 0, (1.9, 3.55, 0), DOOR),
    ("bowl", 0, (0.72, 3.5, 0.84), DOOR),
    ("apple", 0, (0.68, 3.48, 0.915), DOOR),
    ("orange", 0, (0.78, 3.52, 0.915), DOOR),
    ("banana", 0, (1.02, 3.42, 0.84), ASKEW),
    ("bottle", 1, (1.22, 3.6, 0.84), DOOR),
    ("wine glass", 0, (1.45, 3.5, 0.84), DOOR),
    ("cup", 1, (-0.78, 3.45, 0.84), DOOR),
    ("clock", 0, (0.1, 3.8, 1.85), DOOR),
    ("dining table", 2, (-1.85, 1.4, 0), RIGHT),
    ("tv", 0, (-2.0, 1.3, 0.74), RIGHT),
    ("keyboard", 0, (-1.72, 1.3, 0.74), RIGHT),
    ("mouse", 0, (-1.7, 0.98, 0.74), RIGHT),
    ("lamp", 2, (-2.0, 1.98, 0.74), RIGHT),
    ("cup", 0, (-1.7, 1.75, 0.74), TURNED),
    ("chair", 2, (-1.22, 1.35, 0), LEFT),
    ("picture frame", 2, (-2.2, 1.4, 1.95), RIGHT),
    ("shelf", 1, (-2.03, 2.55, 0), RIGHT),
    ("printer", 0, (-2.0, 2.55, 0.795), RIGHT),
    ("book", 2, (-2.05, 2.55, 0.425), RIGHT),
    ("trash can", 1, (-1.35, 3.0, 0), DOOR),
    ("projector", 0, (-1.15, 2.3, 0), TURNED),
    ("dining table", 1, (1.45, 1.9, 0), DOOR),
    ("chair", 1, (1.4, 2.62, 0), DOOR),
    ("chair", 0, (1.5, 1.2, 0), BACK),
    ("cup", 1, (1.2, 1.8, 0.74), DOOR),
    ("bottle", 0, (1.6, 2.05, 0.74), DOOR),
    ("laptop", 0, (1.5, 1.75, 0.74), BACK),
    ("wine glass", 0, (1.25, 2.1, 0.74), DOOR),
    ("book", 1, (1.72, 1.75, 0.74), TURNED),
    ("whiteboard", 0, (2.2, 1.55, 1.4), LEFT),
    ("fan", 0, (2.0, 2.75, 0), LEFT),
    ("ladder", 0, (1.75, 0.06, 0), BACK),
    ("broom", 0, (1.38, 0.06, 0), BACK),
    ("bucket", 0, (2.0, 0.45, 0), BACK),
    ("toolbox", 0, (1.3, 0.4, 0), BACK),
    ("cardboard box", 1, (-1.85, 0.3, 0), BACK),
    ("coat rack", 0, (-1.2, 0.3, 0), BACK),
    ("picture frame", 0, (-0.85, 0.0, 1.75), BACK),
    ("door", 0, (0.4, 0.04, 0), RIGHT),
)

HALL: tuple[Row, ...] = (
    ("fire extinguisher", 0, (0.1, 0.68, 0), DOOR),
    ("picture frame", 2, (1.5, 0.8, 1.7), DOOR),
    ("picture frame", 2, (-1.5, -0.8, 1.7), BACK),
    ("picture frame", 0, (-0.15, -0.8, 1.65), BACK),
    ("clock", 0, (0.2, 0.8, 1.6), DOOR),
    ("cardboard box", 0, (-0.35, -0.6, 0), BACK),
)

# Rows in the frame of a corridor end: origin on the floor at the middle of the end wall, y into the
# wall.
CORRIDOR_END: tuple[Row, ...] = (
    ("cabinet", 0, (-0.22, -0.24, 0), DOOR),
    ("vase", 1, (-0.5, -0.24, 0.84), DOOR),
    ("lamp", 1, (0.1, -0.22, 0.84), DOOR),
    ("picture frame", 1, (-0.15, 0, 1.8), DOOR),
    ("potted plant", 2, (0.6, -0.35, 0), DOOR),
    ("bench", 0, (-0.64, -1.15, 0), RIGHT),
    ("radiator", 0, (0.73, -1.25, 0), LEFT),
    ("umbrella", 0, (-0.72, -0.62, 0), DOOR),
    ("trash can", 0, (0.62, -1.95, 0), DOOR),
)
_HALF_M = CORRIDOR_SIZE_M[0] / 2
ENDS = (Placement((_HALF_M, 0, 0), LEFT), Placement((-_HALF_M, 0, 0), RIGHT))


def things(seed: int) -> tuple[tuple[SceneObject, int], ...]:
    """Return every object of the flat in the world frame, with the index of its room.

    Index 0 is room A, the living room; 1 is room B, the kitchen; 2 is the corridor.
    """
    paint = Materials(np.random.default_rng([seed, 0]))
    rooms = ((LIVING_ROOM, ROOM_A, 0), (KITCHEN, ROOM_B, 1), (HALL, CORRIDOR, 2))
    furnished = [
        (placed, index)
        for rows, frame, index in rooms
        for placed in placed_in(built(rows, paint), frame)
    ]
    end = built(CORRIDOR_END, paint)
    furnished += [(thing, 2) for frame in ENDS for thing in placed_in(end, frame)]
    return tuple(furnished)


def built(rows: tuple[Row, ...], paint: Materials) -> list[SceneObject]:
    """Build the objects that the rows of a table describe, in the frame of their room."""
    made = [(label, CATALOG[label](paint, shape), at, way) for label, shape, at, way in rows]
    return [
        SceneObject(label, tuple(Placement(at, way)(solid) for solid in solids))
        for label, solids, at, way in made
    ]


def placed_in(built: list[SceneObject], frame: Placement) -> list[SceneObject]:
    """Move objects from the frame of their room to the world frame.

    Args:
        built: The objects in the frame of the room, as the function `built` returns them.
        frame: Placement of the room in the world.
    """
    return [
        SceneObject(thing.label, tuple(frame(solid) for solid in thing.solids)) for thing in built
    ]
