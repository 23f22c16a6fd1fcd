"""Rooms for training: placement of objects, and camera poses."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

SEEDS = range(400, 404)


@pytest.fixture(scope="module")
def rooms() -> Iterator[SimpleNamespace]:
    sys.path.insert(0, str(Path(__file__).parents[2] / "training"))
    import furnishing
    import layout
    import views

    flats = [layout.room(seed) for seed in SEEDS]
    yield SimpleNamespace(furnishing=furnishing, layout=layout, views=views, flats=flats)
    sys.path.pop(0)
    for name in ("furnishing", "inventory", "layout", "views"):
        sys.modules.pop(name, None)


Extent = tuple[np.ndarray, np.ndarray]  # Low and high corner, m.


def overlap(a: Extent, b: Extent, gap_m: float) -> bool:
    return bool((a[0] < b[1] - gap_m).all() and (a[1] > b[0] + gap_m).all())


def test_objects_overlap_only_their_support_or_a_table_above(
    rooms: SimpleNamespace,
) -> None:
    under = 0
    for flat in rooms.flats:
        placed = [(thing.label, rooms.furnishing.extent(thing)) for thing in flat.things]
        for k, (label, extent) in enumerate(placed):
            # The gap is required of the later object, which may lie within its support.
            met = [
                other for other, its in placed[:k] if overlap(extent, its, rooms.furnishing.GAP_M)
            ]
            assert len(met) <= 1, (label, met)
            under += (label, met) == ("chair", ["dining table"])
    assert under >= len(rooms.flats) / 2


def test_room_of_a_seed_is_reproducible(rooms: SimpleNamespace) -> None:
    again = rooms.layout.room(SEEDS[0])
    assert again.things == rooms.flats[0].things


def test_objects_in_view_and_near_are_counted(rooms: SimpleNamespace) -> None:
    views = rooms.views
    edge = 0.5 / views.FOCAL_PER_WIDTH  # Limit of x / z at the border of the image.
    before = [(0, 0, 1), (0.98 * edge, 0, 1), (0, 0.7 * edge, 1), (0, 0, 0.99 * views.NEAR_M)]
    beside = [(1.02 * edge, 0, 1), (0, 0.8 * edge, 1), (0, 0, -1), (0, 0, 1.01 * views.NEAR_M)]
    T = np.eye(4)
    # The camera looks along x of the world.
    T[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T[:3, 3] = 3, -2, 1.5
    in_world = [T[:3, :3] @ p + T[:3, 3] for p in np.array([*before, *beside], float)]
    assert views._things_before(T, np.array(in_world)) == len(before)


def test_pose_with_most_objects_in_view_is_chosen(
    rooms: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, flat = rooms.views, rooms.flats[0]
    centers_m = np.array([thing.bounds_m[0] for thing in flat.things])
    counts = []
    for glances in (1, 4):
        monkeypatch.setattr(views, "GLANCES", glances)
        poses = views._poses(flat, 20, np.random.default_rng(0))
        counts.append(np.mean([views._things_before(T, centers_m) for T in poses]))
    assert counts[1] > counts[0]
