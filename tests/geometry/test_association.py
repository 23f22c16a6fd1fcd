import numpy as np
from evo.core.sync import matching_time_indices

from ldo_service.geometry import associate


def test_nearest_partners_agree_with_evo() -> None:
    rng = np.random.default_rng(0)
    a = np.arange(200) / 30 + rng.uniform(-0.004, 0.004, 200)
    b = np.arange(700) / 100
    assert associate(a, b, 0.02).T.tolist() == list(map(list, matching_time_indices(a, b, 0.02)))


def test_each_stamp_is_used_once_and_the_closest_pair_wins() -> None:
    a, b = np.array([0, 10, 100]), np.array([9, 300])
    assert associate(a, b, 20).tolist() == [[1, 0]]


def test_unsorted_stamps_find_their_partners() -> None:
    a, b = np.array([30, 10, 20]), np.array([21, 31, 11])
    assert associate(a, b, 5).tolist() == [[0, 1], [1, 2], [2, 0]]


def test_tolerance_is_inclusive_in_integers() -> None:
    assert len(associate(np.array([0]), np.array([20_000_000]), 20_000_000)) == 1
    assert len(associate(np.array([0]), np.array([20_000_001]), 20_000_000)) == 0


def test_empty_stamps_give_no_pairs() -> None:
    assert associate(np.zeros(0), np.array([1.0]), 1.0).shape == (0, 2)
