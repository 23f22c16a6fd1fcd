"""Boxes and pairs against brute force."""

import doctest
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ldo_service.semantics import data_association
from ldo_service.semantics.data_association import (
    AssociationConfig,
    associate,
    compute_region_statistics,
    find_containing_regions,
    merge_parts,
)
from ldo_service.semantics.gaussian_labels import distribution
from ldo_service.semantics.object_landmarks import MEMBERS, shuffled

from .scenes import THINGS, Stage, poses, shoot

tenths = st.integers(0, 10).map(lambda i: i / 10)


def test_the_examples_hold() -> None:
    assert doctest.testmod(data_association).failed == 0


def best_sum(gain: np.ndarray) -> float:
    """Of all ways to pair rows with columns."""
    if gain.shape[0] > gain.shape[1]:
        gain = gain.T
    rows = np.arange(len(gain))
    return max(gain[rows, list(way)].sum() for way in permutations(range(gain.shape[1]), len(gain)))


@given(
    st.tuples(st.integers(1, 4), st.integers(1, 4)).flatmap(
        lambda shape: st.tuples(
            arrays(float, shape, elements=tenths), arrays(bool, shape, elements=st.booleans())
        )
    )
)
def test_pairs_are_allowed_and_have_the_largest_sum(case: tuple[np.ndarray, np.ndarray]) -> None:
    iou, allowed = case
    k, r = associate(iou, allowed, 0.4)
    assert np.all(allowed[k, r] & (iou[k, r] >= 0.4))
    assert len(set(k.tolist())) == len(set(r.tolist())) == len(k)
    assert abs(iou[k, r].sum() - best_sum(np.where(allowed & (iou >= 0.4), iou, 0))) < 1e-12


def test_ties_go_to_the_first() -> None:
    k, r = associate(np.full((3, 2), 0.8), np.ones((3, 2), bool), 0.4)
    assert list(zip(k, r, strict=True)) == [(0, 0), (1, 1)]


def test_of_nothing_nothing_is_paired() -> None:
    for shape in ((0, 3), (3, 0), (0, 0)):
        k, r = associate(np.zeros(shape), np.zeros(shape, bool), 0.4)
        assert len(k) == len(r) == 0


def test_regions_are_samples_of_their_gaussians() -> None:
    """Against a plain loop over the regions, with one so large that a share of it is sorted."""
    stage = Stage()
    shot = shoot(THINGS, poses(1)[0])
    view, _ = stage.show(shot, shot.claims(THINGS))
    rng = np.random.default_rng(1)
    regions = rng.choice([-1, 0, 1, 2], len(view.regions), p=[0.2, 0.7, 0.094, 0.006])
    boxes, classes = np.zeros((3, 4)), np.zeros((3, 2), int)
    view = replace(view, regions=regions.astype(np.int32), boxes=boxes, classes=classes)
    assert np.count_nonzero(regions == 0) > 3 * MEMBERS
    got = compute_region_statistics(
        view, np.linalg.inv(view.T_map_camera), AssociationConfig(min_gaussians=30)
    )
    counts = np.bincount(regions[regions >= 0], minlength=3)
    assert got.numbers.tolist() == np.flatnonzero(counts >= 30).tolist()
    for number, members, p in zip(got.numbers, got.members, got.distributions, strict=True):
        rows = view.indices[regions == number]
        rows = rows[np.argsort(shuffled(view.ids[rows]))][:MEMBERS]
        np.testing.assert_array_equal(members[members >= 0], view.ids[rows])
        weights = 1 / (1 + np.exp(-view.rows[rows, 10].astype(float)))
        expected = np.average(distribution(view.labels[rows]), axis=0, weights=weights)
        np.testing.assert_allclose(p, expected, atol=1e-5)


PLANT, TABLE = 60, 62
WHOLE = (0, 0, 100, 200)  # px


Seen = tuple[tuple[int, int, int, int], float, float]


def wholes(regions: list[Seen], classes: list[tuple[int, int]]) -> list[int]:
    """Of regions with their boxes, near and far ends."""
    boxes, near_m, far_m = (np.array(values, float) for values in zip(*regions, strict=True))
    return find_containing_regions(
        boxes, np.array(classes), near_m, far_m, AssociationConfig()
    ).tolist()


@pytest.mark.parametrize(
    ("other", "near_m", "name", "is_part"),
    [
        ((10, 0, 90, 100), 2.0, PLANT, True),
        ((-5, 0, 95, 100), 2.0, PLANT, True),  # 95 % of it
        ((-15, 0, 85, 100), 2.0, PLANT, False),  # 85 %: two that overlap
        ((10, 0, 90, 100), 2.0, TABLE, False),
        ((10, 0, 90, 100), 2.5, PLANT, False),  # one behind the other
        ((10, 0, 90, 100), 2.35, PLANT, True),  # within what depth cannot tell
        (WHOLE, 2.0, PLANT, False),  # neither is the larger
        ((300, 300, 300, 310), 2.0, PLANT, False),  # of no size, and elsewhere
    ],
)
def test_a_part_lies_in_a_larger_box_of_its_class_at_its_depth(
    other: tuple[int, int, int, int], near_m: float, name: int, is_part: bool
) -> None:
    regions: list[Seen] = [(other, near_m, near_m + 0.2), (WHOLE, 2.0, 2.3)]
    assert wholes(regions, [(name, -1), (PLANT, -1)]) == [1 if is_part else 0, 1]


def test_a_part_of_a_part_is_one_of_the_whole() -> None:
    crown, top, beside = (0, 0, 100, 100), (20, 0, 80, 50), (90, 0, 300, 200)
    regions: list[Seen] = [(top, 2, 2.2), (crown, 2, 2.2), (WHOLE, 2, 2.2), (beside, 2, 2.2)]
    assert wholes(regions, [(PLANT, -1)] * 4) == [2, 2, 2, 3]
    # a top that lies at the depth of the crown alone is one of the whole too
    behind: list[Seen] = [(top, 2.5, 2.6), (crown, 2.1, 2.45), (WHOLE, 2.0, 2.2)]
    assert wholes(behind, [(PLANT, -1)] * 3) == [2, 2, 2]


def test_a_class_is_shared_whoever_says_it_of_either() -> None:
    regions: list[Seen] = [((10, 0, 90, 100), 2, 2.2), (WHOLE, 2, 2.2)]
    for part, whole, is_part in (
        ((PLANT, -1), (PLANT, TABLE), True),  # the labeller has spoken of the whole alone
        ((-1, TABLE), (PLANT, TABLE), True),
        ((PLANT, -1), (-1, PLANT), True),  # what the detector boxed, in what was asked about
        ((PLANT, -1), (-1, TABLE), False),
        ((-1, -1), (-1, -1), False),
    ):
        assert wholes(regions, [part, whole]) == [1 if is_part else 0, 1]


def test_parts_that_took_all_of_the_whole_are_one() -> None:
    crown, pot = (0, 0, 100, 120), (20, 120, 80, 200)
    nothing = (np.inf, -np.inf)
    regions: list[Seen] = [(crown, 2.0, 2.4), (pot, 2.1, 2.3), (WHOLE, *nothing)]
    assert wholes(regions, [(PLANT, -1)] * 3) == [2, 2, 2]
    apart: list[Seen] = [(crown, 2.0, 2.4), (pot, 2.9, 3.3), (WHOLE, *nothing)]
    assert wholes(apart, [(PLANT, -1)] * 3) == [2, 1, 2]


def test_gaussians_of_parts_are_those_of_the_whole() -> None:
    stage = Stage()
    shot = shoot(THINGS, poses(1)[0])
    view, _ = stage.show(shot, shot.claims(THINGS))
    boxes = np.array([[0, 0, 20, 20], [30, 30, 60, 60], [0, 0, 20, 40]], float)
    regions = np.random.default_rng(1).integers(-2, 3, len(view.regions)).astype(np.int32)
    view = replace(view, regions=regions, boxes=boxes, classes=np.full((3, 2), PLANT))
    config = AssociationConfig()
    whole = merge_parts(
        view, compute_region_statistics(view, np.linalg.inv(view.T_map_camera), config), config
    )
    np.testing.assert_array_equal(whole.regions, np.where(regions == 0, 2, regions))
    # nobody's part, nothing new
    apart = replace(view, classes=np.array([[PLANT, -1], [PLANT, -1], [TABLE, -1]]))
    regions_apart = compute_region_statistics(apart, np.linalg.inv(view.T_map_camera), config)
    assert merge_parts(apart, regions_apart, config) is apart
