"""Table of object landmarks against plain loops and known shapes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.geometry import Camera, se3
from ldo_service.semantics.gaussian_labels import fields, new_labels
from ldo_service.semantics.object_landmarks import (
    MEMBERS,
    NO_MEMBER,
    boxes,
    derive,
    merged_members,
    moments,
    moved,
    new_landmarks,
    reliable_members,
    rows_of,
    shuffled,
    trimmed,
    within,
)

CHAIR = 58
id_lists = st.lists(st.integers(0, 10**12), max_size=400, unique=True)


def packed(members: list[int], votes: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return members and votes [1, 256] in shuffled order."""
    out = np.full((1, MEMBERS), NO_MEMBER)
    ordered = sorted(members, key=lambda i: int(shuffled(np.array(i))))[:MEMBERS]
    out[0, : len(ordered)] = ordered
    return out, np.where(out >= 0, votes, 0).astype(np.int8)


@given(id_lists, id_lists)
def test_joined_members_are_first_in_shuffled_order_and_keep_votes(
    one: list[int], other: list[int]
) -> None:
    members, votes = packed(one, 5)
    others, other_votes = packed(other, 1)
    got, got_votes = merged_members(members, votes, others, other_votes)
    known = set(members[members >= 0].tolist())
    expected, _ = packed(sorted(known | set(others[others >= 0].tolist())))
    np.testing.assert_array_equal(got, expected)
    expected_votes = [0 if i < 0 else 5 if i in known else 1 for i in got[0].tolist()]
    assert got_votes[0].tolist() == expected_votes


@given(id_lists, id_lists)
def test_joined_members_do_not_depend_on_order(one: list[int], other: list[int]) -> None:
    a, b = packed(one), packed(other)
    np.testing.assert_array_equal(merged_members(*a, *b)[0], merged_members(*b, *a)[0])


def test_members_without_votes_are_removed() -> None:
    members, votes = packed([1, 2, 3])
    votes[members == 2] = 0
    got, _ = merged_members(members, votes, *packed([4]))
    assert sorted(got[got >= 0].tolist()) == [1, 3, 4]


def test_shuffled_ids_are_unique_and_uniform() -> None:
    positions = shuffled(np.arange(100_000))
    assert len(np.unique(positions)) == 100_000
    per_cell = np.bincount((positions >> np.uint64(58)).astype(int))
    assert per_cell.max() - per_cell.min() < 10


def test_rows_of_gives_minus_one_for_missing_ids() -> None:
    resident_ids = np.array([2, 5, 9])
    np.testing.assert_array_equal(
        rows_of(np.array([[9, 3], [2, NO_MEMBER]]), resident_ids), [[2, -1], [0, -1]]
    )
    np.testing.assert_array_equal(rows_of(np.array([4]), resident_ids[:0]), [-1])


# --- shapes ---------------------------------------------------------------------------------------
def cloud(size: tuple[float, float, float], T: np.ndarray, count: int = 250) -> np.ndarray:
    """Return points [1, count, 3] in a box of the given size and pose."""
    rng = np.random.default_rng(3)
    return se3.transform(T, (rng.random((count, 3)) - 0.5) * size)[None]


def test_rotated_box_is_recovered_despite_outliers() -> None:
    T = se3.exp(np.array([0.0, 0.0, 0.6, 1.0, -2.0, 0.5]))
    p = cloud((2.0, 0.6, 0.3), T)
    p[0, :4] += 50
    weights = np.ones(p.shape[:2])
    mean, covariance = moments(p, weights)
    np.testing.assert_allclose(mean[0], p[0, 4:].mean(axis=0), atol=0.04)
    T_map_object, size = boxes(p, weights > 0, covariance)
    np.testing.assert_allclose(size[0], [2.0, 0.6, 0.3], rtol=0.1)
    np.testing.assert_allclose(T_map_object[0, :3, 3], T[:3, 3], atol=0.05)
    assert abs(T_map_object[0, :3, 0] @ T[:3, 0]) > 0.99
    assert np.linalg.det(T_map_object[0, :3, :3]) == pytest.approx(1)


def test_box_of_a_cube_is_aligned_with_map_axes() -> None:
    p = cloud((1.0, 1.0, 1.0), np.eye(4))
    _, covariance = moments(p, np.ones(p.shape[:2]))
    T, _ = boxes(p, np.ones(p.shape[:2], bool), covariance)
    np.testing.assert_array_equal(T[0, :3, :3], np.eye(3))


@given(st.integers(1, MEMBERS), st.integers(0, 2**32))
def test_trimmed_drops_two_percent_at_each_end(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, valid = rng.normal(size=(1, MEMBERS, 2)), np.arange(MEMBERS)[None] < count
    low, high = trimmed(values, valid)
    cut = int(0.02 * count)
    ordered = np.sort(values[0, :count], axis=0)
    np.testing.assert_array_equal(low[0], ordered[cut])
    np.testing.assert_array_equal(high[0], ordered[count - 1 - cut])


def test_trimmed_without_values_gives_empty_range() -> None:
    low, high = trimmed(np.zeros((1, 4, 1)), np.zeros((1, 4), bool))
    assert low[0, 0] > high[0, 0]


# --- the table ------------------------------------------------------------------------------------
def one_landmark(p: np.ndarray, opacity_logits: np.ndarray) -> tuple[np.ndarray, tuple]:
    """Return a landmark of all Gaussians of a map at p [M, 3].

    The Gaussians are chairs; the last one is half background.
    """
    m = len(p)
    rows, labels = np.zeros((m, 16), np.float32), new_labels(m)
    rows[:, :3], rows[:, 10] = p, opacity_logits
    fields(labels)["ids"][:, 0], fields(labels)["weights"][:, 0] = CHAIR, 1
    fields(labels)["weights"][-1, 0] = 0.5
    table = new_landmarks(1, keyframe=7)
    table["members"], table["votes"] = packed(list(range(m)))
    anchors = np.where(np.arange(m) < 2, 9, 3).astype(np.int32)
    return table, (rows, labels, np.arange(m), anchors)


def test_landmark_statistics_are_weighted_by_opacity() -> None:
    p = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    logits = np.array([0.0, 1.0, 2.0, 3.0])
    table, gaussians = one_landmark(p, logits)
    derive(table, *gaussians, least=1)
    weights = 1 / (1 + np.exp(-logits))
    np.testing.assert_allclose(table["centroid"][0], np.average(p, axis=0, weights=weights))
    expected = np.cov(p.T, aweights=weights, ddof=0)
    np.testing.assert_allclose(table["covariance"][0], expected, atol=1e-12)
    background = 0.5 * weights[-1] / weights.sum()
    assert table["labels"][0, :2].tolist() == [CHAIR, 0]
    np.testing.assert_allclose(table["weights"][0, :2], [1 - background, background], rtol=1e-6)
    assert table["anchor"].tolist() == [3]  # Two Gaussians of each anchor: the smaller id.


def test_landmark_with_too_few_resident_gaussians_is_not_changed() -> None:
    table, (rows, labels, ids, anchors) = one_landmark(np.eye(3), np.zeros(3))
    before = table.copy()
    derive(table, rows[:1], labels[:1], ids[:1], anchors[:1], least=2)
    np.testing.assert_array_equal(table, before)


def test_members_with_few_votes_are_not_reliable() -> None:
    table = new_landmarks(1, 0)
    table["votes"][0, :4] = 8, 3, 2, 0
    assert reliable_members(table)[0, :5].tolist() == [True, True, False, False, False]


def test_moved_landmark_encloses_moved_gaussians() -> None:
    p = cloud((1.0, 0.4, 0.2), np.eye(4))[0]
    table, (rows, *others) = one_landmark(p, np.zeros(len(p)))
    derive(table, rows, *others, least=1)
    T = se3.exp(np.array([0.3, 0.2, -0.5, 1.0, 2.0, 3.0]))
    moved(table, T[None])
    np.testing.assert_allclose(table["centroid"][0], se3.transform(T, p).mean(axis=0), atol=0.02)
    local = (se3.transform(T, p) - table["T_map_object"][0, :3, 3]) @ table["T_map_object"][
        0, :3, :3
    ]
    assert np.mean(np.all(np.abs(local) <= table["size"][0] / 2 + 1e-6, axis=1)) > 0.85


@given(st.floats(-4, 4), st.floats(-4, 4), st.floats(-2, 6))
def test_landmark_with_a_point_in_the_image_is_within_view(x: float, y: float, z: float) -> None:
    camera = Camera(64, 48, 50.0, 60.0, 30.0, 25.0)
    table = new_landmarks(1, 0)
    table["centroid"], table["size"] = [x, y, z], [0.5, 0.2, 0.3]
    corners = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    p = table["centroid"] + corners * table["size"] / 2
    front = p[p[:, 2] > 1e-3]
    u, v = camera.project(front).T
    if np.any((u > -0.5) & (u < 63.5) & (v > -0.5) & (v < 47.5)):
        assert within(table, camera, np.eye(4))[0]


def test_landmark_outside_or_behind_the_camera_is_not_within_view() -> None:
    camera = Camera(64, 48, 50.0, 60.0, 30.0, 25.0)
    table = new_landmarks(3, 0)
    table["centroid"], table["size"] = [[0, 0, -1], [5, 0, 1], [0, 0, 3]], 0.3
    assert within(table, camera, np.eye(4)).tolist() == [False, False, True]
