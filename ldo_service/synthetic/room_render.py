"""Ray casting of a lit, furnished room: color and exact depth per pixel."""

from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera

from .light import interpolated, light_on_face, plane_axes, shade
from .ray_casting import Hits, RayCaster, outline
from .room import Room
from .solids import Solid, Vector, vector

SHELL_FACES = 6  # A ray cast numbers the faces of the shell 0-5 and the solids from 6 on.
# Offsets of four rays per pixel, used at the outlines of surfaces: the centers of its quarters.
QUARTERS_PX = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))


@dataclass(frozen=True, slots=True)
class RoomRendering:
    """One rendered frame of the room."""

    light: np.ndarray  # RGB values [H, W, 3] float64 in 0..1, before rounding to 8 bits.
    depth_m: np.ndarray  # Depth z [H, W] float64, exact at pixel centers.
    # Mask [H, W] bool of the pixels that show a solid which is in the room for this frame alone,
    # such as a walking person.
    is_visitor: np.ndarray

    @property
    def color(self) -> np.ndarray:
        """Color [H, W, 3] uint8 of a perfect camera."""
        return np.floor(self.light * 255 + 0.5).astype(np.uint8)


class Renderer:
    """Renderer of one room; it computes the light on the walls once, in the constructor."""

    def __init__(self, room: Room) -> None:
        self._room = room
        self._light = [light_on_face(room, face) for face in range(6)]

    def render(
        self, camera: Camera, T_world_camera: np.ndarray, visitors: tuple[Solid, ...] = ()
    ) -> RoomRendering:
        """Render the room from one camera pose, or from one pose for each row.

        The light of a pixel at the outline of a surface is the mean of four rays. Depth comes from
        one ray through the pixel center, so it never mixes surfaces.

        Args:
            camera: Intrinsics.
            T_world_camera: Camera pose [4, 4], or one pose for each image row, [H, 4, 4].
            visitors: Solids in addition to the furniture; they cast no shadow.
        """
        v, u = np.divmod(np.arange(camera.width * camera.height), camera.width)
        solids = (*self._room.furniture, *visitors)
        view = RayCaster(self._room.shell, solids, camera, T_world_camera)
        hits = view.cast(u, v)
        light = self._color(view, solids, hits)
        edge = outline(hits.surface.reshape(camera.height, camera.width)).ravel()
        light[edge] = self._antialiased(view, solids, u[edge], v[edge])
        size = (camera.height, camera.width)
        is_visitor = hits.surface >= SHELL_FACES + len(self._room.furniture)
        return RoomRendering(
            light.reshape(*size, 3), hits.depth_m.reshape(size), is_visitor.reshape(size)
        )

    def _antialiased(
        self, view: RayCaster, solids: tuple[Solid, ...], u: np.ndarray, v: np.ndarray
    ) -> np.ndarray:
        total = np.zeros((len(u), 3))
        for du, dv in QUARTERS_PX:
            total += self._color(view, solids, view.cast(u + du, v + dv))
        return total / len(QUARTERS_PX)

    def _color(self, view: RayCaster, solids: tuple[Solid, ...], hits: Hits) -> np.ndarray:
        """Return the reflected light [P, 3] in 0..1: albedo times diffuse shading."""
        color = np.empty((len(hits.surface), 3))
        for surface, rays in hits.by_surface():
            point = hits.points(rays)
            footprint_m = hits.depth_m[rays] / view.camera.fx
            if surface < SHELL_FACES:
                color[rays] = self._wall_color(surface, point, footprint_m)
            else:
                solid = solids[surface - SHELL_FACES]
                color[rays] = self._solid_color(solid, point, footprint_m)
        return np.clip(color, 0.0, 1.0)

    def _wall_color(self, face: int, point: Vector, footprint_m: np.ndarray) -> np.ndarray:
        a, b = plane_axes(face // 2)
        shell = self._room.shell
        corner = [c - s / 2 for c, s in zip(shell.center_m, shell.size_m, strict=True)]
        u_m, v_m = point[a] - corner[a], point[b] - corner[b]
        albedo = self._room.textures[self._room.faces[face]].sample(u_m, v_m, footprint_m)
        return albedo * interpolated(self._light[face], u_m, v_m)[:, None]

    def _solid_color(self, solid: Solid, point: Vector, footprint_m: np.ndarray) -> np.ndarray:
        normal, u_m, v_m = solid.surface(point)
        albedo = self._room.textures[solid.texture].sample(u_m, v_m, footprint_m)
        return albedo * shade(vector(self._room.lamp_center_m), point, normal, 1.0)[:, None]
