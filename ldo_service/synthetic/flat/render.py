"""Ray casting of the flat: soft shadows, exact depth and exact labels."""

from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera
from ldo_service.synthetic.light import LIGHT_CELL_M, interpolated, lit_share, plane_axes, shade
from ldo_service.synthetic.ray_casting import Hits, RayCaster, outline
from ldo_service.synthetic.room_render import QUARTERS_PX
from ldo_service.synthetic.solids import Solid, Vector, vector

from .building import LAMP_SIDE_M, Panel
from .scene import Flat, surfaces
from .scene_object import WALL

EXPOSURE = 1.15  # Factor on the light: a white wall near the lamp is just below saturation.
SHELL_FACES = 6  # A ray cast numbers the faces of the shell 0-5 and the solids from 6 on.


Point = tuple[float, float, float]


def light_on_panel(panel: Panel, lamp_center_m: Point, solids: tuple[Solid, ...]) -> np.ndarray:
    """Return the light on the face of a panel that points into the room.

    Args:
        panel: The panel.
        lamp_center_m: Center of the lamp in the world frame.
        solids: Solids that can cast a shadow on the panel.

    Returns:
        Light [rows, columns] on a grid with cells of LIGHT_CELL_M; 1 leaves the albedo unchanged.
    """
    point, (rows, columns) = _grid_on_face(panel)
    lit = lit_share(lamp_center_m, LAMP_SIDE_M, _between(panel, lamp_center_m, solids), point)
    light = shade(vector(lamp_center_m), point, _normal(panel), lit, side=0.0)
    return light.reshape(rows, columns)


def interpolated_on_panel(panel: Panel, grid: np.ndarray, local: Vector) -> np.ndarray:
    """Interpolate the light on a panel.

    Args:
        panel: The panel.
        grid: Light [rows, columns] on the face, from `light_on_panel`.
        local: P points on the face, in the local frame of the panel's solid.

    Returns:
        Light [P] at the points.
    """
    a, b = plane_axes(panel.face // 2)
    u_m, v_m = ((local[i] + 1) * (panel.solid.size_m[i] / 2) for i in (a, b))
    return interpolated(grid, u_m, v_m)


def is_on_face(panel: Panel, local: Vector) -> np.ndarray:
    """Return a mask [P] of the points on the face of a panel that points into the room.

    Args:
        panel: The panel.
        local: P points on the panel's solid, in the solid's local frame.
    """
    return np.abs(local[panel.face // 2] - _side(panel)) < 1e-6


def _side(panel: Panel) -> float:
    return 2.0 * (panel.face % 2) - 1.0


def _between(panel: Panel, lamp_center_m: Point, solids: tuple[Solid, ...]) -> tuple[Solid, ...]:
    """Return the solids that intersect the common bounding box of the panel and the lamp.

    No other solid can cast a shadow on the panel.
    """
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
    """Return the world points of the light grid, [rows * columns], and its size (rows, columns)."""
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


@dataclass(frozen=True, slots=True)
class FlatRendering:
    """Exact images of one frame, before the sensor model."""

    light: np.ndarray  # Light [H, W, 3] float64 in 0..1.
    depth_m: np.ndarray  # Depth [H, W] float64, z of the surface at the pixel center.
    class_ids: np.ndarray  # Class per pixel [H, W] uint8.
    instance_ids: np.ndarray  # Object per pixel [H, W] uint16; 0 for the building.


class FlatRenderer:
    """Renderer of one flat; it computes the shadows on the walls once, in the constructor."""

    def __init__(self, flat: Flat) -> None:
        self._flat = flat
        self._table = table = surfaces(flat)
        self._class_ids = np.concatenate([np.full(SHELL_FACES, WALL, np.uint8), table.class_ids])
        self._instance_ids = np.concatenate([np.zeros(SHELL_FACES, np.uint16), table.instance_ids])
        self._lamps = flat.lamps_m
        self._panel_light = [
            self._with_shadows(panel.room, i) for i, panel in enumerate(flat.panels)
        ]

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> FlatRendering:
        """Render the flat.

        The light of a pixel at the outline of a surface is the mean of four rays. Depth and labels
        come from one ray through the pixel center, so they never mix surfaces.

        Args:
            camera: Intrinsics.
            T_world_camera: Camera pose [4, 4], or one pose for each image row, [H, 4, 4].
        """
        v, u = np.divmod(np.arange(camera.width * camera.height), camera.width)
        view = RayCaster(self._flat.shell, self._table.solids, camera, T_world_camera)
        hits = view.cast(u, v)
        size = (camera.height, camera.width)
        light = self._reflected(view, hits)
        edge = outline(hits.surface.reshape(size)).ravel()
        light[edge] = self._antialiased(view, u[edge], v[edge])
        return FlatRendering(
            light.reshape(*size, 3),
            hits.depth_m.reshape(size),
            self._class_ids[hits.surface].reshape(size),
            self._instance_ids[hits.surface].reshape(size),
        )

    def _antialiased(self, view: RayCaster, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the mean light [P, 3] of four rays per pixel; all rays are cast in one call."""
        du, dv = np.array(QUARTERS_PX).T
        u, v = (u[:, None] + du).ravel(), (v[:, None] + dv).ravel()
        order = np.argsort(v, kind="stable")
        u, v = u[order], v[order]
        light = np.empty((len(u), 3))
        light[order] = self._reflected(view, view.cast(u, v))
        return light.reshape(-1, len(du), 3).sum(axis=1) / len(du)

    def _reflected(self, view: RayCaster, hits: Hits) -> np.ndarray:
        """Return the reflected light [P, 3] in 0..1: albedo times diffuse shading."""
        light = np.zeros((len(hits.surface), 3))
        for surface, rays in hits.by_surface():
            if surface >= SHELL_FACES:
                point = hits.points(rays)
                footprint_m = hits.depth_m[rays] / view.camera.fx
                light[rays] = self._on_solid(surface - SHELL_FACES, point, footprint_m)
        return np.clip(light, 0.0, 1.0)

    def _on_solid(self, index: int, point: Vector, footprint_m: np.ndarray) -> np.ndarray:
        solid, lamp = self._table.solids[index], self._lamps[self._table.rooms[index]]
        normal, u_m, v_m = solid.surface(point)
        albedo = self._flat.textures[solid.texture].sample(u_m, v_m, footprint_m)
        # Directional ambient light (side > 0) would break the symmetry of the half turn.
        light = shade(vector(lamp), point, normal, 1.0, side=0.0)
        if index < len(self._flat.panels):
            panel, local = self._flat.panels[index], solid.point_to_local(point)
            shadowed = interpolated_on_panel(panel, self._panel_light[index], local)
            light = np.where(is_on_face(panel, local), shadowed, light)
        return albedo * (EXPOSURE * light)[:, None]

    def _with_shadows(self, room: int, index: int) -> np.ndarray:
        """Return the light over a panel, with the shadows of the objects of its room."""
        table = self._table
        blockers = tuple(
            solid
            for solid, its_room, instance in zip(
                table.solids, table.rooms, table.instance_ids, strict=True
            )
            if instance and its_room == room
        )
        return light_on_panel(self._flat.panels[index], self._lamps[room], blockers)
