"""The whole flat: the building, the things in it, and a table of all their surfaces."""

from dataclasses import dataclass

import numpy as np

from ldo_service.synthetic.solids import Solid
from ldo_service.synthetic.textures import Texture

from .building import Panel, panels
from .furnishing import things
from .paint import materials
from .scene_object import CLASS_NAMES, SceneObject


@dataclass(frozen=True, slots=True)
class Flat:
    """The building, everything in it, and of each thing the room whose lamp lights it."""

    panels: tuple[Panel, ...]
    things: tuple[SceneObject, ...]
    rooms: tuple[int, ...]
    textures: dict[str, Texture]


def furnished_flat(seed: int) -> Flat:
    """The flat; `seed` paints its textures and chooses who wears which."""
    placed = things(seed)
    return Flat(panels(), tuple(t for t, _ in placed), tuple(r for _, r in placed), materials(seed))


@dataclass(frozen=True, slots=True)
class SurfaceTable:
    """Every solid of the flat, those of the panels first; all in one order, S of them.

    rooms         [S] which lamp lights it
    class_ids     [S] uint8
    instance_ids  [S] uint16
    """

    solids: tuple[Solid, ...]
    rooms: np.ndarray
    class_ids: np.ndarray
    instance_ids: np.ndarray


def surfaces(flat: Flat) -> SurfaceTable:
    """The table of a flat's solids."""
    rows = [(panel.solid, panel.room, panel.class_id, 0) for panel in flat.panels]
    for number, (thing, room) in enumerate(zip(flat.things, flat.rooms, strict=True), 1):
        class_id = CLASS_NAMES.index(thing.label)
        rows += [(solid, room, class_id, number) for solid in thing.solids]
    solids, rooms, class_ids, instance_ids = zip(*rows, strict=True)
    return SurfaceTable(
        solids, np.array(rooms), np.array(class_ids, np.uint8), np.array(instance_ids, np.uint16)
    )
