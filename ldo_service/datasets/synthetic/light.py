"""Diffuse light of one ceiling lamp, and the soft shadows that furniture casts on the walls."""

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
    total = np.zeros(len(point[0]))
    x, y, z = lamp_center_m
    for k in range(LAMP_GRID**2):
        row, column = divmod(k, LAMP_GRID)
        dx, dy = (((i + 0.5) / LAMP_GRID - 0.5) * lamp_side_m for i in (column, row))
        to_lamp = (x + dx - point[0], y + dy - point[1], z - point[2])
        total += ~_is_blocked(solids, point, to_lamp)
    return total / LAMP_GRID**2


def _is_blocked(solids: tuple[Solid, ...], point: Vector, way: Vector) -> np.ndarray:
    blocked = np.zeros(len(point[0]), bool)
    for solid in solids:
        enter, leave = interval(
            solid.shape, solid.point_to_local(point), solid.direction_to_local(way)
        )
        blocked |= (enter < leave) & (leave > 1e-4) & (enter < 0.999)
    return blocked


def interpolated(grid: np.ndarray, u_m: np.ndarray, v_m: np.ndarray) -> np.ndarray:
    """Bilinear value [P] of a grid with cells of LIGHT_CELL_M."""
    x, y = u_m / LIGHT_CELL_M, v_m / LIGHT_CELL_M
    column = np.clip(x.astype(np.int64), 0, grid.shape[1] - 2)
    row = np.clip(y.astype(np.int64), 0, grid.shape[0] - 2)
    fx, fy = np.clip(x - column, 0, 1), np.clip(y - row, 0, 1)
    upper = grid[row, column] * (1 - fx) + grid[row, column + 1] * fx
    lower = grid[row + 1, column] * (1 - fx) + grid[row + 1, column + 1] * fx
    return upper * (1 - fy) + lower * fy
