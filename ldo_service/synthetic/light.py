"""Diffuse light of one ceiling lamp, and the soft shadows that furniture casts on the walls."""

from dataclasses import replace

import numpy as np

from .room import Room
from .solids import Solid, Vector, interval, vector

LAMP_GRID = 4  # the lamp is an area of 4x4 points: its shadows are soft
LIGHT_CELL_M = 0.06
AMBIENT = 0.42  # share of light that comes from everywhere
LAMP = 0.55
SIDE = 0.06  # of the ambient light: more from +x


def shade(
    lamp_m: Vector, point: Vector, normal: Vector, lit: np.ndarray | float, side: float = SIDE
) -> np.ndarray:
    """Light [P] on a surface: from everywhere, more from above, and from a lamp of share `lit`."""
    x, y, z = (a - b for a, b in zip(lamp_m, point, strict=True))
    distance_sq = x * x + y * y + z * z
    cosine = (x * normal[0] + y * normal[1] + z * normal[2]) / np.sqrt(distance_sq)
    falloff = 1.35 / (1.0 + 0.1 * distance_sq)
    ambient = AMBIENT * (1.0 + 0.18 * normal[2] + side * normal[0])
    return ambient + LAMP * falloff * lit * np.maximum(cosine, 0.0)


def plane_axes(axis: int) -> tuple[int, int]:
    """The two axes that span a face across `axis`; the second is up on walls."""
    return ((1, 2), (0, 2), (0, 1))[axis]


def light_on_face(room: Room, face: int) -> np.ndarray:
    """Light [rows, columns] on a grid over a face of the room, with the shadows of furniture."""
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
    """The share [P] of a square lamp that is seen from each point past the solids."""
    lamps = _lamp_points(lamp_center_m, lamp_side_m)
    is_hidden = np.zeros((LAMP_GRID**2, len(point[0])), bool)
    for solid in solids:
        # a ray to any point of the lamp passes the solid where that to its middle passes a larger
        larger = _enlarged(solid, lamp_side_m)
        near = np.flatnonzero(_is_between(larger, point, vector(lamp_center_m)))
        x, y, z = (component[near] for component in point)
        is_hidden[:, near] |= _is_between(solid, (x, y, z), lamps)
    return (~is_hidden).sum(axis=0) / LAMP_GRID**2


def _lamp_points(center_m: tuple[float, float, float], side_m: float) -> Vector:
    """Each component [K, 1], to be broadcast against points."""
    x, y, z = center_m
    steps_m = np.array([((i + 0.5) / LAMP_GRID - 0.5) * side_m for i in range(LAMP_GRID)])
    dy, dx = (offsets.reshape(-1, 1) for offsets in np.meshgrid(steps_m, steps_m, indexing="ij"))
    return x + dx, y + dy, np.full(dx.shape, z)


def _enlarged(solid: Solid, lamp_side_m: float) -> Solid:
    """A box that holds the solid moved by half a lamp's diagonal any way level."""
    x, y, z = solid.size_m
    diagonal_m = 1.001 * np.sqrt(2) * lamp_side_m
    return replace(solid, shape="box", size_m=(x + diagonal_m, y + diagonal_m, z + 1e-6))


def _is_between(solid: Solid, point: Vector, lamp_m: Vector) -> np.ndarray:
    """Which points [P] a solid hides from a point of a lamp, or [K, P] from each of K."""
    way = (lamp_m[0] - point[0], lamp_m[1] - point[1], lamp_m[2] - point[2])
    enter, leave = interval(solid.shape, solid.point_to_local(point), solid.direction_to_local(way))
    return (enter < leave) & (leave > 1e-4) & (enter < 0.999)


def interpolated(grid: np.ndarray, u_m: np.ndarray, v_m: np.ndarray) -> np.ndarray:
    """Bilinear value [P] of a grid with cells of LIGHT_CELL_M."""
    x, y = u_m / LIGHT_CELL_M, v_m / LIGHT_CELL_M
    column = np.clip(x.astype(np.int64), 0, grid.shape[1] - 2)
    row = np.clip(y.astype(np.int64), 0, grid.shape[0] - 2)
    fx, fy = np.clip(x - column, 0, 1), np.clip(y - row, 0, 1)
    upper = grid[row, column] * (1 - fx) + grid[row, column + 1] * fx
    lower = grid[row + 1, column] * (1 - fx) + grid[row + 1, column + 1] * fx
    return upper * (1 - fy) + lower * fy
