"""What is rendered."""

from dataclasses import dataclass

from .solids import Solid
from .textures import Texture


@dataclass(frozen=True, slots=True)
class Room:
    """A box seen from within, what stands in it, and one square lamp under the ceiling.

    faces    texture names of the sides -x, +x, -y, +y, -z, +z
    """

    shell: Solid
    faces: tuple[str, ...]
    furniture: tuple[Solid, ...]
    textures: dict[str, Texture]
    lamp_center_m: tuple[float, float, float]
    lamp_side_m: float
