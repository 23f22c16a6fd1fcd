"""Ray intersection with boxes, ellipsoids, cylinders and cones.

Each shape fills the cube -1..1 in its local frame and is scaled to its size.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

# Components x, y, z: each [P] for P vectors, or [] for a single vector.
Vector = tuple[np.ndarray, np.ndarray, np.ndarray]
# A wheel is a cylinder along x; the other cylinders and the cones are along z.
Shape = Literal["box", "ball", "cylinder", "wheel", "cone", "bucket", "lampshade"]
# Parameters (m, k) of the shapes with radius m + k z in the local frame. The apex of a cone is up,
# a bucket widens upward, and a lampshade narrows upward.
TAPERS = {"cone": (0.5, -0.5), "bucket": (0.8125, 0.1875), "lampshade": (0.75, -0.25)}


def vector(components: Iterable[np.ndarray | float]) -> Vector:
    """Return three components as float arrays."""
    x, y, z = (np.asarray(component, float) for component in components)
    return x, y, z


@dataclass(frozen=True, slots=True)
class Solid:
    """Convex solid that stands upright in the world, z up.

    The local frame of a solid is aligned with the solid and scaled so that the solid fills the cube
    -1..1.
    """

    shape: Shape
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]  # Full extents along the solid's axes.
    texture: str
    heading: tuple[float, float] = (1.0, 0.0)  # Unit vector (x, y) of the solid's x axis.

    def point_to_local(self, p: Vector) -> Vector:
        """Transform a world point to the local frame."""
        return self.direction_to_local(
            (p[0] - self.center_m[0], p[1] - self.center_m[1], p[2] - self.center_m[2])
        )

    def direction_to_local(self, d: Vector) -> Vector:
        """Transform a world direction to the local frame, including the scale of the frame."""
        (c, s), (sx, sy, sz) = self.heading, self.size_m
        return (
            (c * d[0] + s * d[1]) * (2 / sx),
            (c * d[1] - s * d[0]) * (2 / sy),
            d[2] * (2 / sz),
        )

    def normal(self, q: Vector) -> tuple[Vector, np.ndarray]:
        """Return surface normals at local points.

        Args:
            q: Points [P] on the surface, in the local frame.

        Returns:
            Unit normals in the world, and the index [P] of the solid's axis nearest to each normal.
        """
        n = _NORMALS[self.shape](q)
        n = tuple(component * (2 / size) for component, size in zip(n, self.size_m, strict=True))
        length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        x, y, z = (component / length for component in n)
        along_x, along_y, along_z = np.abs(x), np.abs(y), np.abs(z)
        is_x = (along_x >= along_y) & (along_x >= along_z)
        axis = np.where(is_x, 0, np.where(along_y >= along_z, 1, 2))
        c, s = self.heading
        return (c * x - s * y, s * x + c * y, z), axis

    def surface(self, point: Vector) -> tuple[Vector, np.ndarray, np.ndarray]:
        """Return normals and texture coordinates at world points on the surface.

        Returns:
            Unit normals in the world, and texture coordinates u_m [P] and v_m [P]. u and v run
            along the two axes of the solid that are farthest from the normal. On the sides of the
            solid, v points up.
        """
        local = self.point_to_local(point)
        normal, axis = self.normal(local)
        x, y, z = (q * (size / 2) for q, size in zip(local, self.size_m, strict=True))
        return normal, np.where(axis == 0, y, x), np.where(axis == 2, y, z)

    def corners_m(self) -> np.ndarray:
        """Return the corners [8, 3] of the solid's bounding box in the world."""
        (c, s), half = self.heading, np.array(self.size_m) / 2
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        x, y, z = (signs * half).T
        return np.array(self.center_m) + np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def interval(shape: Shape, o: Vector, d: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays o + t d enter and leave the shape in its local frame.

    Args:
        shape: The shape.
        o: Origins of the rays in the local frame.
        d: Directions of the rays in the local frame.

    Returns:
        Parameters t of entry and exit; entry >= exit for rays that miss.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape == "ball":
            return _round(o, d, 3)
        if shape == "wheel":
            return interval("cylinder", _upright(o), _upright(d))
        bounds = [_slab(o[2], d[2])]
        if shape in TAPERS:
            bounds.append(_taper(o, d, *TAPERS[shape]))
        elif shape == "cylinder":
            bounds.append(_round(o, d, 2))
        else:
            bounds += [_slab(o[0], d[0]), _slab(o[1], d[1])]
        enter, leave = bounds[0]
        for near, far in bounds[1:]:
            enter, leave = np.maximum(enter, near), np.minimum(leave, far)
        return enter, leave


def _slab(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = (-1 - o) / d, (1 - o) / d
    return np.minimum(a, b), np.maximum(a, b)


def _round(o: Vector, d: Vector, dimensions: int) -> tuple[np.ndarray, np.ndarray]:
    """Intersect rays with the unit sphere (3 dimensions) or the infinite z cylinder (2)."""
    a = d[0] * d[0] + d[1] * d[1]
    b = o[0] * d[0] + o[1] * d[1]
    c = o[0] * o[0] + o[1] * o[1] - 1
    if dimensions == 3:
        a, b, c = a + d[2] * d[2], b + o[2] * d[2], c + o[2] * o[2]
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))  # A miss gives an empty interval.
    return (-b - root) / a, (-b + root) / a


def _taper(o: Vector, d: Vector, m: float, k: float) -> tuple[np.ndarray, np.ndarray]:
    """Intersect rays with the infinite half cone x^2 + y^2 < (m + k z)^2 that contains the origin.

    A ray meets the full double cone at two roots. A ray flatter than the side of the cone is inside
    one half of the double cone between the roots. A steeper ray is inside the half with the origin
    either before the first root or after the second.
    """
    r, dr = m + k * o[2], k * d[2]
    a = d[0] * d[0] + d[1] * d[1] - dr * dr
    b = o[0] * d[0] + o[1] * d[1] - r * dr
    c = o[0] * o[0] + o[1] * o[1] - r * r
    square = b * b - a * c
    root = np.sqrt(np.maximum(square, 0.0))
    p, q = (-b - root) / a, (-b + root) / a
    near, far = np.minimum(p, q), np.maximum(p, q)
    steep = a < 0
    enter = np.where(steep, np.where(dr > 0, far, -np.inf), near)
    leave = np.where(steep, np.where(dr > 0, np.inf, near), far)
    return enter, np.where(~steep & (square < 0), -np.inf, leave)


def _upright(v: Vector) -> Vector:
    """Permute the local axes so that a wheel's axle, x, becomes z."""
    return v[1], v[2], v[0]


def _box_normal(q: Vector) -> Vector:
    sizes = [np.abs(component) for component in q]
    largest = np.maximum(np.maximum(*sizes[:2]), sizes[2])
    x, y, z = (
        np.where(size == largest, np.sign(component), 0.0)
        for size, component in zip(sizes, q, strict=True)
    )
    return x, y * (x == 0), z * (x == 0) * (y == 0)


def _ball_normal(q: Vector) -> Vector:
    return q


def _cylinder_normal(q: Vector) -> Vector:
    cap = q[2] * q[2] > q[0] * q[0] + q[1] * q[1]
    return np.where(cap, 0.0, q[0]), np.where(cap, 0.0, q[1]), np.where(cap, np.sign(q[2]), 0.0)


def _wheel_normal(q: Vector) -> Vector:
    y, z, x = _cylinder_normal(_upright(q))
    return x, y, z


def _taper_normal(m: float, k: float) -> Callable[[Vector], Vector]:
    def normal(q: Vector) -> Vector:
        r = np.maximum(m + k * q[2], 1e-12)
        cap = q[2] * q[2] * r * r > q[0] * q[0] + q[1] * q[1]
        side = -k * r
        return (
            np.where(cap, 0.0, q[0]),
            np.where(cap, 0.0, q[1]),
            np.where(cap, np.sign(q[2]), side),
        )

    return normal


_NORMALS: dict[str, Callable[[Vector], Vector]] = {
    "box": _box_normal,
    "ball": _ball_normal,
    "cylinder": _cylinder_normal,
    "wheel": _wheel_normal,
    **{shape: _taper_normal(*taper) for shape, taper in TAPERS.items()},
}
