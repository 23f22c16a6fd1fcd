"""One object: a class, and the solids it is made of."""

from dataclasses import dataclass, replace

import numpy as np

from ldo_service.datasets.synthetic.solids import Solid

Heading = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Placement:
    """A frame standing upright in another: its origin there, and the direction of its x axis."""

    origin_m: tuple[float, float, float]
    heading: Heading = (1.0, 0.0)

    def __call__(self, solid: Solid) -> Solid:
        """The solid, seen from the outer frame."""
        (x, y, z), (px, py, pz) = solid.center_m, self.origin_m
        (c, s), (hx, hy) = self.heading, solid.heading
        center_m = (px + (c * x - s * y), py + (s * x + c * y), pz + z)
        return replace(solid, center_m=center_m, heading=(c * hx - s * hy, s * hx + c * hy))


@dataclass(frozen=True, slots=True)
class Thing:
    """An object of one class in the world."""

    label: str
    solids: tuple[Solid, ...]

    @property
    def bounds_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre [3] and size [3] of its box along the axes of the world."""
        corners = np.concatenate([solid.corners_m() for solid in self.solids])
        low, high = corners.min(axis=0), corners.max(axis=0)
        return (low + high) / 2, high - low
