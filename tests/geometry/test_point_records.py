"""Tables of records and poses by id, in any order of insertion."""

import numpy as np
import pytest

from ldo_service.geometry.point_records import MIN_ROOM, PoseTable, RecordTable

NUMBER = np.dtype([("id", np.int64), ("value", float)])


def records(ids: list[int]) -> RecordTable:
    table = RecordTable(NUMBER)
    for id_ in ids:
        table.put(id_, id_ / 2)
    return table


def test_records_equal_those_of_a_dict() -> None:
    rng = np.random.default_rng(0)
    ids = rng.integers(0, 1000, size=20 * MIN_ROOM).tolist()
    table, expected = records(ids), {id_: id_ / 2 for id_ in ids}
    table.put(ids[0], -1.0)
    expected[ids[0]] = -1.0
    assert dict(table.all.tolist()) == expected
    assert table.ids.tolist() == sorted(expected)
    assert [id_ in table for id_ in range(1000)] == [id_ in expected for id_ in range(1000)]


def test_only_known_ids_have_a_row() -> None:
    table = records([5, 3, 9])
    assert table.ids[table.rows([9, 4, 3, 10, 3])].tolist() == [9, 3, 3]
    assert table.are_known([9, 4, 3, 10, 3]).tolist() == [True, False, True, False, True]
    assert RecordTable(NUMBER).are_known([0]).tolist() == [False]


def test_removed_record_can_be_added_again() -> None:
    table = records([5, 3, 9])
    table.keep_only([9, 3, 7])
    table.put(5, 0.0)
    assert table.all.tolist() == [(3, 1.5), (5, 0.0), (9, 4.5)]


def test_poses_equal_those_of_a_dict() -> None:
    rng = np.random.default_rng(1)
    table, expected = PoseTable(), dict[int, np.ndarray]()
    for id_ in rng.integers(0, 300, size=500).tolist():
        if id_ in expected and id_ % 3:
            del table[id_], expected[id_]
        else:
            table[id_] = expected[id_] = rng.normal(size=(4, 4))
    assert list(table) == sorted(expected)
    np.testing.assert_array_equal(table.of(expected), list(expected.values()))
    copy = PoseTable()
    copy.become(table, table.of(table))
    assert all(copy[id_].tobytes() == expected[id_].tobytes() for id_ in table)
    with pytest.raises(KeyError):
        del table[1000]
    with pytest.raises(KeyError):
        table[1000]


def test_at_most_a_fifth_of_the_memory_is_empty() -> None:
    table = records(list(range(10_000)))
    assert table._room.nbytes <= 1.25 * table.all.nbytes
