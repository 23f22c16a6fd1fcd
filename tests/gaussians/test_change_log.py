"""A follower that applies what the log says holds the same map."""

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


class Follower:
    """Ids and rows, by id."""

    def __init__(self) -> None:
        self.rows: dict[int, bytes] = {}

    def take(self, changes: Changes, gaussians: GaussianMap) -> None:
        for gone in changes.removed:
            del self.rows[int(gone)]
        for row in changes.changed:
            assert int(gaussians.ids[row]) in self.rows, "changed before it was added"
            self.rows[int(gaussians.ids[row])] = gaussians.rows[row].tobytes()
        for row in changes.added:
            assert int(gaussians.ids[row]) not in self.rows, "added twice"
            self.rows[int(gaussians.ids[row])] = gaussians.rows[row].tobytes()


def truth(gaussians: GaussianMap) -> dict[int, bytes]:
    return {int(i): row.tobytes() for i, row in zip(gaussians.ids, gaussians.rows, strict=True)}


STEPS = st.lists(
    st.tuples(
        st.sampled_from(["add", "write", "remove", "tell", "tell all", "sleep", "wake"]),
        st.integers(0, 2**30),
    ),
    max_size=30,
)


@settings(deadline=None, max_examples=150)
@given(STEPS)
def test_a_follower_ends_with_the_same_rows_whatever_happens(steps: list[tuple[str, int]]) -> None:
    gaussians, log, follower = GaussianMap(), ChangeLog(), Follower()
    asleep: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for what, seed in steps:
        rng = np.random.default_rng(seed)
        mask = rng.random(len(gaussians)) < 0.3
        match what:
            case "add":
                gaussians.add(rows(int(rng.integers(1, 5)), float(seed)), 0)
                log.mark_added(gaussians)
            case "write":
                gaussians.rows[mask] += 1
                log.changed(mask)
            case "remove":
                log.mark_removed(gaussians, mask)
                gaussians.remove(mask)
            case "tell":
                follower.take(log.drain(gaussians, with_changed=False), gaussians)
            case "tell all":
                follower.take(log.drain(gaussians, with_changed=True), gaussians)
                assert {i: r for i, r in follower.rows.items() if i in truth(gaussians)} == truth(
                    gaussians
                )
            case "sleep":
                follower.take(log.drain(gaussians, with_changed=True), gaussians)
                asleep.append(gaussians.extract(mask))
                log.mark_all_published(gaussians)
            case "wake" if asleep:
                woken = asleep.pop()
                gaussians.reinsert(*woken)
                log.mark_loaded(gaussians, woken.ids)
    while asleep:
        woken = asleep.pop()
        gaussians.reinsert(*woken)
        log.mark_loaded(gaussians, woken.ids)
    follower.take(log.drain(gaussians, with_changed=True), gaussians)
    assert follower.rows == truth(gaussians)


def test_what_came_and_went_untold_is_never_told() -> None:
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
def test_nothing_is_told_twice(with_changed: bool) -> None:
    gaussians, log = GaussianMap(), ChangeLog()
    gaussians.add(rows(3), 0)
    log.mark_added(gaussians)
    log.drain(gaussians, with_changed=with_changed)
    again = log.drain(gaussians, with_changed=with_changed)
    assert len(again.removed) == len(again.changed) == len(again.added) == 0
