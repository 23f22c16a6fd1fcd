"""Tests of the labels that a delayed copy keeps apart from the map."""

import numpy as np
import pytest

from ldo_service.gaussians.model import GaussianMap
from ldo_service.semantics.delayed_copy import GaussianLabels


def map_of(ids: list[int]) -> GaussianMap:
    """Return a map of Gaussians with given ids, whose label rows contain their ids."""
    gaussians = GaussianMap()
    gaussians.add(np.zeros((max(ids) + 1, 16), np.float32), 0)
    gaussians.remove(~np.isin(gaussians.ids, ids))
    gaussians.labels[:] = gaussians.ids[:, None]
    return gaussians


@pytest.mark.parametrize("later", [[0, 1, 2, 3], [0, 1, 2, 3, 4, 5], [1, 3], [1, 3, 4]])
def test_copy_keeps_its_own_labels_of_all_gaussians(later: list[int]) -> None:
    copy = GaussianLabels.of(map_of([0, 1, 2, 3]))
    expected = {0: 0, 1: 1, 2: 2, 3: 3}
    gaussians = map_of(later)
    gaussians.labels[:] = 100
    for step in (10, 20):
        with copy.in_map(gaussians):
            shown = {
                int(g): int(row[0]) for g, row in zip(gaussians.ids, gaussians.labels, strict=True)
            }
            assert shown == {g: expected.get(g, 0) for g in later}
            gaussians.labels[:] += step
        assert np.all(gaussians.labels == 100), "the map has its own labels again"
        expected |= {g: expected.get(g, 0) + step for g in later}
        ids, labels = copy.all()
        assert dict(zip(ids.tolist(), labels[:, 0].tolist(), strict=True)) == expected
        assert ids.tolist() == sorted(expected)
        assert copy.ids.tolist() == later, "the next block needs no search"
    saved = copy.labels
    before = saved.copy()
    with copy.in_map(gaussians):
        gaussians.labels[:] += 5
    assert np.array_equal(saved, before), "a saved state keeps its labels"
    expected |= {g: expected[g] + 5 for g in later}
    changed = copy.write(gaussians)
    assert changed.tolist() == list(range(len(later)))
    assert gaussians.labels[:, 0].tolist() == [expected[g] for g in later]
