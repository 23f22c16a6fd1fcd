"""Bounded map replica against the exact map."""

import numpy as np
import pytest

from ldo_service.gaussians.pruning import weightiest
from ldo_service.maps.replica import SLACK, MapReplica

from .streams import ChangingMap

UNLIMITED = 1_000_000


@pytest.mark.parametrize("seed", range(3))
def test_replica_below_its_limit_equals_unbounded_replica(seed: int) -> None:
    mapper, replica, unbounded = ChangingMap(seed), MapReplica(UNLIMITED), MapReplica()
    for step in range(20):
        messages = [mapper.delta(), *(mapper.snapshot() if step % 6 == 5 else ())]
        for message in messages:
            assert replica.apply(message) == unbounded.apply(message)
        np.testing.assert_array_equal(replica.map.rows, unbounded.map.rows)
        assert not replica.is_behind


def test_late_replica_is_complete_after_the_snapshot() -> None:
    mapper = ChangingMap()
    for _ in range(10):
        mapper.delta()
    replica, snapshot = MapReplica(UNLIMITED), mapper.snapshot()
    for message in (*snapshot, mapper.delta(), mapper.delta()):
        assert replica.apply(message)
    np.testing.assert_array_equal(replica.map.rows, mapper.map.rows)


@pytest.mark.parametrize("parts", [1, 4])
def test_replica_is_behind_after_lost_deltas_until_the_next_snapshot(parts: int) -> None:
    mapper, replica = ChangingMap(), MapReplica(UNLIMITED)
    for _ in range(4):
        replica.apply(mapper.delta())
    for _ in range(3):
        mapper.delta()  # Lost messages.
    assert replica.apply(mapper.delta())
    assert replica.is_behind
    assert len(replica.map.rows)  # The replica keeps its map.
    for message in mapper.snapshot(parts):
        replica.apply(message)
    assert not replica.is_behind
    np.testing.assert_array_equal(replica.map.rows, mapper.map.rows)


def test_old_messages_are_ignored() -> None:
    mapper, replica = ChangingMap(), MapReplica(UNLIMITED)
    first, early_snapshot = mapper.delta(), mapper.snapshot()
    second = mapper.delta()
    late_snapshot = mapper.snapshot()
    for message in (first, second):
        replica.apply(message)
    before = replica.map.rows.copy()
    assert not any(replica.apply(message) for message in (second, *early_snapshot, *late_snapshot))
    np.testing.assert_array_equal(replica.map.rows, before)


def test_replica_follows_a_restarted_mapper() -> None:
    replica = MapReplica(UNLIMITED)
    before, restarted = ChangingMap(1), ChangingMap(2)
    for mapper in (before, before, before, restarted, restarted):
        assert replica.apply(mapper.delta())
    np.testing.assert_array_equal(replica.map.rows, restarted.map.rows)


def test_replica_keeps_the_heaviest_gaussians_within_its_limit() -> None:
    mapper, replica, limit = ChangingMap(), MapReplica(100), 100
    for step in range(40):
        for message in [mapper.delta(), *(mapper.snapshot() if step % 10 == 9 else ())]:
            replica.apply(message)
            assert len(replica.map.rows) <= SLACK * limit
    expected_rows = mapper.map.rows  # The last message was a snapshot.
    heaviest = expected_rows[weightiest(expected_rows, limit)]
    assert {row.tobytes() for row in heaviest} <= {row.tobytes() for row in replica.map.rows}


def test_snapshot_of_an_empty_map_clears_the_replica() -> None:
    replica = MapReplica(UNLIMITED)
    replica.apply(ChangingMap().delta())
    replica.is_behind = True
    empty = ChangingMap()
    empty.version = 5
    for message in empty.snapshot(parts=1):
        replica.apply(message)
    assert len(replica.map.rows) == 0
