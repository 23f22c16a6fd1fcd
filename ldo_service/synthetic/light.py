"""Diffuse light of one ceiling lamp, with soft shadows of the furniture on the walls."""

from dataclasses import replace

import numpy as np

from .room import Room
from .solids import Solid, Vector, interval, vector

LAMP_GRID = 4  # The lamp is an area of 4x4 points, so its shadows are soft.
LIGHT_CELL_M = 0.06  # Cell size of the grids of light on walls, floors and ceilings.
AMBIENT = 0.42  # Light that comes from all directions, 0..1.
LAMP = 0.55  # Light of the lamp at normal incidence, before falloff.
SIDE = 0.06  # Additional light of a surface that faces +x, as a fraction of the ambient light.


def shade(
    lamp_m: Vector, point: Vector, normal: Vector, lit: np.ndarray | float, side: float = SIDE
) -> np.ndarray:
    """Return the light on a surface: ambient light plus the light of the lamp.

    Surfaces that face up or +x get more ambient light than others.

    Args:
        lamp_m: Center of the lamp, meters.
        point: Points of the surface, [P], meters.
        normal: Unit normals at the points.
        lit: Visible fraction of the lamp, 0..1.
        side: Additional light of a surface that faces +x, as a fraction of the ambient light.

    Returns:
        Light [P]; 1 leaves the albedo unchanged.
    """
    x, y, z = (a - b for a, b in zip(lamp_m, point, strict=True))
    distance_sq = x * x + y * y + z * z
    cosine = (x * normal[0] + y * normal[1] + z * normal[2]) / np.sqrt(distance_sq)
    falloff = 1.35 / (1.0 + 0.1 * distance_sq)
    ambient = AMBIENT * (1.0 + 0.18 * normal[2] + side * normal[0])
    return ambient + LAMP * falloff * lit * np.maximum(cosine, 0.0)


def plane_axes(axis: int) -> tuple[int, int]:
    """Return the two axes that span a face perpendicular to `axis`.

    On walls, the second of the two axes is z.
    """
    return ((1, 2), (0, 2), (0, 1))[axis]


def light_on_face(room: Room, face: int) -> np.ndarray:
    """Return the light on a grid over a face of the room, with the shadows of the furniture.

    Args:
        room: The furnished room.
        face: Index of the face, in the order -x, +x, -y, +y, -z, +z.

    Returns:
        Light [rows, columns] on a grid with cells of LIGHT_CELL_M; 1 leaves the albedo unchanged.
    """
    axis, sign = face // 2, 2 * (face % 2) - 1
    a, b = plane_axes(axis)
    center, size = room.shell.center_m, room.shell.size_m
    columns, rows = (int(size[i] / LIGHT_CELL_M) + 2 for i in (a, b))
    grid_b, grid_a = np.divmod(np.arange(rows * columns), columns)
    p = [np.zeros(rows * columns)] * 3
    p[a] = center[a] - size[a] / 2 + np.minimum(grid_a * LIGHT_CELL_M, size[a])
    p[b] = center[b] - size[b] / 2 + np.minimum(grid_b * LIGHT_CELL_M, size[b])
    p[axis] = np.full(rows * columns, center[axis] + sign * size[axis] / 2)
    point = vector(p)
    normal = vector(-sign if i == axis else 0.0 for i in range(3))
    light = shade(
        vector(room.lamp_center_m),
        point,
        normal,
        lit_share(room.lamp_center_m, room.lamp_side_m, room.furniture, point),
    )
    return light.reshape(rows, columns)


def lit_share(
    lamp_center_m: tuple[float, float, float],
    lamp_side_m: float,
    solids: tuple[Solid, ...],
    point: Vector,
) -> np.ndarray:
    """Return the fraction [P] of a square lamp, 0..1, that is visible from each point.

    Args:
        lamp_center_m: Center of the lamp.
        lamp_side_m: Side of the lamp.
        solids: Solids that can hide the lamp.
        point: Points [P], meters.
    """
    lamps = _lamp_points(lamp_center_m, lamp_side_m)
    is_hidden = np.zeros((LAMP_GRID**2, len(point[0])), bool)
    for solid in solids:
        # If the enlarged solid does not hide the lamp's center from a point, the solid hides no
        # part of the lamp from that point.
        larger = _enlarged(solid, lamp_side_m)
        near = np.flatnonzero(_is_between(larger, point, vector(lamp_center_m)))
        x, y, z = (component[near] for component in point)
        is_hidden[:, near] |= _is_between(solid, (x, y, z), lamps)
    return (~is_hidden).sum(axis=0) / LAMP_GRID**2


def _lamp_points(center_m: tuple[float, float, float], side_m: float) -> Vector:
    """Return K points of the lamp; each component is [K, 1], to broadcast against points [P]."""
    x, y, z = center_m
    steps_m = np.array([((i + 0.5) / LAMP_GRID - 0.5) * side_m for i in range(LAMP_GRID)])
    dy, dx = (offsets.reshape(-1, 1) for offsets in np.meshgrid(steps_m, steps_m, indexing="ij"))
    return x + dx, y + dy, np.full(dx.shape, z)


def _enlarged(solid: Solid, lamp_side_m: float) -> Solid:
    """Return a box that still contains the solid after a shift of up to half a lamp diagonal.

    The shift is horizontal, in any direction.
    """
    x, y, z = solid.size_m
    diagonal_m = 1.001 * np.sqrt(2) * lamp_side_m
    return replace(solid, shape="box", size_m=(x + diagonal_m, y + diagonal_m, z + 1e-6))


def _is_between(solid: Solid, point: Vector, lamp_m: Vector) -> np.ndarray:
    """Return whether a solid lies between surface points and points of the lamp.

    Args:
        solid: The solid.
        point: Surface points [P], meters.
        lamp_m: One point of the lamp, or K points with components [K, 1].

    Returns:
        A mask [P], or [K, P] for K points of the lamp.
    """
    way = (lamp_m[0] - point[0], lamp_m[1] - point[1], lamp_m[2] - point[2])
    enter, leave = interval(solid.shape, solid.point_to_local(point), solid.direction_to_local(way))
    return (enter < leave) & (leave > 1e-4) & (enter < 0.999)


def interpolated(grid: np.ndarray, u_m: np.ndarray, v_m: np.ndarray) -> np.ndarray:
    """Return the light [P] at grid coordinates u_m, v_m [P], interpolated bilinearly.

    The cells of the grid have the size LIGHT_CELL_M.
    """
    x, y = u_m / LIGHT_CELL_M, v_m / LIGHT_CELL_M
    column = np.clip(x.astype(np.int64), 0, grid.shape[1] - 2)
    row = np.clip(y.astype(np.int64), 0, grid.shape[0] - 2)
    fx, fy = np.clip(x - column, 0, 1), np.clip(y - row, 0, 1)
    upper = grid[row, column] * (1 - fx) + grid[row, column + 1] * fx
    lower = grid[row + 1, column] * (1 - fx) + grid[row + 1, column + 1] * fx
    return upper * (1 - fy) + lower * fy
