"""Light on the building, with the soft shadows of what stands in the room."""

import numpy as np

from ldo_service.datasets.synthetic.light import (
    LIGHT_CELL_M,
    interpolated,
    lit_share,
    plane_axes,
    shade,
)
from ldo_service.datasets.synthetic.solids import Solid, Vector, vector

from .building import LAMP_SIDE_M, Panel

Point = tuple[float, float, float]


def light_on_panel(panel: Panel, lamp_center_m: Point, solids: tuple[Solid, ...]) -> np.ndarray:
    """Light [rows, columns] on a grid over the face of the panel that its room sees."""
    point, (rows, columns) = _grid_on_face(panel)
    lit = lit_share(lamp_center_m, LAMP_SIDE_M, _between(panel, lamp_center_m, solids), point)
    light = shade(vector(lamp_center_m), point, _normal(panel), lit, side=0.0)
    return light.reshape(rows, columns)


def interpolated_on_panel(panel: Panel, grid: np.ndarray, local: Vector) -> np.ndarray:
    """The grid's value [P] at points of the face, given in the solid's frame."""
    a, b = plane_axes(panel.face // 2)
    u_m, v_m = ((local[i] + 1) * (panel.solid.size_m[i] / 2) for i in (a, b))
    return interpolated(grid, u_m, v_m)


def is_on_face(panel: Panel, local: Vector) -> np.ndarray:
    """Which points [P] of a panel's surface, in the solid's frame, lie on its seen face."""
    return np.abs(local[panel.face // 2] - _side(panel)) < 1e-6


def _side(panel: Panel) -> float:
    return 2.0 * (panel.face % 2) - 1.0


def _between(panel: Panel, lamp_center_m: Point, solids: tuple[Solid, ...]) -> tuple[Solid, ...]:
    """The solids that meet the box about panel and lamp: no other can throw a shadow on it."""
    reach = np.array([LAMP_SIDE_M / 2, LAMP_SIDE_M / 2, 0.0])
    corners = [*panel.solid.corners_m(), lamp_center_m - reach, lamp_center_m + reach]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    boxes = [solid.corners_m() for solid in solids]
    return tuple(
        solid
        for solid, box in zip(solids, boxes, strict=True)
        if (box.max(axis=0) > low).all() and (box.min(axis=0) < high).all()
    )


def _normal(panel: Panel) -> Vector:
    n = [_side(panel) if axis == panel.face // 2 else 0.0 for axis in range(3)]
    c, s = panel.solid.heading
    return vector((c * n[0] - s * n[1], s * n[0] + c * n[1], n[2]))


def _grid_on_face(panel: Panel) -> tuple[Vector, tuple[int, int]]:
    """Points of the world [rows * columns], and the shape of their grid."""
    solid, axis = panel.solid, panel.face // 2
    a, b = plane_axes(axis)
    columns, rows = (int(solid.size_m[i] / LIGHT_CELL_M) + 2 for i in (a, b))
    grid_b, grid_a = np.divmod(np.arange(rows * columns), columns)
    own = [np.zeros(rows * columns)] * 3
    own[a] = np.minimum(grid_a * LIGHT_CELL_M, solid.size_m[a]) - solid.size_m[a] / 2
    own[b] = np.minimum(grid_b * LIGHT_CELL_M, solid.size_m[b]) - solid.size_m[b] / 2
    own[axis] = np.full(rows * columns, _side(panel) * solid.size_m[axis] / 2)
    (c, s), (x, y, z) = solid.heading, solid.center_m
    world = (x + (c * own[0] - s * own[1]), y + (s * own[0] + c * own[1]), z + own[2])
    return world, (rows, columns)
