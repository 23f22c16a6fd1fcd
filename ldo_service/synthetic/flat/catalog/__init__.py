"""How things look: builders by class name, several shapes for many classes.

A builder takes the paints and a shape number and gives solids in the thing's own frame: the origin
is the middle of its underside (of its back, for what hangs on a wall) and its front looks along -y.
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
