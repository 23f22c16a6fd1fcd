"""Furnishing of a room: objects at random positions without collisions."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from inventory import (
    AT_WALLS,
    BOARDS_M,
    FLAT_SHAPES,
    HUNG,
    IN_SHELVES,
    LYING,
    ON_SEATS,
    ON_SHELVES,
    ON_TABLES,
    ON_THE_FLOOR,
    SEATS_M,
    SHAPES,
    STANDING,
    TABLES,
)

from ldo_service.synthetic.flat.building import HEIGHT_M
from ldo_service.synthetic.flat.catalog import CATALOG
from ldo_service.synthetic.flat.paint import Materials
from ldo_service.synthetic.flat.scene_object import Heading, Placement, SceneObject

Point = tuple[float, float, float]

GAP_M = 0.015  # Maximum overlap of the boxes of two objects; it lets objects stand on rugs.
TRIES = 12  # Number of positions to try before an object is omitted.
HEADROOM_M = 0.6  # Free height above tables and seats.
# Maximum number of chairs at a table, and range of the depth to which a chair is pushed under the
# table, meters.
CHAIRS_MOST, PUSHED_M = 4, (-0.15, 0.3)

# Headings (direction of an object's x axis), named by the direction that the object's front faces.
# An object at the back wall has TO_FRONT, at the front wall TO_BACK, at the wall at +x TO_LEFT, and
# at the wall at -x TO_RIGHT.
TO_FRONT, TO_BACK, TO_LEFT, TO_RIGHT = (1.0, 0.0), (-1.0, 0.0), (0.0, -1.0), (0.0, 1.0)
ASKEW = ((1.0, 0.0), (0.96, 0.28), (0.8, 0.6), (0.8, -0.6), (0.96, -0.28))  # Small rotations.


@dataclass
class Builder:
    """Builder of one furnished room, in the world frame of `layout`."""

    rng: np.random.Generator
    paint: Materials
    size_m: tuple[float, float]
    doorway: tuple[np.ndarray, np.ndarray]  # Low and high corner [3] of the space to keep free.
    things: list[SceneObject] = field(default_factory=list)
    _extents: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def build(self, label: str, heading: Heading, shapes: tuple[int, ...] = ()) -> SceneObject:
        """Build an object of a random shape at the origin.

        Args:
            label: Class of the object.
            heading: Direction of the object's x axis, as a unit vector (x, y) in the world frame.
            shapes: Shapes to choose from; empty: all shapes of the class.
        """
        shape = int(self.rng.choice(shapes or range(SHAPES.get(label, 1))))
        solids = CATALOG[label](self.paint, shape)
        turned = Placement((0.0, 0.0, 0.0), heading)
        return SceneObject(label, tuple(turned(solid) for solid in solids))

    def put(
        self, thing: SceneObject, places: Iterable[Point], carrier: SceneObject | None = None
    ) -> SceneObject | None:
        """Place an object at the first position without a collision.

        Args:
            thing: The object at the origin.
            places: Positions x, y, z to try, in this order, meters.
            carrier: Object that carries the new object and may therefore touch it.

        Returns:
            The placed object, or None if no position is free.
        """
        for at in places:
            placed = SceneObject(thing.label, tuple(Placement(at)(solid) for solid in thing.solids))
            if self._is_free(*extent(placed), carrier):
                self.things.append(placed)
                self._extents.append(extent(placed))
                return placed
        return None

    def between(self, low: float, high: float) -> float:
        """Return a random number between two bounds."""
        return float(low + (high - low) * self.rng.random())

    def _is_free(self, low: np.ndarray, high: np.ndarray, carrier: SceneObject | None) -> bool:
        half = np.array(self.size_m) / 2 + 1e-3
        if (low[:2] < -half).any() or (high[:2] > half).any() or high[2] > HEIGHT_M:
            return False
        things = zip(self.things, self._extents, strict=True)
        others = [self.doorway, *(extent for thing, extent in things if thing is not carrier)]
        return not any(
            (low < other_high - GAP_M).all() and (high > other_low + GAP_M).all()
            for other_low, other_high in others
        )


@dataclass(frozen=True, slots=True)
class _Space:
    """Free space on a table, a seat or a board of a shelf."""

    labels: tuple[str, ...]  # Classes that may be placed in the space.
    most: int  # Maximum number of objects.
    low: np.ndarray  # Low corner [3], meters.
    high: np.ndarray  # High corner [3], meters.


def furnish(builder: Builder) -> None:
    """Place random objects along the walls, on the walls and on the floor of a room."""
    rng = builder.rng
    for label in _some(rng, AT_WALLS, 15, 23):
        thing = builder.build(label, TO_FRONT, STANDING.get(label, ()))
        _place(builder, *_along_walls(builder, thing, on_floor=True))
    for label in _some(rng, tuple(HUNG) * 2, 3, 6):
        shapes = (FLAT_SHAPES[label],) if label in FLAT_SHAPES else ()
        builder.put(*_along_walls(builder, builder.build(label, TO_FRONT, shapes), on_floor=False))
    for label in _some(rng, ON_THE_FLOOR, 7, 13):
        thing = _turned(builder, builder.build(label, TO_FRONT, STANDING.get(label, ())))
        _place(builder, thing, _anywhere(builder))


def _place(builder: Builder, thing: SceneObject, places: Iterable[Point]) -> None:
    """Place an object, chairs at a dining table, and objects on a table, seat or shelf."""
    placed = builder.put(thing, places)
    if placed is not None:
        if placed.label == "dining table":
            _seat(builder, placed)
        _load(builder, placed)


def _seat(builder: Builder, table: SceneObject) -> None:
    """Place chairs at the long sides of a table, partly under it."""
    low, high = extent(table)
    across = int(np.argmin((high - low)[:2]))
    for _ in range(int(builder.rng.integers(CHAIRS_MOST + 1))):
        is_beyond = builder.rng.random() < 0.5
        way = ((TO_RIGHT, TO_LEFT), (TO_BACK, TO_FRONT))[across][is_beyond]
        chair = _turned(builder, builder.build("chair", TO_FRONT), (way,))
        out_m = extent(chair)[1][across] - builder.between(*PUSHED_M)
        place = np.zeros(3)
        place[across] = high[across] + out_m if is_beyond else low[across] - out_m
        place[1 - across] = builder.between(low[1 - across], high[1 - across])
        builder.put(chair, [(float(place[0]), float(place[1]), 0.0)], table)


def _some(rng: np.random.Generator, labels: tuple[str, ...], least: int, most: int) -> list[str]:
    """Return a random selection of `least` to `most` labels, in the order of `labels`.

    Large objects come first in that order, so they are placed first.
    """
    count = int(rng.integers(least, most + 1))
    chosen = np.sort(rng.permutation(len(labels))[:count])
    return [labels[k] for k in chosen]


def _turned(
    builder: Builder,
    thing: SceneObject,
    ways: Sequence[Heading] = (TO_FRONT, TO_BACK, TO_LEFT, TO_RIGHT),
) -> SceneObject:
    """Turn an object to a random heading of `ways`, and by at most 37 degrees more."""
    quarter = ways[int(builder.rng.integers(len(ways)))]
    askew = ASKEW[int(builder.rng.integers(len(ASKEW)))]
    turns = (Placement((0.0, 0.0, 0.0), quarter), Placement((0.0, 0.0, 0.0), askew))
    return SceneObject(thing.label, tuple(turns[0](turns[1](solid)) for solid in thing.solids))


def _along_walls(
    builder: Builder, thing: SceneObject, on_floor: bool
) -> tuple[SceneObject, list[Point]]:
    """Turn an object away from a random wall, and choose positions along this wall.

    Args:
        builder: The room.
        thing: The object at the origin, facing TO_FRONT.
        on_floor: True: the object stands on the floor. False: the object is fixed to the wall, at a
            random height from HUNG.

    Returns:
        The turned object at the origin, and TRIES positions, meters.
    """
    wall = int(builder.rng.integers(4))
    heading = (TO_FRONT, TO_BACK, TO_LEFT, TO_RIGHT)[wall]
    if thing.label == "door":  # The leaf of a door is parallel to the wall.
        heading = (TO_RIGHT, TO_LEFT, TO_FRONT, TO_BACK)[wall]
    turned = Placement((0.0, 0.0, 0.0), heading)
    thing = SceneObject(thing.label, tuple(turned(solid) for solid in thing.solids))
    low, high = extent(thing)
    half = np.array(builder.size_m) / 2
    axis, sign = ((1, 1.0), (1, -1.0), (0, 1.0), (0, -1.0))[wall]
    against = half[axis] - high[axis] if sign > 0 else -half[axis] - low[axis]
    places = []
    for _ in range(TRIES):
        along = 1 - axis
        free = builder.between(-half[along] - low[along], half[along] - high[along])
        z = 0.0 if on_floor else builder.between(*HUNG[thing.label]) - (low[2] + high[2]) / 2
        places.append((free, float(against), z) if axis == 1 else (float(against), free, z))
    return thing, places


def _anywhere(builder: Builder) -> Iterator[Point]:
    half = np.array(builder.size_m) / 2
    for _ in range(TRIES):
        yield builder.between(-half[0], half[0]), builder.between(-half[1], half[1]), 0.0


def _load(builder: Builder, carrier: SceneObject) -> None:
    """Place suitable objects on a table, seat or shelf."""
    for space in _spaces(carrier):
        for label in _some(builder.rng, space.labels, 1, space.most):
            thing = _turned(builder, builder.build(label, TO_FRONT, LYING.get(label, ())))
            low, high = extent(thing)
            if (high - low <= space.high - space.low + np.array([0.02, 0.02, 0.0])).all():
                builder.put(thing, list(_places_in(builder, space, low, high)), carrier)


def _places_in(
    builder: Builder, space: _Space, low: np.ndarray, high: np.ndarray
) -> Iterator[Point]:
    """Yield random positions for an object at the bottom of a space.

    Args:
        builder: The room.
        space: The space.
        low: Low corner [3] of the object at the origin, meters.
        high: High corner [3] of the object at the origin, meters.
    """
    to_middle = (space.low + space.high) / 2 - (low + high) / 2
    x, y = np.maximum((space.high - space.low - (high - low)) / 2, 0.0)[:2]
    for _ in range(TRIES // 2):
        at_x = to_middle[0] + builder.between(-x, x)
        at_y = to_middle[1] + builder.between(-y, y)
        yield float(at_x), float(at_y), float(space.low[2])


def _spaces(carrier: SceneObject) -> Iterator[_Space]:
    """Yield the free spaces on a table, a seat or the boards of a shelf."""
    low, high = extent(carrier)
    above = high + np.array([0.0, 0.0, HEADROOM_M])
    if carrier.label in TABLES:
        yield _Space(ON_TABLES, 10, _at_height(low, high[2]), above)
    if carrier.label in SEATS_M:
        inset = 0.2 * (high - low) * [1, 1, 0]
        yield _Space(ON_SEATS, 3, _at_height(low, SEATS_M[carrier.label]) + inset, above - inset)
    if carrier.label == "shelf":
        inset = np.array([0.04, 0.04, 0.0])
        for level_m in BOARDS_M[high[2] > 1]:
            top = _at_height(high, level_m + 0.32) - inset
            yield _Space(IN_SHELVES, 2, _at_height(low, level_m) + inset, top)
        yield _Space(ON_SHELVES, 2, _at_height(low, high[2]), above)


def _at_height(corner: np.ndarray, z_m: float) -> np.ndarray:
    return np.array([corner[0], corner[1], z_m])


def extent(thing: SceneObject) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and the high corner [3] of an object's axis-aligned bounding box, meters."""
    center, size = thing.bounds_m
    return center - size / 2, center + size / 2
