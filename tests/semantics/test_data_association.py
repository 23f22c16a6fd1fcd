"""Data association and region statistics against brute force."""

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

from .scenes import SCENE_OBJECTS, LabelledMap, poses, shoot

tenths = st.integers(0, 10).map(lambda i: i / 10)


def test_docstring_examples_pass() -> None:
    assert doctest.testmod(data_association).failed == 0


def best_sum(gain: np.ndarray) -> float:
    """Return the largest sum of gains over all one-to-one pairings of rows and columns."""
    if gain.shape[0] > gain.shape[1]:
        gain = gain.T
    rows = np.arange(len(gain))
    return max(
        gain[rows, list(pairing)].sum() for pairing in permutations(range(gain.shape[1]), len(gain))
    )


@given(
    st.tuples(st.integers(1, 4), st.integers(1, 4)).flatmap(
        lambda shape: st.tuples(
            arrays(float, shape, elements=tenths), arrays(bool, shape, elements=st.booleans())
        )
    )
)
def test_associated_pairs_are_allowed_and_maximize_iou_sum(
    case: tuple[np.ndarray, np.ndarray],
) -> None:
    iou, allowed = case
    k, r = associate(iou, allowed, 0.4)
    assert np.all(allowed[k, r] & (iou[k, r] >= 0.4))
    assert len(set(k.tolist())) == len(set(r.tolist())) == len(k)
    assert abs(iou[k, r].sum() - best_sum(np.where(allowed & (iou >= 0.4), iou, 0))) < 1e-12


def test_equal_iou_is_resolved_to_lowest_indices() -> None:
    k, r = associate(np.full((3, 2), 0.8), np.ones((3, 2), bool), 0.4)
    assert list(zip(k, r, strict=True)) == [(0, 0), (1, 1)]


def test_empty_input_gives_no_pairs() -> None:
    for shape in ((0, 3), (3, 0), (0, 0)):
        k, r = associate(np.zeros(shape), np.zeros(shape, bool), 0.4)
        assert len(k) == len(r) == 0


def test_region_statistics_match_brute_force() -> None:
    """One region is so large that only a fraction of its Gaussians is sorted."""
    labelled_map = LabelledMap()
    shot = shoot(SCENE_OBJECTS, poses(1)[0])
    view, _ = labelled_map.show(shot, shot.detections(SCENE_OBJECTS))
    rng = np.random.default_rng(1)
    regions = rng.choice([-1, 0, 1, 2], len(view.regions), p=[0.2, 0.7, 0.094, 0.006])
    boxes, classes = np.zeros((3, 4)), np.zeros((3, 2), int)
    view = replace(view, regions=regions.astype(np.int32), boxes=boxes, classes=classes)
    assert np.count_nonzero(regions == 0) > 3 * MEMBERS
    statistics = compute_region_statistics(
        view, np.linalg.inv(view.T_map_camera), AssociationConfig(min_gaussians=30)
    )
    counts = np.bincount(regions[regions >= 0], minlength=3)
    assert statistics.numbers.tolist() == np.flatnonzero(counts >= 30).tolist()
    for number, members, p in zip(
        statistics.numbers, statistics.members, statistics.distributions, strict=True
    ):
        rows = view.indices[regions == number]
        rows = rows[np.argsort(shuffled(view.ids[rows]))][:MEMBERS]
        np.testing.assert_array_equal(members[members >= 0], view.ids[rows])
        weights = 1 / (1 + np.exp(-view.rows[rows, 10].astype(float)))
        expected = np.average(distribution(view.labels[rows]), axis=0, weights=weights)
        np.testing.assert_allclose(p, expected, atol=1e-5)


PLANT, TABLE = 60, 62
WHOLE = (0, 0, 100, 200)  # Pixels.


RegionExtent = tuple[tuple[int, int, int, int], float, float]


def containing_regions(regions: list[RegionExtent], classes: list[tuple[int, int]]) -> list[int]:
    """Return the containing region of each region, given its box, nearest and farthest depth."""
    boxes, near_m, far_m = (np.array(values, float) for values in zip(*regions, strict=True))
    return find_containing_regions(
        boxes, np.array(classes), near_m, far_m, AssociationConfig()
    ).tolist()


@pytest.mark.parametrize(
    ("other", "near_m", "name", "is_part"),
    [
        ((10, 0, 90, 100), 2.0, PLANT, True),
        ((-5, 0, 95, 100), 2.0, PLANT, True),  # 95 % of the part lies in the whole.
        ((-15, 0, 85, 100), 2.0, PLANT, False),  # 85 % is not enough: two overlapping regions.
        ((10, 0, 90, 100), 2.0, TABLE, False),
        ((10, 0, 90, 100), 2.5, PLANT, False),  # One region is behind the other.
        ((10, 0, 90, 100), 2.35, PLANT, True),  # The gap is within the tolerance of depth.
        (WHOLE, 2.0, PLANT, False),  # Boxes of equal size.
        ((300, 300, 300, 310), 2.0, PLANT, False),  # A box without area, outside of the whole.
    ],
)
def test_part_needs_larger_containing_box_of_same_class_and_depth(
    other: tuple[int, int, int, int], near_m: float, name: int, is_part: bool
) -> None:
    regions: list[RegionExtent] = [(other, near_m, near_m + 0.2), (WHOLE, 2.0, 2.3)]
    assert containing_regions(regions, [(name, -1), (PLANT, -1)]) == [1 if is_part else 0, 1]


def test_nested_parts_map_to_outermost_region() -> None:
    crown, top, neighbor = (0, 0, 100, 100), (20, 0, 80, 50), (90, 0, 300, 200)
    regions: list[RegionExtent] = [
        (top, 2, 2.2),
        (crown, 2, 2.2),
        (WHOLE, 2, 2.2),
        (neighbor, 2, 2.2),
    ]
    assert containing_regions(regions, [(PLANT, -1)] * 4) == [2, 2, 2, 3]
    # A top at the depth of the crown, but not of the pot, belongs to the whole too.
    behind: list[RegionExtent] = [(top, 2.5, 2.6), (crown, 2.1, 2.45), (WHOLE, 2.0, 2.2)]
    assert containing_regions(behind, [(PLANT, -1)] * 3) == [2, 2, 2]


def test_detector_or_labeller_class_may_match_that_of_the_whole() -> None:
    regions: list[RegionExtent] = [((10, 0, 90, 100), 2, 2.2), (WHOLE, 2, 2.2)]
    for part, whole, is_part in (
        ((PLANT, -1), (PLANT, TABLE), True),  # The labeller named only the whole.
        ((-1, TABLE), (PLANT, TABLE), True),
        # The detector's class of the part is the labeller's class of the whole.
        ((PLANT, -1), (-1, PLANT), True),
        ((PLANT, -1), (-1, TABLE), False),
        ((-1, -1), (-1, -1), False),
    ):
        assert containing_regions(regions, [part, whole]) == [1 if is_part else 0, 1]


def test_parts_merge_when_whole_has_no_pixels_left() -> None:
    crown, pot = (0, 0, 100, 120), (20, 120, 80, 200)
    empty_range = (np.inf, -np.inf)
    regions: list[RegionExtent] = [(crown, 2.0, 2.4), (pot, 2.1, 2.3), (WHOLE, *empty_range)]
    assert containing_regions(regions, [(PLANT, -1)] * 3) == [2, 2, 2]
    separate: list[RegionExtent] = [(crown, 2.0, 2.4), (pot, 2.9, 3.3), (WHOLE, *empty_range)]
    assert containing_regions(separate, [(PLANT, -1)] * 3) == [2, 1, 2]


def test_merged_parts_assign_their_gaussians_to_the_whole() -> None:
    labelled_map = LabelledMap()
    shot = shoot(SCENE_OBJECTS, poses(1)[0])
    view, _ = labelled_map.show(shot, shot.detections(SCENE_OBJECTS))
    boxes = np.array([[0, 0, 20, 20], [30, 30, 60, 60], [0, 0, 20, 40]], float)
    regions = np.random.default_rng(1).integers(-2, 3, len(view.regions)).astype(np.int32)
    view = replace(view, regions=regions, boxes=boxes, classes=np.full((3, 2), PLANT))
    config = AssociationConfig()
    whole = merge_parts(
        view, compute_region_statistics(view, np.linalg.inv(view.T_map_camera), config), config
    )
    np.testing.assert_array_equal(whole.regions, np.where(regions == 0, 2, regions))
    # The view is returned unchanged, because parts need a common class.
    separate = replace(view, classes=np.array([[PLANT, -1], [PLANT, -1], [TABLE, -1]]))
    separate_statistics = compute_region_statistics(
        separate, np.linalg.inv(view.T_map_camera), config
    )
    assert merge_parts(separate, separate_statistics, config) is separate
