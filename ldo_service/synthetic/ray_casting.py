"""Ray casting of a camera image with exact depth, in a scene enclosed by a box, the shell."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ldo_service.geometry import Camera

from .optics import max_displacement_px, undistorted
from .solids import Solid, Vector, interval, vector

NEAR_M = 0.05
# If each row has its own pose, a solid is projected at ROW_POSES of these poses. The motion of a
# solid that is in view at only one of them is unknown. Its window is widened by ROW_MARGIN_PX.
ROW_POSES, ROW_MARGIN_PX = 5, 4.0


@dataclass(frozen=True, slots=True)
class Hits:
    """Nearest surfaces along P rays; every ray hits one, because the shell encloses the scene."""

    depth_m: np.ndarray  # Depth [P], z in the camera frame.
    surface: np.ndarray  # Index [P] of the surface: 0-5 are the shell's faces, 6 + k is solid k.
    point: Vector  # Points [P] in the world.

    def points(self, rays: np.ndarray) -> Vector:
        """Return the world points of some of the rays, given by their indices."""
        x, y, z = self.point
        return x[rays], y[rays], z[rays]

    def by_surface(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each surface that was hit: its index, and the indices of the rays that hit it."""
        # NumPy sorts numbers of 16 bits much faster.
        order = np.argsort(self.surface.astype(np.uint16), kind="stable")
        met, starts = np.unique(self.surface[order], return_index=True)
        bounds = np.append(starts, len(order))
        for surface, start, stop in zip(met, bounds[:-1], bounds[1:], strict=True):
            yield int(surface), order[start:stop]


class RayCaster:
    """Ray caster of one camera pose, or of one pose for each row (rolling shutter).

    Each solid is projected into the image at one pose, or at a few of the row poses. A ray is
    tested against a solid only if its pixel lies in the window around that projection.
    """

    def __init__(
        self,
        shell: Solid,
        solids: tuple[Solid, ...],
        camera: Camera,
        T_world_camera: np.ndarray,
    ) -> None:
        """Project the solids into the image.

        Args:
            shell: Box that contains the camera; rays that hit no solid end on its faces.
            solids: All other solids.
            camera: Intrinsics; lens distortion bends the rays.
            T_world_camera: Camera pose [4, 4], or one pose for each row of the image, [H, 4, 4].
        """
        self.camera = camera
        self._shell = shell
        self._solids = solids
        # [3, 4], or [3, 4, H]: the same component of all rows is contiguous.
        poses = T_world_camera[..., :3, :]
        self._poses_of_rows = poses if poses.ndim == 2 else np.moveaxis(poses, 0, 2).copy()
        self._windows = [_window(solid, camera, T_world_camera) for solid in solids]

    def cast(self, u: np.ndarray, v: np.ndarray) -> Hits:
        """Return the nearest surface along the ray of each pixel.

        Args:
            u: Columns [P], pixels; fractions are allowed.
            v: Rows [P], pixels, in ascending order.
        """
        u, v = u.astype(float), v.astype(float)  # Otherwise, every comparison below converts them.
        T = self._poses(v)
        direction, origin = self._directions(T, u, v), (T[0][3], T[1][3], T[2][3])
        depth_m, surface = self._cast_at_shell(origin, direction)
        for k, (solid, window) in enumerate(zip(self._solids, self._windows, strict=True)):
            if window is EMPTY:
                continue
            rays = window.covered(u, v)
            if not len(rays):
                continue
            d = solid.direction_to_local(vector(component[rays] for component in direction))
            o = solid.point_to_local(vector(c[rays] if c.ndim else c for c in origin))
            enter, leave = interval(solid.shape, o, d)
            nearer = (enter < leave) & (enter > NEAR_M) & (enter < depth_m[rays])
            depth_m[rays[nearer]] = enter[nearer]
            surface[rays[nearer]] = 6 + k
        x, y, z = (o + d * depth_m for o, d in zip(origin, direction, strict=True))
        return Hits(depth_m, surface, (x, y, z))

    def _cast_at_shell(self, origin: Vector, direction: Vector) -> tuple[np.ndarray, np.ndarray]:
        o = self._shell.point_to_local(origin)
        d = self._shell.direction_to_local(direction)
        depth_m, surface = np.full(d[0].shape, np.inf), np.zeros(d[0].shape, np.int64)
        for i in range(3):
            is_ahead = d[i] > 0
            with np.errstate(divide="ignore"):
                leaves = (np.where(is_ahead, 1.0, -1.0) - o[i]) / d[i]
            nearer = np.isfinite(leaves) & (leaves < depth_m)
            np.copyto(depth_m, leaves, where=nearer)
            np.copyto(surface, 2 * i + is_ahead, where=nearer)
        return depth_m, surface

    def _poses(self, v: np.ndarray) -> np.ndarray:
        """Return the pose of all rays, [3, 4], or the poses of the rows v, [3, 4, P]."""
        if self._poses_of_rows.ndim == 2:
            return self._poses_of_rows
        rows = np.clip(np.floor(v + 0.5).astype(np.int64), 0, self._poses_of_rows.shape[2] - 1)
        return self._poses_of_rows.take(rows, 2)

    def _directions(self, T: np.ndarray, u: np.ndarray, v: np.ndarray) -> Vector:
        """Return the world directions d of the rays, scaled to z = 1 in the camera.

        With this scale, the parameter t of a point o + t d is its depth.
        """
        x, y = undistorted(self.camera, u, v)
        return (
            T[0, 0] * x + T[0, 1] * y + T[0, 2],
            T[1, 0] * x + T[1, 1] * y + T[1, 2],
            T[2, 0] * x + T[2, 1] * y + T[2, 2],
        )


@dataclass(frozen=True, slots=True)
class _Window:
    """Part of an image that a solid can cover, in pixels."""

    left: float
    right: float
    top: float
    bottom: float

    def covered(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the indices of the pixels u, v [P] in the window; v must be in ascending order."""
        first = int(np.searchsorted(v, self.top))
        stop = int(np.searchsorted(v, self.bottom, side="right"))
        u = u[first:stop]
        return first + np.flatnonzero((u >= self.left) & (u <= self.right))


EMPTY = _Window(1, 0, 1, 0)


def _window(solid: Solid, camera: Camera, T: np.ndarray) -> _Window:
    """Return the window of a solid at one pose [4, 4], or at the poses of all rows [H, 4, 4].

    With one pose for each row, the windows at a few of the row poses are united. The union is grown
    by the largest motion between two successive poses of these. With lens distortion, the window
    also grows by the largest displacement of a pixel.
    """
    if T.ndim == 2 and not any(camera.distortion):
        return _window_at(solid, camera, T)
    pinhole = camera.rectified()
    rows = np.linspace(0, len(T) - 1, ROW_POSES).astype(np.int64)
    poses = T[None] if T.ndim == 2 else T[rows]
    # The margin widens the image, because distortion moves surfaces from outside into the image.
    margin = max_displacement_px(camera)
    windows = [_window_at(solid, pinhole, pose, margin) for pose in poses]
    seen = np.array([(w.left, w.right, w.top, w.bottom) for w in windows if w != EMPTY])
    if not len(seen):
        return EMPTY
    margins = (
        margin
        + ROW_MARGIN_PX
        + (np.abs(np.diff(seen, axis=0)).max(axis=0) if len(seen) > 1 else 0.0)
    )
    low, high = (seen - margins).min(axis=0), (seen + margins).max(axis=0)
    return _Window(low[0], high[1], low[2], high[3])


@lru_cache(maxsize=4096)
def _corners_m(solid: Solid) -> np.ndarray:
    return solid.corners_m()


def _window_at(solid: Solid, camera: Camera, T: np.ndarray, margin_px: float = 0.0) -> _Window:
    """Return the window of a solid: the bounds of its projected corners.

    The window is empty if the solid is outside the field of view. It is the whole image if the
    solid is in view and extends behind the camera.
    """
    offset = _corners_m(solid) - T[:3, 3]
    x, y, z = (
        offset[:, 0] * T[0, i] + offset[:, 1] * T[1, i] + offset[:, 2] * T[2, i] for i in range(3)
    )
    far_u, far_v = camera.width + margin_px, camera.height + margin_px
    right, bottom = (far_u - camera.cx) / camera.fx, (far_v - camera.cy) / camera.fy
    near_px = -1 - margin_px
    left, top = (near_px - camera.cx) / camera.fx, (near_px - camera.cy) / camera.fy
    beside = (x > right * z).all() or (x < left * z).all()
    if z.max() < NEAR_M or beside or (y > bottom * z).all() or (y < top * z).all():
        return EMPTY
    if z.min() < NEAR_M:
        return _Window(-1, camera.width, -1, camera.height)
    u, v = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
    return _Window(u.min() - 1, u.max() + 1, v.min() - 1, v.max() + 1)


def outline(surface: np.ndarray) -> np.ndarray:
    """Return a mask [H, W] of the pixels with a neighbor on another surface."""
    edge = np.zeros(surface.shape, bool)
    across, down = surface[:, 1:] != surface[:, :-1], surface[1:] != surface[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
