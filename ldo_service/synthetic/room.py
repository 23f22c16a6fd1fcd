"""The synthetic room and its furniture.

World frame: x and y along the walls, z up; the origin is the center of the floor.
"""

from dataclasses import dataclass

import numpy as np

from . import textures
from .solids import Solid
from .textures import Texture, mipmapped

SIZE_M = (5.2, 4.2, 2.6)
LEFT, RIGHT, BACK, FRONT = -SIZE_M[0] / 2, SIZE_M[0] / 2, SIZE_M[1] / 2, -SIZE_M[1] / 2


@dataclass(frozen=True, slots=True)
class Room:
    """Box seen from within, with furniture and one square lamp under the ceiling."""

    shell: Solid
    faces: tuple[str, ...]  # Texture names of the sides -x, +x, -y, +y, -z, +z.
    furniture: tuple[Solid, ...]
    textures: dict[str, Texture]
    lamp_center_m: tuple[float, float, float]
    lamp_side_m: float


def furnished_room(seed: int) -> Room:
    """Return a living room; `seed` determines its textures."""
    return Room(
        shell=Solid("box", (0, 0, SIZE_M[2] / 2), SIZE_M, ""),
        faces=("sand", "wallpaper", "sand", "sage", "floor", "ceiling"),
        furniture=(*_sofa(), *_table(), *_shelf(), *_cabinet(), *_walls(), *_things()),
        textures=_textures(seed),
        lamp_center_m=(0.1, 0.1, 2.5),
        lamp_side_m=0.8,
    )


def _sofa() -> tuple[Solid, ...]:
    y = BACK - 0.5
    return (
        Solid("box", (-0.9, y, 0.22), (2.0, 0.85, 0.44), "sofa"),
        Solid("box", (-0.9, BACK - 0.14, 0.62), (2.0, 0.24, 0.42), "sofa"),
        Solid("box", (-1.98, y, 0.32), (0.2, 0.85, 0.64), "sofa"),
        Solid("box", (0.18, y, 0.32), (0.2, 0.85, 0.64), "sofa"),
        Solid("box", (-1.5, BACK - 0.38, 0.62), (0.44, 0.16, 0.38), "cushion", (0.96, -0.28)),
    )


def _table() -> tuple[Solid, ...]:
    legs = [(x, y) for x in (-1.15, -0.35) for y in (0.13, 0.57)]
    return (
        Solid("box", (-0.75, 0.35, 0.43), (1.0, 0.6, 0.05), "oak"),
        *(Solid("box", (x, y, 0.2), (0.06, 0.06, 0.41), "oak") for x, y in legs),
        Solid("cylinder", (-0.95, 0.4, 0.55), (0.14, 0.14, 0.19), "glaze"),
        Solid("box", (-0.55, 0.28, 0.475), (0.24, 0.17, 0.04), "ball", (0.8, 0.6)),
    )


def _shelf() -> tuple[Solid, ...]:
    x = RIGHT - 0.16
    return (
        Solid("box", (x, 1.0, 0.95), (0.3, 1.1, 1.78), "books"),
        Solid("box", (x - 0.01, 1.0, 1.87), (0.34, 1.2, 0.06), "oak"),
        Solid("box", (x - 0.01, 1.58, 0.92), (0.34, 0.05, 1.84), "oak"),
        Solid("box", (x - 0.01, 0.42, 0.92), (0.34, 0.05, 1.84), "oak"),
    )


def _cabinet() -> tuple[Solid, ...]:
    return (
        Solid("box", (RIGHT - 0.24, -1.0, 0.4), (0.44, 1.3, 0.8), "walnut"),
        Solid("cylinder", (RIGHT - 0.24, -1.35, 0.95), (0.2, 0.2, 0.3), "glaze"),
        Solid("ball", (RIGHT - 0.24, -1.35, 1.28), (0.5, 0.5, 0.46), "leaves"),
        Solid("box", (RIGHT - 0.2, -0.75, 0.98), (0.08, 0.5, 0.36), "painting2", (0.96, 0.28)),
    )


def _walls() -> tuple[Solid, ...]:
    return (
        Solid("box", (-0.9, BACK - 0.015, 1.62), (1.3, 0.04, 0.8), "painting"),
        Solid("box", (1.1, BACK - 0.015, 1.6), (0.6, 0.04, 0.8), "painting2"),
        Solid("box", (LEFT + 0.02, -0.5, 1.45), (0.05, 1.3, 1.2), "window"),
        Solid("box", (LEFT + 0.03, -0.5, 1.45), (0.07, 0.06, 1.2), "frame"),
        Solid("box", (LEFT + 0.03, -0.5, 0.83), (0.12, 1.4, 0.06), "frame"),
        Solid("box", (LEFT + 0.09, 0.32, 1.32), (0.12, 0.34, 2.3), "curtain"),
        Solid("box", (0.9, FRONT + 0.03, 1.02), (0.9, 0.06, 2.04), "walnut"),
        Solid("box", (-1.2, FRONT + 0.015, 1.5), (1.0, 0.04, 0.7), "painting"),
    )


def _things() -> tuple[Solid, ...]:
    return (
        Solid("box", (-0.5, 0.2, 0.006), (2.6, 1.7, 0.012), "rug", (0.995, 0.0998749217771909)),
        Solid("ball", (0.75, -0.15, 0.16), (0.32, 0.32, 0.32), "ball"),
        Solid("box", (1.0, 1.55, 0.22), (0.5, 0.5, 0.44), "cushion", (0.8, 0.6)),
        Solid("cylinder", (LEFT + 0.45, 1.3, 0.02), (0.34, 0.34, 0.04), "glaze"),
        Solid("cylinder", (LEFT + 0.45, 1.3, 0.75), (0.04, 0.04, 1.46), "glaze"),
        Solid("cylinder", (LEFT + 0.45, 1.3, 1.58), (0.42, 0.42, 0.34), "shade"),
        Solid("box", (-1.2, FRONT + 0.3, 0.3), (1.4, 0.45, 0.6), "oak"),
        Solid("box", (-1.55, FRONT + 0.3, 0.72), (0.3, 0.26, 0.24), "curtain", (0.96, 0.28)),
    )


def _textures(seed: int) -> dict[str, Texture]:
    rng = np.random.default_rng(seed)
    sunset = ((0.16, 0.27, 0.42), (0.85, 0.47, 0.25), (0.93, 0.82, 0.6), (0.45, 0.16, 0.2))
    meadow = ((0.83, 0.82, 0.72), (0.32, 0.5, 0.36), (0.15, 0.3, 0.36), (0.82, 0.62, 0.25))
    painted = {
        "sand": (textures.plaster(rng, (0.84, 0.78, 0.69)), 2.6),
        "sage": (textures.plaster(rng, (0.66, 0.74, 0.68)), 2.6),
        "ceiling": (textures.plaster(rng, (0.93, 0.92, 0.89)), 2.6),
        "wallpaper": (textures.wallpaper(rng, (0.78, 0.8, 0.84), (0.42, 0.5, 0.64)), 1.3),
        "floor": (textures.planks(rng, (0.79, 0.6, 0.41), (0.42, 0.27, 0.16)), 1.28),
        "sofa": (textures.fabric(rng, (0.25, 0.38, 0.5), (0.46, 0.58, 0.68)), 0.9),
        "cushion": (textures.fabric(rng, (0.8, 0.45, 0.2), (0.95, 0.75, 0.45)), 0.7),
        "curtain": (textures.fabric(rng, (0.62, 0.3, 0.28), (0.82, 0.55, 0.48)), 0.8),
        "oak": (textures.wood(rng, (0.8, 0.63, 0.43), (0.55, 0.37, 0.22)), 0.8),
        "walnut": (textures.wood(rng, (0.52, 0.35, 0.24), (0.26, 0.16, 0.1)), 0.8),
        "rug": (textures.rug(rng, (0.74, 0.68, 0.58), (0.55, 0.18, 0.16)), 1.7),
        "books": (textures.books(rng), 0.8),
        "painting": (textures.painting(rng, sunset), 1.3),
        "painting2": (textures.painting(rng, meadow), 0.8),
        "window": (textures.plaster(rng, (0.86, 0.93, 0.99)) * 1.1, 2.0),
        "frame": (textures.plaster(rng, (0.92, 0.9, 0.86)), 1.0),
        "glaze": (textures.plaster(rng, (0.3, 0.46, 0.45)), 0.4),
        "shade": (textures.fabric(rng, (0.95, 0.87, 0.68), (0.99, 0.95, 0.84)), 0.5),
        "leaves": (textures.leaves(rng, (0.1, 0.22, 0.1), (0.42, 0.6, 0.25)), 0.5),
        "ball": (textures.rug(rng, (0.9, 0.85, 0.75), (0.8, 0.25, 0.15)), 0.5),
        # The textures of the person come last, so that the room looks the same without a person.
        "skin": (textures.plaster(rng, (0.8, 0.6, 0.48)), 0.5),
        "shirt": (textures.fabric(rng, (0.7, 0.2, 0.18), (0.9, 0.85, 0.8)), 0.4),
        "trousers": (textures.fabric(rng, (0.16, 0.2, 0.34), (0.3, 0.36, 0.52)), 0.5),
        "shoes": (textures.plaster(rng, (0.2, 0.17, 0.15)), 0.3),
    }
    return {name: mipmapped(tile, size_m) for name, (tile, size_m) in painted.items()}
