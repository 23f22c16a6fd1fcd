"""A bounded replica of the map against the exact one."""

import numpy as np
import pytest

from ldo_service.gaussians.pruning import weightiest
from ldo_service.maps.replica import SLACK, MapReplica

from .streams import ChangingMap

PLENTY = 1_000_000


@pytest.mark.parametrize("seed", range(3))
def test_with_room_for_all_it_is_the_followers_map(seed: int) -> None:
    changing, known, follower = ChangingMap(seed), MapReplica(PLENTY), MapReplica()
    for step in range(20):
        messages = [changing.delta(), *(changing.snapshot() if step % 6 == 5 else ())]
        for message in messages:
            assert known.apply(message) == follower.apply(message)
        np.testing.assert_array_equal(known.map.rows, follower.map.rows)
        assert not known.is_behind


def test_who_comes_late_has_it_from_the_snapshot() -> None:
    changing = ChangingMap()
    for _ in range(10):
        changing.delta()
    known, snapshot = MapReplica(PLENTY), changing.snapshot()
    for message in (*snapshot, changing.delta(), changing.delta()):
        assert known.apply(message)
    np.testing.assert_array_equal(known.map.rows, changing.map.rows)


@pytest.mark.parametrize("parts", [1, 4])
def test_what_was_missed_is_wrong_until_the_next_snapshot(parts: int) -> None:
    changing, known = ChangingMap(), MapReplica(PLENTY)
    for _ in range(4):
        known.apply(changing.delta())
    for _ in range(3):
        changing.delta()  # lost
    assert known.apply(changing.delta())
    assert known.is_behind
    assert len(known.map.rows)  # goes on
    for message in changing.snapshot(parts):
        known.apply(message)
    assert not known.is_behind
    np.testing.assert_array_equal(known.map.rows, changing.map.rows)


def test_an_old_message_changes_nothing() -> None:
    changing, known = ChangingMap(), MapReplica(PLENTY)
    first, early = changing.delta(), changing.snapshot()
    second = changing.delta()
    late = changing.snapshot()
    for message in (first, second):
        known.apply(message)
    before = known.map.rows.copy()
    assert not any(known.apply(message) for message in (second, *early, *late))
    np.testing.assert_array_equal(known.map.rows, before)


def test_a_mapper_that_begins_anew_is_followed() -> None:
    known = MapReplica(PLENTY)
    before, anew = ChangingMap(1), ChangingMap(2)
    for changing in (before, before, before, anew, anew):
        assert known.apply(changing.delta())
    np.testing.assert_array_equal(known.map.rows, anew.map.rows)


def test_it_holds_the_weightiest_and_no_more_than_there_is_room_for() -> None:
    changing, known, most = ChangingMap(), MapReplica(100), 100
    for step in range(40):
        for message in [changing.delta(), *(changing.snapshot() if step % 10 == 9 else ())]:
            known.apply(message)
            assert len(known.map.rows) <= SLACK * most
    truth = changing.map.rows  # of which there was a snapshot just now
    best = truth[weightiest(truth, most)]
    assert {row.tobytes() for row in best} <= {row.tobytes() for row in known.map.rows}


def test_an_empty_map_is_told_of_too() -> None:
    known = MapReplica(PLENTY)
    known.apply(ChangingMap().delta())
    known.is_behind = True
    empty = ChangingMap()
    empty.version = 5
    for message in empty.snapshot(parts=1):
        known.apply(message)
    assert len(known.map.rows) == 0
