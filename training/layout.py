"""Random rooms for training; they differ from `synthetic:flat` in size, layout and paints.

The rooms have the same kinds of objects as `synthetic:flat`. In the world frame, z points up, and
the origin is on the floor at the center of the room. The renderer has a lamp above the origin.
"""

from collections.abc import Iterator

import numpy as np
from furnishing import Builder, furnish

from ldo_service.synthetic.flat.building import (
    DOOR_HEIGHT_M,
    DOOR_WIDTH_M,
    HEIGHT_M,
    SHELL,
    WALL_M,
    Panel,
    lamp_centers_m,
)
from ldo_service.synthetic.flat.paint import Materials, materials
from ldo_service.synthetic.flat.scene import Flat
from ldo_service.synthetic.flat.scene_object import CEILING, FLOOR, WALL
from ldo_service.synthetic.solids import Solid

VERSION = 3  # Version of the cached rooms; increase it with every change that alters a room.
LAMP = 2  # Index of the renderer's lamp above the origin.
HALLWAY_M = 1.4  # Depth of the hallway behind the doorway.
WIDTH_M, DEPTH_M = (3.6, 5.4), (3.2, 4.8)  # Minimum and maximum of a room's width and depth.
FIRST_SEED = 1000  # Offset of the seeds of paints; the flat and its variants use small seeds.


def room(seed: int) -> Flat:
    """Return a furnished room with a doorway; `seed` determines its size, layout and paints."""
    rng = np.random.default_rng([seed, 7])
    size_m = tuple(float(side) for side in rng.uniform(*zip(WIDTH_M, DEPTH_M, strict=True)))
    door_m = float(rng.uniform(-0.25, 0.25)) * size_m[0]
    low = np.array([door_m - DOOR_WIDTH_M / 2, -size_m[1] / 2, 0.0])
    doorway = low, low + np.array([DOOR_WIDTH_M, 0.6, DOOR_HEIGHT_M])
    builder = Builder(rng, Materials(rng), size_m, doorway)
    furnish(builder)
    panels = tuple(_panels(rng, size_m, door_m))
    things = tuple(builder.things)
    return Flat(
        panels=panels,
        things=things,
        rooms=(LAMP,) * len(things),
        textures=materials(FIRST_SEED + seed),
        lamps_m=lamp_centers_m(),
        shell=SHELL,
    )


def inside_m(flat: Flat) -> tuple[float, float]:
    """Return the inner width and depth of a room, meters."""
    back, side = flat.panels[0].solid, flat.panels[1].solid
    return back.size_m[0], side.size_m[1] - HALLWAY_M - WALL_M


def _panels(
    rng: np.random.Generator, size_m: tuple[float, float], door_m: float
) -> Iterator[Panel]:
    """Yield the panels of walls, floor and ceiling of a room and of the hallway behind its door."""
    width, depth = size_m
    paint = ("wall_a", "wall_b", "wall_c")[int(rng.integers(3))]
    floor = ("floor_a", "floor_b", "floor_c")[int(rng.integers(3))]
    outer, middle = depth + HALLWAY_M + WALL_M, -(HALLWAY_M + WALL_M) / 2
    yield _wall((0.0, (depth + WALL_M) / 2), (width, WALL_M), paint, 2)
    for sign in (-1, 1):
        x = sign * (width + WALL_M) / 2
        yield _wall((x, middle), (WALL_M, outer), paint, 0 if sign > 0 else 1)
    yield _wall((0.0, middle - (outer + WALL_M) / 2), (width, WALL_M), "wall_c", 3)
    yield from _door_wall(width, -(depth + WALL_M) / 2, door_m, paint)
    extent = (width + 2 * WALL_M, outer + 2 * WALL_M, 0.1)
    below, above = (0.0, middle, -0.05), (0.0, middle, HEIGHT_M + 0.05)
    yield Panel(Solid("box", below, extent, floor), FLOOR, 5, LAMP)
    yield Panel(Solid("box", above, extent, "ceiling"), CEILING, 4, LAMP)


def _door_wall(width_m: float, y_m: float, door_m: float, paint: str) -> Iterator[Panel]:
    """Yield the panels left of, right of and above the doorway."""
    left, right = door_m - DOOR_WIDTH_M / 2, door_m + DOOR_WIDTH_M / 2
    for start, end in ((-width_m / 2, left), (right, width_m / 2)):
        yield _wall(((start + end) / 2, y_m), (end - start, WALL_M), paint, 3)
    lintel_m = HEIGHT_M - DOOR_HEIGHT_M
    above = Solid(
        "box", (door_m, y_m, HEIGHT_M - lintel_m / 2), (DOOR_WIDTH_M, WALL_M, lintel_m), paint
    )
    yield Panel(above, WALL, 3, LAMP)


def _wall(
    center_m: tuple[float, float], size_m: tuple[float, float], paint: str, face: int
) -> Panel:
    solid = Solid("box", (*center_m, HEIGHT_M / 2), (*size_m, HEIGHT_M), paint)
    return Panel(solid, WALL, face, LAMP)
