"""Change log: a replica that applies its changes equals the map."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldo_service.gaussians import GaussianMap
from ldo_service.gaussians.change_log import ChangeLog, Changes


def rows(count: int, value: float = 0.0) -> np.ndarray:
    out = np.full((count, 16), value, np.float32)
    out[:, 6] = 1
    return out


class Replica:
    """Replica of the rows, by id."""

    def __init__(self) -> None:
        self.rows: dict[int, bytes] = {}

    def apply(self, changes: Changes, gaussians: GaussianMap) -> None:
        for removed_id in changes.removed:
            del self.rows[int(removed_id)]
        for row in changes.changed:
            assert int(gaussians.ids[row]) in self.rows, "changed before it was added"
            self.rows[int(gaussians.ids[row])] = gaussians.rows[row].tobytes()
        for row in changes.added:
            assert int(gaussians.ids[row]) not in self.rows, "added twice"
            self.rows[int(gaussians.ids[row])] = gaussians.rows[row].tobytes()


def expected_rows(gaussians: GaussianMap) -> dict[int, bytes]:
    return {int(i): row.tobytes() for i, row in zip(gaussians.ids, gaussians.rows, strict=True)}


STEPS = st.lists(
    st.tuples(
        st.sampled_from(["add", "write", "remove", "drain", "drain all", "offload", "load"]),
        st.integers(0, 2**30),
    ),
    max_size=30,
)


@settings(deadline=None, max_examples=150)
@given(STEPS)
def test_replica_equals_map_after_any_sequence_of_changes(steps: list[tuple[str, int]]) -> None:
    gaussians, log, replica = GaussianMap(), ChangeLog(), Replica()
    offloaded: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for action, seed in steps:
        rng = np.random.default_rng(seed)
        mask = rng.random(len(gaussians)) < 0.3
        match action:
            case "add":
                gaussians.add(rows(int(rng.integers(1, 5)), float(seed)), 0)
                log.mark_added(gaussians)
            case "write":
                gaussians.rows[mask] += 1
                log.changed(mask)
            case "remove":
                log.mark_removed(gaussians, mask)
                gaussians.remove(mask)
            case "drain":
                replica.apply(log.drain(gaussians, with_changed=False), gaussians)
            case "drain all":
                replica.apply(log.drain(gaussians, with_changed=True), gaussians)
                assert {
                    i: r for i, r in replica.rows.items() if i in expected_rows(gaussians)
                } == expected_rows(gaussians)
            case "offload":
                replica.apply(log.drain(gaussians, with_changed=True), gaussians)
                offloaded.append(gaussians.extract(mask))
                log.mark_all_published(gaussians)
            case "load" if offloaded:
                loaded = offloaded.pop()
                gaussians.reinsert(*loaded)
                log.mark_loaded(gaussians, loaded.ids)
    while offloaded:
        loaded = offloaded.pop()
        gaussians.reinsert(*loaded)
        log.mark_loaded(gaussians, loaded.ids)
    replica.apply(log.drain(gaussians, with_changed=True), gaussians)
    assert replica.rows == expected_rows(gaussians)


def test_gaussian_removed_before_drain_is_not_published() -> None:
    gaussians, log = GaussianMap(), ChangeLog()
    gaussians.add(rows(3), 0)
    log.mark_added(gaussians)
    mask = np.array([False, True, False])
    log.mark_removed(gaussians, mask)
    gaussians.remove(mask)
    changes = log.drain(gaussians, with_changed=True)
    assert changes.removed.tolist() == []
    assert gaussians.ids[changes.added].tolist() == [0, 2]


@pytest.mark.parametrize("with_changed", [True, False])
def test_changes_are_drained_once(with_changed: bool) -> None:
    gaussians, log = GaussianMap(), ChangeLog()
    gaussians.add(rows(3), 0)
    log.mark_added(gaussians)
    log.drain(gaussians, with_changed=with_changed)
    repeated = log.drain(gaussians, with_changed=with_changed)
    assert len(repeated.removed) == len(repeated.changed) == len(repeated.added) == 0
