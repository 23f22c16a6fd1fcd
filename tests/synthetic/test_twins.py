"""Synthetic offices that look alike and differ in their objects."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.geometry import se3
from ldo_service.storage.cache_folder import cache_root
from ldo_service.synthetic import FlatSequence
from ldo_service.synthetic.flat import CLASS_NAMES, COCO_COUNT
from ldo_service.synthetic.flat.render import FlatRenderer
from ldo_service.synthetic.flat.scene import Flat
from ldo_service.synthetic.flat.twins import (
    OFFICE_OBJECTS,
    OFFICES,
    PITCH_M,
    SECTION_OBJECTS,
    furnished_twins,
    section_x_m,
)
from ldo_service.synthetic.flat.twins_walk import STATIONS

from .walks import require_hand_held_walk

SMALL = {"width_px": 80, "height_px": 60}
# View from the doorway of office 0 into the office.
DOORWAY = np.array(
    [[1, 0, 0, section_x_m(0)], [0, 0, 1, 0.5], [0, -1, 0, 1.45], [0, 0, 0, 1.0]], float
)


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the cache folder of this module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LDO_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield cache_root()


@pytest.fixture(scope="module")
def exact() -> FlatSequence:
    return FlatSequence.named("twins-exact", **SMALL)


@pytest.fixture(scope="module")
def twins() -> Flat:
    return furnished_twins(0)


def moved(solid, office: int) -> tuple:
    """Return shape, place, size and texture of a solid relative to its office."""
    x, y, z = solid.center_m
    place = np.round((x - section_x_m(office), y, z), 9)
    return solid.shape, *place.tolist(), solid.size_m, solid.texture, solid.heading


def shared_solids(twins: Flat, room: int) -> set[tuple]:
    """Return the solids of a room that belong to objects that every such room has."""
    own = Counter(row[0] for row in (*OFFICE_OBJECTS, *SECTION_OBJECTS)[room])
    office = room % OFFICES
    things = [t for t, its_room in zip(twins.things, twins.rooms, strict=True) if its_room == room]
    shared = things[: len(things) - own.total()]
    assert Counter(thing.label for thing in things[len(shared) :]) == own
    return {moved(solid, office) for thing in shared for solid in thing.solids}


def test_twins_open_by_name_at_320x240() -> None:
    twins = open_sequence("synthetic:twins@2")
    assert (twins.name, twins.camera.width, twins.camera.height) == ("synthetic:twins@2", 320, 240)
    assert open_sequence("synthetic:twins-exact").name == "synthetic:twins-exact"


def test_rooms_share_building_furniture_and_textures(twins: Flat) -> None:
    for first in (0, OFFICES):
        expected = shared_solids(twins, first)
        assert len(expected) > 10
        for number in range(1, OFFICES):
            assert shared_solids(twins, first + number) == expected
    panels = [
        {(moved(p.solid, p.room % OFFICES), p.face) for p in twins.panels if p.room == office}
        for office in range(OFFICES)
    ]
    assert all(found == panels[0] for found in panels)


def test_rooms_differ_in_their_objects() -> None:
    for rows in (OFFICE_OBJECTS, SECTION_OBJECTS):
        names = [tuple(sorted((row[0], row[2]) for row in own)) for own in rows]
        assert len(set(names)) == OFFICES
    labels = [{row[0] for row in own} for own in OFFICE_OBJECTS]
    for a in range(OFFICES):
        for b in range(a):
            assert len(labels[a] ^ labels[b]) >= 5
    coco = set(CLASS_NAMES[:COCO_COUNT])
    assert all(own & coco and own - coco for own in labels)


def test_offices_look_alike_except_for_their_objects(exact: FlatSequence, twins: Flat) -> None:
    """The views into two offices are equal, except for the objects that differ."""
    keep = []
    for room in range(2 * OFFICES):
        own = len((*OFFICE_OBJECTS, *SECTION_OBJECTS)[room])
        at = [i for i, its_room in enumerate(twins.rooms) if its_room == room]
        keep += at[: len(at) - own]
    bare = replace(
        twins,
        things=tuple(twins.things[i] for i in keep),
        rooms=tuple(twins.rooms[i] for i in keep),
    )
    renderer = FlatRenderer(bare)
    other = DOORWAY.copy()
    other[0, 3] += 2 * PITCH_M
    views = [renderer.render(exact.raw_camera, T) for T in (DOORWAY, other)]
    # Rounding may decide at the edge of a texture cell or of a surface.
    light, depth_m = ([getattr(v, name) for v in views] for name in ("light", "depth_m"))
    assert np.mean(np.abs(light[0] - light[1]) < 1e-6) > 0.999
    assert np.mean(np.abs(depth_m[0] - depth_m[1]) < 1e-9) > 0.999
    furnished = [exact._renderer.render(exact.raw_camera, T) for T in (DOORWAY, other)]
    depth_m = [view.depth_m for view in furnished]
    alike = np.abs(depth_m[0] - depth_m[1]) < 0.1
    assert 0.8 < alike.mean() < 0.99
    names = [set(np.unique(view.class_ids)) for view in furnished]
    assert len(names[0] ^ names[1]) >= 3


def test_walk_returns_to_offices_after_it_has_seen_their_twins(exact: FlatSequence) -> None:
    visits = [office for office, _, visited in STATIONS if visited]
    assert visits == [0, 2, 1, 3, 2, 1, 0]
    T = exact.truth().T_world_camera
    inside = T[:, 1, 3] > 1.0
    entered = np.flatnonzero(inside[1:] & ~inside[:-1])
    offices = np.rint(T[entered, 0, 3] / PITCH_M + (OFFICES - 1) / 2).astype(int)
    # The closed path begins inside the doorway of office 0.
    assert offices.tolist() == visits
    assert np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3]) < 0.3


def test_walk_is_hand_held_and_keeps_its_distance(exact: FlatSequence, twins: Flat) -> None:
    require_hand_held_walk(exact.truth(), twins)


@pytest.mark.slow
def test_walk_sees_each_own_object_in_at_least_four_of_90_frames(twins: Flat) -> None:
    """An object that fills less than 200 of 320x240 pixels does not count as seen."""
    tiny = FlatSequence.named("twins-exact", width_px=32, height_px=24)
    frames = np.zeros(len(twins.things) + 1, int)
    for T in tiny.truth().T_world_camera[::8]:
        view = tiny._renderer.render(tiny.raw_camera, T)
        shown, pixels = np.unique(view.instance_ids, return_counts=True)
        frames[shown[pixels >= 2]] += 1
    for room, own in enumerate((*OFFICE_OBJECTS, *SECTION_OBJECTS)):
        at = [i for i, its_room in enumerate(twins.rooms) if its_room == room][-len(own) :]
        assert min(frames[i + 1] for i in at) >= 4, [(twins.things[i], frames[i + 1]) for i in at]


def test_another_seed_changes_textures_and_camera_shake(exact: FlatSequence, twins: Flat) -> None:
    other = FlatSequence.named("twins-exact", seed=1, **SMALL)
    assert not np.array_equal(other.truth().T_world_camera, exact.truth().T_world_camera)
    ours, theirs = (
        [s.texture for thing in things for s in thing.solids]
        for things in (twins.things, other.things)
    )
    assert np.mean([a != b for a, b in zip(ours, theirs, strict=True)]) > 0.5


def test_labels_and_depth_agree_with_the_building(exact: FlatSequence) -> None:
    raw, labels = exact.read(40), exact.labels(40)
    points = se3.transform(
        exact.truth().T_world_camera[40],
        exact.camera.rays() * raw.depth[..., None].astype(float),
    )
    floor = labels.class_ids == CLASS_NAMES.index("floor")
    assert floor.any()
    np.testing.assert_allclose(points[floor][:, 2], 0, atol=1e-5)
    for instance in np.unique(labels.instance_ids)[1:]:
        center_m, size_m = exact.things[instance - 1].bounds_m
        seen = points[labels.instance_ids == instance]
        assert (np.abs(seen - center_m) <= size_m / 2 + 1e-5).all()
