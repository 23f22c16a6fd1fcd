"""Records are found by id, whatever the order they came in."""

import numpy as np
import pytest

from ldo_service.geometry.point_records import MIN_ROOM, PoseTable, RecordTable

NUMBER = np.dtype([("id", np.int64), ("value", float)])


def records(ids: list[int]) -> RecordTable:
    made = RecordTable(NUMBER)
    for id_ in ids:
        made.put(id_, id_ / 2)
    return made


def test_records_are_what_a_dict_would_hold() -> None:
    rng = np.random.default_rng(0)
    ids = rng.integers(0, 1000, size=20 * MIN_ROOM).tolist()
    made, twin = records(ids), {id_: id_ / 2 for id_ in ids}
    made.put(ids[0], -1.0)
    twin[ids[0]] = -1.0
    assert dict(made.all.tolist()) == twin
    assert made.ids.tolist() == sorted(twin)
    assert [id_ in made for id_ in range(1000)] == [id_ in twin for id_ in range(1000)]


def test_only_known_ids_have_a_row() -> None:
    made = records([5, 3, 9])
    assert made.ids[made.rows([9, 4, 3, 10, 3])].tolist() == [9, 3, 3]
    assert made.are_known([9, 4, 3, 10, 3]).tolist() == [True, False, True, False, True]
    assert RecordTable(NUMBER).are_known([0]).tolist() == [False]


def test_what_is_not_kept_is_forgotten_and_can_come_again() -> None:
    made = records([5, 3, 9])
    made.keep_only([9, 3, 7])
    made.put(5, 0.0)
    assert made.all.tolist() == [(3, 1.5), (5, 0.0), (9, 4.5)]


def test_poses_are_what_a_dict_would_hold() -> None:
    rng = np.random.default_rng(1)
    table, twin = PoseTable(), dict[int, np.ndarray]()
    for id_ in rng.integers(0, 300, size=500).tolist():
        if id_ in twin and id_ % 3:
            del table[id_], twin[id_]
        else:
            table[id_] = twin[id_] = rng.normal(size=(4, 4))
    assert list(table) == sorted(twin)
    np.testing.assert_array_equal(table.of(twin), list(twin.values()))
    copy = PoseTable()
    copy.become(table, table.of(table))
    assert all(copy[id_].tobytes() == twin[id_].tobytes() for id_ in table)
    with pytest.raises(KeyError):
        del table[1000]
    with pytest.raises(KeyError):
        table[1000]


def test_a_fifth_of_the_room_is_empty_at_most() -> None:
    made = records(list(range(10_000)))
    assert made._room.nbytes <= 1.25 * made.all.nbytes
