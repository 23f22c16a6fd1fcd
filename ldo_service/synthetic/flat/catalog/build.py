"""Helper functions of the object builders."""

from collections.abc import Callable

from ldo_service.synthetic.flat.paint import Materials
from ldo_service.synthetic.flat.scene_object import Heading
from ldo_service.synthetic.solids import Shape, Solid

Solids = tuple[Solid, ...]
Builder = Callable[[Materials, int], Solids]  # Function of materials and shape number.
Triple = tuple[float, float, float]


def solid(
    shape: Shape, foot_m: Triple, size_m: Triple, paint: str, heading: Heading = (1.0, 0.0)
) -> Solid:
    """Return a solid with the center of its underside at `foot_m`."""
    x, y, z = foot_m
    return Solid(shape, (x, y, z + size_m[2] / 2), size_m, paint, heading)


def box(foot_m: Triple, size_m: Triple, paint: str, heading: Heading = (1.0, 0.0)) -> Solid:
    """Return a box with the center of its underside at `foot_m`."""
    return solid("box", foot_m, size_m, paint, heading)


def ball(foot_m: Triple, size_m: Triple, paint: str) -> Solid:
    """Return an ellipsoid with the center of its underside at `foot_m`."""
    return solid("ball", foot_m, size_m, paint)


def cylinder(foot_m: Triple, width_m: float, height_m: float, paint: str) -> Solid:
    """Return an upright cylinder with the center of its underside at `foot_m`."""
    return solid("cylinder", foot_m, (width_m, width_m, height_m), paint)


def legs(width_m: float, depth_m: float, height_m: float, thick_m: float, paint: str) -> Solids:
    """Return four legs at the corners of a rectangle centered at the origin."""
    x, y = (width_m - thick_m) / 2, (depth_m - thick_m) / 2
    size_m = (thick_m, thick_m, height_m)
    return tuple(box((sx * x, sy * y, 0), size_m, paint) for sx in (-1, 1) for sy in (-1, 1))
