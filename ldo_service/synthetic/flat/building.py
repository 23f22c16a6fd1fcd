"""Walls, floors and ceilings of the flat, each with the lamp that lights it."""

from dataclasses import dataclass

from ldo_service.synthetic.solids import Solid

from .scene_object import CEILING, FLOOR, WALL, Placement

WALL_M = 0.06  # Thickness of a wall layer; a wall between two rooms has one layer of each room.
HEIGHT_M = 2.5
DOOR_WIDTH_M, DOOR_HEIGHT_M = 0.9, 2.05
ROOM_SIZE_M = (4.4, 3.8)
CORRIDOR_SIZE_M = (6.4, 1.6)
DOOR_X_M = -0.1  # Position of the doorway's center along the door wall, in the frame of a room.
LAMP_SIDE_M = 0.5
SHELL = Solid("box", (0.0, 0.0, 1.2), (8.0, 11.0, 4.0), "")  # Encloses the flat; never visible.

# Frames of the two rooms: origin on the floor at the middle of the door wall, y into the room.
ROOM_A = Placement((-1.0, CORRIDOR_SIZE_M[1] / 2 + 2 * WALL_M, 0.0))
ROOM_B = Placement((1.0, -CORRIDOR_SIZE_M[1] / 2 - 2 * WALL_M, 0.0), (-1.0, 0.0))
CORRIDOR = Placement((0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class Panel:
    """Slab of a wall, floor or ceiling; only its face toward the room receives shadows."""

    solid: Solid
    class_id: int
    face: int  # Face toward the room: 0-5 for the slab's sides -x, +x, -y, +y, -z, +z.
    room: int  # Index of the room, whose lamp lights the slab: 0 room A, 1 room B, 2 corridor.


def lamp_centers_m() -> tuple[tuple[float, float, float], ...]:
    """Return the world positions of the lamp centers in room A, room B and the corridor."""
    height_m = HEIGHT_M - 0.15
    middle = Solid("box", (0.0, ROOM_SIZE_M[1] / 2, height_m), (1, 1, 1), "")
    return ROOM_A(middle).center_m, ROOM_B(middle).center_m, (0.0, 0.0, height_m)


def panels() -> tuple[Panel, ...]:
    """Return all slabs of the building."""
    return (
        *_room(ROOM_A, 0, "wall_a", "floor_a"),
        *_room(ROOM_B, 1, "wall_b", "floor_b"),
        *_corridor(),
    )


def _room(placed: Placement, room: int, paint: str, floor: str) -> list[Panel]:
    width, depth = ROOM_SIZE_M
    slabs = [
        *((slab, 3) for slab in _door_wall(width, -WALL_M / 2, DOOR_X_M, paint)),
        (wall_slab((0, depth + WALL_M / 2), (width, WALL_M), paint), 2),
        (wall_slab((-(width + WALL_M) / 2, depth / 2), (WALL_M, depth), paint), 1),
        (wall_slab(((width + WALL_M) / 2, depth / 2), (WALL_M, depth), paint), 0),
    ]
    walls = [Panel(placed(slab), WALL, face, room) for slab, face in slabs]
    return [*walls, *level(placed, room, (0, depth / 2), _outer(width, depth), floor)]


def _corridor() -> list[Panel]:
    """Return the panels of the corridor.

    One side wall with a doorway and one end wall are built. The opposite walls are copies of them,
    turned by half a turn about z.
    """
    length, width = CORRIDOR_SIZE_M
    door_m = ROOM_A.origin_m[0] + DOOR_X_M
    slabs = [
        *((slab, 2) for slab in _door_wall(length, (width + WALL_M) / 2, door_m, "wall_c")),
        (wall_slab(((length + WALL_M) / 2, 0), (WALL_M, width), "wall_c"), 0),
    ]
    turned = Placement((0.0, 0.0, 0.0), (-1.0, 0.0))
    walls = [Panel(put(slab), WALL, face, 2) for put in (CORRIDOR, turned) for slab, face in slabs]
    return [*walls, *level(CORRIDOR, 2, (0, 0), _outer(*CORRIDOR_SIZE_M), "floor_c")]


def _door_wall(length_m: float, y_m: float, door_m: float, paint: str) -> list[Solid]:
    """Return the slabs left of, right of and above a doorway at x = door_m in a wall along x."""
    left, right, end = door_m - DOOR_WIDTH_M / 2, door_m + DOOR_WIDTH_M / 2, length_m / 2
    lintel_m = HEIGHT_M - DOOR_HEIGHT_M
    above_m = (door_m, y_m, HEIGHT_M - lintel_m / 2)
    return [
        wall_slab(((left - end) / 2, y_m), (left + end, WALL_M), paint),
        wall_slab(((right + end) / 2, y_m), (end - right, WALL_M), paint),
        Solid("box", above_m, (DOOR_WIDTH_M, WALL_M, lintel_m), paint),
    ]


def _outer(width_m: float, depth_m: float) -> tuple[float, float]:
    """Return the size of a room up to the outer faces of its walls."""
    return width_m + 2 * WALL_M, depth_m + 2 * WALL_M


def wall_slab(center_m: tuple[float, float], size_m: tuple[float, float], paint: str) -> Solid:
    """Return a wall from the floor to the ceiling."""
    return Solid("box", (*center_m, HEIGHT_M / 2), (*size_m, HEIGHT_M), paint)


def level(
    placed: Placement,
    room: int,
    center_m: tuple[float, float],
    size_m: tuple[float, float],
    floor: str,
) -> list[Panel]:
    """Return the floor and the ceiling of a room.

    The floor also covers the doorways if `size_m` includes the thickness of the walls.
    """
    below = placed(Solid("box", (*center_m, -0.05), (*size_m, 0.1), floor))
    above = placed(Solid("box", (*center_m, HEIGHT_M + 0.05), (*size_m, 0.1), "ceiling"))
    return [Panel(below, FLOOR, 5, room), Panel(above, CEILING, 4, room)]
