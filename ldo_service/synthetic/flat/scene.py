"""The whole flat: the building, its objects and lamps, and a table of all solids."""

from dataclasses import dataclass

import numpy as np

from ldo_service.synthetic.solids import Solid
from ldo_service.synthetic.textures import Texture

from .building import SHELL, Panel, lamp_centers_m, panels
from .furnishing import things
from .paint import materials
from .scene_object import CLASS_NAMES, SceneObject


@dataclass(frozen=True, slots=True)
class Flat:
    """Building with its objects and lamps."""

    panels: tuple[Panel, ...]  # Walls, floors and ceilings.
    things: tuple[SceneObject, ...]  # Objects.
    rooms: tuple[int, ...]  # Room index of each object; the lamp of that room lights the object.
    textures: dict[str, Texture]  # Textures of panels and objects, by name.
    # Center of the lamp of each room in the world frame, x, y, z.
    lamps_m: tuple[tuple[float, float, float], ...]
    shell: Solid  # Encloses the building; never visible.


def furnished_flat(seed: int) -> Flat:
    """Return the flat of two rooms; `seed` determines its textures and the objects' materials."""
    placed = things(seed)
    return Flat(
        panels=panels(),
        things=tuple(thing for thing, _ in placed),
        rooms=tuple(room for _, room in placed),
        textures=materials(seed),
        lamps_m=lamp_centers_m(),
        shell=SHELL,
    )


@dataclass(frozen=True, slots=True)
class SurfaceTable:
    """Table of all S solids of the flat, the panels first."""

    solids: tuple[Solid, ...]
    rooms: np.ndarray  # Room index [S]; the lamp of that room lights the solid.
    class_ids: np.ndarray  # Class [S] uint8.
    instance_ids: np.ndarray  # Object [S] uint16; 0 for the building.


def surfaces(flat: Flat) -> SurfaceTable:
    """Return the table of a flat's solids."""
    rows = [(panel.solid, panel.room, panel.class_id, 0) for panel in flat.panels]
    for number, (thing, room) in enumerate(zip(flat.things, flat.rooms, strict=True), 1):
        class_id = CLASS_NAMES.index(thing.label)
        rows += [(solid, room, class_id, number) for solid in thing.solids]
    solids, rooms, class_ids, instance_ids = zip(*rows, strict=True)
    return SurfaceTable(
        solids, np.array(rooms), np.array(class_ids, np.uint8), np.array(instance_ids, np.uint16)
    )
