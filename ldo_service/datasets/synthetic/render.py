"""Ray casting of a lit, furnished room: colour and exact depth per ray."""

from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera

from .light import interpolated, light_on_face, plane_axes, shade
from .room import Room
from .solids import Solid, Vector, interval, vector

NEAR_M = 0.05
# Four rays for a pixel on an outline, each in the middle of a quarter of it.
QUARTERS_PX = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))


@dataclass(frozen=True, slots=True)
class Hits:
    """What P rays met: depth_m [P], surface [P] (0-5 faces of the room, then furniture)."""

    depth_m: np.ndarray
    surface: np.ndarray


class Renderer:
    """Frames of one room. The light on its walls is computed once, when this is made."""

    def __init__(self, room: Room) -> None:
        self._room = room
        self._light = [light_on_face(room, face) for face in range(6)]

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colour [H, W, 3] uint8 and depth [H, W] float64 in metres (z, exact at pixel centres).

        Pixels on an outline average four rays in colour; depth never mixes surfaces.
        """
        v, u = np.divmod(np.arange(camera.width * camera.height), camera.width)
        view = _View(self._room, camera, T_world_camera)
        hits = view.cast(u, v)
        color = self._color(view, u, v, hits)
        edge = _outline(hits.surface.reshape(camera.height, camera.width)).ravel()
        color[edge] = self._antialiased(view, u[edge], v[edge])
        image = np.floor(color * 255 + 0.5).astype(np.uint8)
        size = (camera.height, camera.width)
        return image.reshape(*size, 3), hits.depth_m.reshape(size)

    def _antialiased(self, view: "_View", u: np.ndarray, v: np.ndarray) -> np.ndarray:
        total = np.zeros((len(u), 3))
        for du, dv in QUARTERS_PX:
            total += self._color(view, u + du, v + dv, view.cast(u + du, v + dv))
        return total / len(QUARTERS_PX)

    def _color(self, view: "_View", u: np.ndarray, v: np.ndarray, hits: Hits) -> np.ndarray:
        """Reflected light [P, 3] in 0..1: albedo times diffuse shading."""
        color = np.empty((len(u), 3))
        order = np.argsort(hits.surface, kind="stable")
        surfaces, starts = np.unique(hits.surface[order], return_index=True)
        for surface, rays in zip(surfaces, np.split(order, starts[1:]), strict=True):
            point = view.points(u[rays], v[rays], hits.depth_m[rays])
            footprint_m = hits.depth_m[rays] / view.camera.fx
            if surface < 6:
                color[rays] = self._wall_color(int(surface), point, footprint_m)
            else:
                color[rays] = self._solid_color(int(surface) - 6, point, footprint_m)
        return np.clip(color, 0.0, 1.0)

    def _wall_color(self, face: int, point: Vector, footprint_m: np.ndarray) -> np.ndarray:
        a, b = plane_axes(face // 2)
        shell = self._room.shell
        corner = [c - s / 2 for c, s in zip(shell.center_m, shell.size_m, strict=True)]
        u_m, v_m = point[a] - corner[a], point[b] - corner[b]
        albedo = self._room.textures[self._room.faces[face]].sample(u_m, v_m, footprint_m)
        return albedo * interpolated(self._light[face], u_m, v_m)[:, None]

    def _solid_color(self, index: int, point: Vector, footprint_m: np.ndarray) -> np.ndarray:
        solid = self._room.furniture[index]
        local = solid.point_to_local(point)
        normal, axis = solid.normal(local)
        own = np.stack([q * (size / 2) for q, size in zip(local, solid.size_m, strict=True)])
        rays = np.arange(len(axis))
        u_m, v_m = own[np.where(axis == 0, 1, 0), rays], own[np.where(axis == 2, 1, 2), rays]
        albedo = self._room.textures[solid.texture].sample(u_m, v_m, footprint_m)
        return albedo * shade(vector(self._room.lamp_center_m), point, normal, 1.0)[:, None]


class _View:
    """The rays of one camera pose, and what each piece of furniture can cover in its image."""

    def __init__(self, room: Room, camera: Camera, T_world_camera: np.ndarray) -> None:
        self.camera = camera
        self._room = room
        self._T = T_world_camera
        self._windows = [_window(solid, camera, T_world_camera) for solid in room.furniture]

    def cast(self, u: np.ndarray, v: np.ndarray) -> Hits:
        """The nearest surface along each ray."""
        direction = self._directions(u, v)
        depth_m, surface = self._cast_at_shell(direction)
        for k, (solid, window) in enumerate(zip(self._room.furniture, self._windows, strict=True)):
            rays = window.covered(u, v)
            d = solid.direction_to_local(vector(component[rays] for component in direction))
            enter, leave = interval(solid.shape, solid.point_to_local(self._origin()), d)
            nearer = (enter < leave) & (enter > NEAR_M) & (enter < depth_m[rays])
            depth_m[rays[nearer]] = enter[nearer]
            surface[rays[nearer]] = 6 + k
        return Hits(depth_m, surface)

    def points(self, u: np.ndarray, v: np.ndarray, depth_m: np.ndarray) -> Vector:
        d, o = self._directions(u, v), self._origin()
        return o[0] + d[0] * depth_m, o[1] + d[1] * depth_m, o[2] + d[2] * depth_m

    def _cast_at_shell(self, direction: Vector) -> tuple[np.ndarray, np.ndarray]:
        o = self._room.shell.point_to_local(self._origin())
        d = self._room.shell.direction_to_local(direction)
        with np.errstate(divide="ignore"):
            leaves = np.stack([(np.where(d[i] > 0, 1.0, -1.0) - o[i]) / d[i] for i in range(3)])
        leaves = np.where(np.isfinite(leaves), leaves, np.inf)
        axis = np.argmin(leaves, axis=0)
        rays = np.arange(len(axis))
        return leaves[axis, rays], 2 * axis + (np.stack(d)[axis, rays] > 0)

    def _origin(self) -> Vector:
        return vector(self._T[:3, 3])

    def _directions(self, u: np.ndarray, v: np.ndarray) -> Vector:
        """World directions with z = 1 in the camera, so that their parameter is depth."""
        x, y = (u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fy
        R = self._T
        return (
            R[0, 0] * x + R[0, 1] * y + R[0, 2],
            R[1, 0] * x + R[1, 1] * y + R[1, 2],
            R[2, 0] * x + R[2, 1] * y + R[2, 2],
        )


@dataclass(frozen=True, slots=True)
class _Window:
    """The part of an image that a solid can cover, in pixels."""

    left: float
    right: float
    top: float
    bottom: float

    def covered(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Indices of the pixels in it."""
        if self.left > self.right or self.right < u.min() or self.left > u.max():
            return np.empty(0, np.int64)
        across = (u >= self.left) & (u <= self.right)
        return np.flatnonzero(across & (v >= self.top) & (v <= self.bottom))


def _window(solid: Solid, camera: Camera, T: np.ndarray) -> _Window:
    """Bounds of the projected corners; everything for a solid that reaches behind the camera."""
    offset = solid.corners_m() - T[:3, 3]
    x, y, z = (
        offset[:, 0] * T[0, i] + offset[:, 1] * T[1, i] + offset[:, 2] * T[2, i] for i in range(3)
    )
    if z.max() < NEAR_M:
        return _Window(1, 0, 1, 0)
    if z.min() < NEAR_M:
        return _Window(-1, camera.width, -1, camera.height)
    u, v = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
    return _Window(u.min() - 1, u.max() + 1, v.min() - 1, v.max() + 1)


def _outline(surface: np.ndarray) -> np.ndarray:
    """Pixels [H, W] with a neighbour on another surface."""
    edge = np.zeros(surface.shape, bool)
    across, down = surface[:, 1:] != surface[:, :-1], surface[1:] != surface[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
