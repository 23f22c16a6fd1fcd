"""Ray casting of the flat: light, exact depth and exact labels."""

from dataclasses import dataclass

import numpy as np

from ldo_service.datasets.synthetic.cast import Hits, View, outline
from ldo_service.datasets.synthetic.light import shade
from ldo_service.datasets.synthetic.render import QUARTERS_PX
from ldo_service.datasets.synthetic.solids import Vector, vector
from ldo_service.geometry import Camera

from .building import SHELL, lamp_centers_m
from .labels import WALL
from .scene import Flat, surfaces
from .shadows import interpolated_on_panel, is_on_face, light_on_panel

EXPOSURE = 1.15  # a white wall near the lamp is just not saturated
SHELL_FACES = 6  # number the first surfaces that a cast can meet


@dataclass(frozen=True, slots=True)
class Rendering:
    """One frame before any sensor.

    light          [H, W, 3] float64 in 0..1
    depth_m        [H, W] float64, z at pixel centres
    instance_ids   [H, W] uint16
    """

    light: np.ndarray
    depth_m: np.ndarray
    class_ids: np.ndarray
    instance_ids: np.ndarray


class FlatRenderer:
    """Frames of one flat. The shadows on its walls are computed once, when this is made."""

    def __init__(self, flat: Flat) -> None:
        self._flat = flat
        self._table = table = surfaces(flat)
        self._class_ids = np.concatenate([np.full(SHELL_FACES, WALL, np.uint8), table.class_ids])
        self._instance_ids = np.concatenate([np.zeros(SHELL_FACES, np.uint16), table.instance_ids])
        self._lamps = lamp_centers_m()
        self._panel_light = [
            self._with_shadows(panel.room, i) for i, panel in enumerate(flat.panels)
        ]

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> Rendering:
        """Pixels on an outline average four rays in light; depth and labels never mix surfaces."""
        v, u = np.divmod(np.arange(camera.width * camera.height), camera.width)
        view = View(SHELL, self._table.solids, camera, T_world_camera)
        hits = view.cast(u, v)
        size = (camera.height, camera.width)
        light = self._reflected(view, u, v, hits)
        edge = outline(hits.surface.reshape(size)).ravel()
        light[edge] = self._antialiased(view, u[edge], v[edge])
        return Rendering(
            light.reshape(*size, 3),
            hits.depth_m.reshape(size),
            self._class_ids[hits.surface].reshape(size),
            self._instance_ids[hits.surface].reshape(size),
        )

    def _antialiased(self, view: View, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The mean light [P, 3] of the quarters of pixels; all of them are cast at once."""
        du, dv = np.array(QUARTERS_PX).T
        u, v = (u[:, None] + du).ravel(), (v[:, None] + dv).ravel()
        order = np.argsort(v, kind="stable")
        u, v = u[order], v[order]
        light = np.empty((len(u), 3))
        light[order] = self._reflected(view, u, v, view.cast(u, v))
        return light.reshape(-1, len(du), 3).sum(axis=1) / len(du)

    def _reflected(self, view: View, u: np.ndarray, v: np.ndarray, hits: Hits) -> np.ndarray:
        """Light [P, 3] in 0..1: albedo times diffuse shading."""
        light = np.zeros((len(u), 3))
        for surface, rays in hits.by_surface():
            if surface >= SHELL_FACES:
                point = view.points(u[rays], v[rays], hits.depth_m[rays])
                footprint_m = hits.depth_m[rays] / view.camera.fx
                light[rays] = self._on_solid(surface - SHELL_FACES, point, footprint_m)
        return np.clip(light, 0.0, 1.0)

    def _on_solid(self, index: int, point: Vector, footprint_m: np.ndarray) -> np.ndarray:
        solid, lamp = self._table.solids[index], self._lamps[self._table.rooms[index]]
        normal, u_m, v_m = solid.surface(point)
        albedo = self._flat.textures[solid.texture].sample(u_m, v_m, footprint_m)
        light = shade(vector(lamp), point, normal, 1.0, side=0.0)  # half a turn must not show
        if index < len(self._flat.panels):
            panel, local = self._flat.panels[index], solid.point_to_local(point)
            shadowed = interpolated_on_panel(panel, self._panel_light[index], local)
            light = np.where(is_on_face(panel, local), shadowed, light)
        return albedo * (EXPOSURE * light)[:, None]

    def _with_shadows(self, room: int, index: int) -> np.ndarray:
        """Light over a panel past the things of its room."""
        table = self._table
        blockers = tuple(
            solid
            for solid, its_room, instance in zip(
                table.solids, table.rooms, table.instance_ids, strict=True
            )
            if instance and its_room == room
        )
        return light_on_panel(self._flat.panels[index], self._lamps[room], blockers)
