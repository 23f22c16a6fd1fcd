"""Catalog of object builders by class name; many classes have several shapes.

A builder takes the materials and a shape number. The number counts from 0; builders with a single
shape ignore it. A builder returns solids in the object's own frame: the front faces -y, and the
origin is the center of the underside. For objects on a wall, the origin is the center of the back.
"""

from . import machines, rooms, small
from .build import Builder

CATALOG: dict[str, Builder] = {
    **rooms.FURNITURE,
    **machines.APPLIANCES,
    **small.KITCHENWARE,
    **machines.OFFICE,
    **small.BELONGINGS,
    **rooms.FIXTURES,
}

__all__ = ["CATALOG"]
