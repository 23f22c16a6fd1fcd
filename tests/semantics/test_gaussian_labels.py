import doctest
from math import log

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldo_service.errors import ConfigError
from ldo_service.gaussians import GaussianMap
from ldo_service.gaussians.model import LABEL_BYTES
from ldo_service.semantics import gaussian_labels as labels_module
from ldo_service.semantics.gaussian_labels import (
    MISS,
    NOT_SEEN,
    OTHER,
    ROW,
    SLOTS,
    LabelConfig,
    Observations,
    background,
    distribution,
    entropy,
    fields,
    new_labels,
    observe,
    top_labels,
)
from tests.reference.labels import observe_dense, observe_reference

CONFIGS = [LabelConfig(), LabelConfig(hold_back=0), LabelConfig(ema="paper")]


def looks(n: int, times: int, classes: int, seed: int) -> list[Observations]:
    rng = np.random.default_rng(seed)
    return [
        Observations(
            np.arange(n, dtype=np.uint32),
            rng.integers(NOT_SEEN, classes, n).astype(np.int16),
            rng.random(n).astype(np.float32),
            rng.random(n).astype(np.float32),
        )
        for _ in range(times)
    ]


def one(label: int, confidence: float = 0.5, extent_m: float = 0.5) -> Observations:
    values = np.array([confidence], np.float32), np.array([extent_m], np.float32)
    return Observations(np.zeros(1, np.uint32), np.array([label], np.int16), *values)


def test_examples_in_the_docstrings_hold() -> None:
    assert doctest.testmod(labels_module).failed == 0


def test_a_row_is_half_a_cache_line() -> None:
    assert ROW.itemsize == LABEL_BYTES


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("classes", [4, 30])
def test_kernel_does_what_its_twin_does(config: LabelConfig, classes: int) -> None:
    ours, twin = new_labels(200), new_labels(200)
    for seen in looks(200, 40, classes, seed=1):
        observe(ours, seen, config)
        observe_reference(twin, seen, config)
        np.testing.assert_allclose(distribution(ours), distribution(twin), atol=2e-6)
    for name in ("misses", "extent_mm"):
        np.testing.assert_array_equal(fields(ours)[name], fields(twin)[name])
    np.testing.assert_allclose(fields(ours)["evidence"], fields(twin)["evidence"], rtol=1e-5)


@pytest.mark.parametrize("config", CONFIGS)
def test_five_labels_are_kept_exactly(config: LabelConfig) -> None:
    ours, rest = new_labels(200), new_labels(200)
    dense = np.eye(7)[np.zeros(200, int)]
    for seen in looks(200, 40, 2 + SLOTS - 1, seed=2):  # background, other and four names
        observe(ours, seen, config)
        observe_dense(dense, rest, seen, config)
        np.testing.assert_allclose(distribution(ours, 7), dense, atol=2e-6)


def test_of_many_labels_none_is_off_by_more_than_other_has() -> None:
    config = LabelConfig(hold_back=0)  # which looks at the entropy, and that is another
    ours, rest = new_labels(200), new_labels(200)
    dense, p = np.eye(40)[np.zeros(200, int)], np.zeros((200, 40))
    for seen in looks(200, 40, 40, seed=3):
        observe(ours, seen, config)
        observe_dense(dense, rest, seen, config)
        p = distribution(ours, 40)
        off = np.abs(np.delete(p - dense, OTHER, axis=1)).max(axis=1)
        assert np.all(off <= p[:, OTHER] + 2e-6)
    assert np.any(p[:, OTHER] > 0.05)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(NOT_SEEN, 255), st.floats(0, 1)), max_size=30),
    st.sampled_from(CONFIGS),
)
def test_distributions_sum_to_one_heaviest_first(seen, config) -> None:
    labels = new_labels(1)
    for label, confidence in seen:
        observe(labels, one(label, confidence), config)
    row = fields(labels)[0]
    assert np.all(np.diff(row["weights"]) <= 0)
    assert np.all(row["weights"] >= 0)
    assert distribution(labels).sum() == pytest.approx(1, abs=1e-5)
    named = row["ids"][row["weights"] > 0]
    assert len(set(named.tolist())) == len(named)


@settings(deadline=None)
@given(st.floats(0.01, 0.98), st.floats(0.01, 1), st.sampled_from(CONFIGS))
def test_a_surer_observation_moves_a_label_further(low, gap, config) -> None:
    shares = []
    for confidence in (low, min(low + gap, 1)):
        labels = new_labels(1)
        for label, sure in ((3, 0.7), (4, confidence)):
            observe(labels, one(label, sure), config)
        shares.append(distribution(labels)[0, 4])
    assert shares[0] <= shares[1]


def test_literal_average_needs_seven_sightings_to_flip_a_label() -> None:
    labels, config = new_labels(1), LabelConfig(ema="paper", hold_back=0)
    tops = []
    for _ in range(8):
        observe(labels, one(9, 1.0), config)
        tops.append(int(top_labels(labels)[0]))
    assert tops == [0] * 6 + [9] * 2


def test_literal_average_reverts_after_five_misses_in_a_row() -> None:
    labels, config = new_labels(1), LabelConfig(ema="paper")
    for label in (7, MISS, MISS, MISS, MISS, 7, MISS, MISS, NOT_SEEN, MISS, MISS):
        observe(labels, one(label), config)
    assert distribution(labels)[0, 7] > 0
    observe(labels, one(MISS), config)
    assert not labels.any()


def test_corrected_average_takes_the_first_sighting_whole() -> None:
    labels = new_labels(1)
    observe(labels, one(5, 0.3), LabelConfig())
    assert distribution(labels)[0, 5] == 1


def test_a_miss_counts_where_the_object_would_have_been_large_enough() -> None:
    labels = new_labels(1)
    observe(labels, one(5, 0.5, extent_m=0.8), LabelConfig())
    observe(labels, one(MISS, extent_m=0.9), LabelConfig())
    assert distribution(labels)[0, 5] == 1
    observe(labels, one(MISS, extent_m=0.7), LabelConfig())
    assert distribution(labels)[0, 5] == pytest.approx(0.45 / 0.75)


def test_an_unsure_observation_of_a_settled_gaussian_is_held_back() -> None:
    shares = []
    for hold_back in (0.0, 1.0):
        labels, config = new_labels(1), LabelConfig(hold_back=hold_back)
        for label, confidence in ((5, 1.0), (6, 0.3)):
            observe(labels, one(label, confidence), config)
        shares.append(float(distribution(labels)[0, 6]))
    assert shares == pytest.approx([0.3 / 1.2, 0.09 / 0.99], abs=1e-6)


def test_entropy_is_that_of_the_dense_distribution() -> None:
    labels = new_labels(200)
    for seen in looks(200, 20, 12, seed=4):
        observe(labels, seen, LabelConfig())
    p = distribution(labels).astype(float)
    expected = -np.sum(np.where(p > 0, p * np.log(np.maximum(p, 1e-30)), 0), axis=1)
    np.testing.assert_allclose(entropy(labels), expected, atol=1e-5)
    assert entropy(labels).min() >= 0
    assert entropy(labels).max() <= log(SLOTS + 1) + 1e-5


def test_labels_travel_as_the_rows_of_a_map_do() -> None:
    """What follows moves is what was there: rows are plain bytes."""
    gaussians, labels = GaussianMap(), new_labels(20)
    gaussians.add(np.random.default_rng(0).normal(size=(20, 16)).astype(np.float32), 0)
    still = new_labels(20)
    first, second = looks(20, 2, 9, seed=5)
    for rows in (labels, still):
        observe(rows, first, LabelConfig())
    away = np.arange(20) % 3 == 0
    kept, asleep = labels[~away], labels[away].tobytes()
    back = np.empty_like(labels)
    back[~away], back[away] = kept, np.frombuffer(asleep, np.uint8).reshape(-1, LABEL_BYTES)
    for rows in (back, still):
        observe(rows, second, LabelConfig())
    assert back.tobytes() == still.tobytes()


def test_bits_do_not_depend_on_the_number_of_threads() -> None:
    alone, many = new_labels(20_000), new_labels(20_000)
    for seen in looks(20_000, 5, 9, seed=6):
        observe(alone, seen, LabelConfig())
        observe(many, seen, LabelConfig(), threads=3)
    assert alone.tobytes() == many.tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"indices": np.array([1, 1], np.uint32)}, "ascend"),
        ({"indices": np.array([0, 9], np.uint32)}, "below the number"),
        ({"labels": np.array([0, 256], np.int16)}, "below 256"),
        ({"labels": np.array([0, -3], np.int16)}, "below 256"),
        ({"labels": np.array([0, 1], np.int32)}, "int16"),
        ({"confidences": np.array([0.5, np.nan], np.float32)}, "0..1"),
        ({"extents_m": np.array([1, -1], np.float32)}, "negative"),
        ({"extents_m": np.ones(3, np.float32)}, "shape"),
    ],
)
def test_observations_that_do_not_fit_are_refused(change, message) -> None:
    good = {
        "indices": np.array([0, 1], np.uint32),
        "labels": np.array([2, 3], np.int16),
        "confidences": np.ones(2, np.float32),
        "extents_m": np.ones(2, np.float32),
    }
    labels = new_labels(4)
    with pytest.raises(ValueError, match=message):
        observe(labels, Observations(**(good | change)), LabelConfig())
    assert not labels.any()


@pytest.mark.parametrize(
    "wrong", [{"ema": "none"}, {"keep": 1.0}, {"miss_limit": 0}, {"hold_back": 2.0}]
)
def test_settings_beyond_their_range_are_refused(wrong) -> None:
    with pytest.raises(ConfigError):
        LabelConfig(**wrong)


def test_a_label_beyond_the_classes_is_told() -> None:
    labels = new_labels(1)
    observe(labels, one(200), LabelConfig())
    with pytest.raises(ValueError, match="must be below 82"):
        distribution(labels, 82)
    assert background(labels)[0] == 0
