"""Synthetic corridor with weak texture that is walked to its end and back."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.storage.cache_folder import cache_root
from ldo_service.synthetic import FlatSequence
from ldo_service.synthetic.flat.corridor import (
    EQUAL,
    OBJECTS,
    PITCH_M,
    SECTIONS,
    furnished_corridor,
    section_x_m,
)
from ldo_service.synthetic.flat.scene import Flat

from .walks import require_hand_held_walk


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the cache folder of this module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LDO_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield cache_root()


@pytest.fixture(scope="module")
def exact() -> FlatSequence:
    return FlatSequence.named("corridor-exact", width_px=32, height_px=24)


@pytest.fixture(scope="module")
def corridor() -> Flat:
    return furnished_corridor(0)


def test_corridor_opens_by_name_at_320x240() -> None:
    corridor = open_sequence("synthetic:corridor@2")
    assert (corridor.name, corridor.camera.width) == ("synthetic:corridor@2", 320)


def test_sections_are_equal_except_for_their_objects(corridor: Flat) -> None:
    def solids(number: int) -> set[tuple]:
        things = [
            t for t, room in zip(corridor.things, corridor.rooms, strict=True) if room == number
        ]
        assert [t.label for t in things[len(EQUAL) :]] == [row[0] for row in OBJECTS[number]]
        return {
            (round(s.center_m[0] - section_x_m(number), 9), *s.center_m[1:], s.size_m, s.texture)
            for thing in things[: len(EQUAL)]
            for s in thing.solids
        }

    assert all(solids(number) == solids(0) for number in range(SECTIONS))
    assert len({tuple(row[0] for row in rows) for rows in OBJECTS}) == SECTIONS


def test_walk_reaches_both_ends_and_sees_each_section_from_two_sides(exact: FlatSequence) -> None:
    T = exact.truth().T_world_camera
    end_m = (SECTIONS - 1) / 2 * PITCH_M
    assert T[:, 0, 3].min() < -end_m + 0.5
    assert T[:, 0, 3].max() > end_m - 0.5
    for number in range(1, SECTIONS - 1):
        near = np.abs(T[:, 0, 3] - section_x_m(number)) < PITCH_M / 2
        gaze_x = T[near, 0, 2]
        assert gaze_x.max() > 0.5
        assert gaze_x.min() < -0.5


def test_walk_is_hand_held_and_keeps_its_distance(exact: FlatSequence, corridor: Flat) -> None:
    require_hand_held_walk(exact.truth(), corridor)
