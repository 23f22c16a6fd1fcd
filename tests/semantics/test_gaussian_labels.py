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
    count_labelled,
    distribution,
    entropy,
    fields,
    new_labels,
    observe,
    top_labels,
)
from tests.reference.labels import observe_dense, observe_reference

CONFIGS = [LabelConfig(), LabelConfig(hold_back=0), LabelConfig(ema="paper")]


def random_observations(n: int, times: int, classes: int, seed: int) -> list[Observations]:
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


def one_observation(label: int, confidence: float = 0.5, extent_m: float = 0.5) -> Observations:
    values = np.array([confidence], np.float32), np.array([extent_m], np.float32)
    return Observations(np.zeros(1, np.uint32), np.array([label], np.int16), *values)


def test_docstring_examples_pass() -> None:
    assert doctest.testmod(labels_module).failed == 0


def test_label_row_has_declared_size() -> None:
    assert ROW.itemsize == LABEL_BYTES


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("classes", [4, 30])
def test_kernel_matches_reference(config: LabelConfig, classes: int) -> None:
    ours, reference = new_labels(200), new_labels(200)
    for seen in random_observations(200, 40, classes, seed=1):
        observe(ours, seen, config)
        observe_reference(reference, seen, config)
        np.testing.assert_allclose(distribution(ours), distribution(reference), atol=2e-6)
    for name in ("misses", "extent_mm"):
        np.testing.assert_array_equal(fields(ours)[name], fields(reference)[name])
    np.testing.assert_allclose(fields(ours)["evidence"], fields(reference)["evidence"], rtol=1e-5)


@pytest.mark.parametrize("config", CONFIGS)
def test_up_to_five_labels_are_exact(config: LabelConfig) -> None:
    ours, rest = new_labels(200), new_labels(200)
    dense = np.eye(7)[np.zeros(200, int)]
    # Background, other and four names.
    for seen in random_observations(200, 40, 2 + SLOTS - 1, seed=2):
        observe(ours, seen, config)
        observe_dense(dense, rest, seen, config)
        np.testing.assert_allclose(distribution(ours, 7), dense, atol=2e-6)


def test_error_of_each_label_is_bounded_by_weight_of_other() -> None:
    # Holding back depends on the entropy, which differs from that of the dense distribution.
    config = LabelConfig(hold_back=0)
    ours, rest = new_labels(200), new_labels(200)
    dense, p = np.eye(40)[np.zeros(200, int)], np.zeros((200, 40))
    for seen in random_observations(200, 40, 40, seed=3):
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
def test_distributions_sum_to_one_and_are_sorted_by_weight(seen, config) -> None:
    labels = new_labels(1)
    for label, confidence in seen:
        observe(labels, one_observation(label, confidence), config)
    row = fields(labels)[0]
    assert np.all(np.diff(row["weights"]) <= 0)
    assert np.all(row["weights"] >= 0)
    assert distribution(labels).sum() == pytest.approx(1, abs=1e-5)
    named = row["ids"][row["weights"] > 0]
    assert len(set(named.tolist())) == len(named)


@settings(deadline=None)
@given(st.floats(0.01, 0.98), st.floats(0.01, 1), st.sampled_from(CONFIGS))
def test_higher_confidence_increases_label_weight(low, gap, config) -> None:
    weights = []
    for confidence in (low, min(low + gap, 1)):
        labels = new_labels(1)
        for label, value in ((3, 0.7), (4, confidence)):
            observe(labels, one_observation(label, value), config)
        weights.append(distribution(labels)[0, 4])
    assert weights[0] <= weights[1]


def test_paper_average_needs_seven_observations_to_change_label() -> None:
    labels, config = new_labels(1), LabelConfig(ema="paper", hold_back=0)
    tops = []
    for _ in range(8):
        observe(labels, one_observation(9, 1.0), config)
        tops.append(int(top_labels(labels)[0]))
    assert tops == [0] * 6 + [9] * 2


def test_paper_average_resets_after_five_consecutive_misses() -> None:
    labels, config = new_labels(1), LabelConfig(ema="paper")
    for label in (7, MISS, MISS, MISS, MISS, 7, MISS, MISS, NOT_SEEN, MISS, MISS):
        observe(labels, one_observation(label), config)
    assert distribution(labels)[0, 7] > 0
    observe(labels, one_observation(MISS), config)
    assert not labels.any()


def test_corrected_average_gives_first_observation_full_weight() -> None:
    labels = new_labels(1)
    observe(labels, one_observation(5, 0.3), LabelConfig())
    assert distribution(labels)[0, 5] == 1


def test_miss_counts_only_below_the_observed_extent() -> None:
    labels = new_labels(1)
    observe(labels, one_observation(5, 0.5, extent_m=0.8), LabelConfig())
    observe(labels, one_observation(MISS, extent_m=0.9), LabelConfig())
    assert distribution(labels)[0, 5] == 1
    observe(labels, one_observation(MISS, extent_m=0.7), LabelConfig())
    assert distribution(labels)[0, 5] == pytest.approx(0.45 / 0.75)


def test_hold_back_reduces_weight_of_uncertain_observation() -> None:
    weights = []
    for hold_back in (0.0, 1.0):
        labels, config = new_labels(1), LabelConfig(hold_back=hold_back)
        for label, confidence in ((5, 1.0), (6, 0.3)):
            observe(labels, one_observation(label, confidence), config)
        weights.append(float(distribution(labels)[0, 6]))
    assert weights == pytest.approx([0.3 / 1.2, 0.09 / 0.99], abs=1e-6)


def test_entropy_matches_dense_distribution() -> None:
    labels = new_labels(200)
    for seen in random_observations(200, 20, 12, seed=4):
        observe(labels, seen, LabelConfig())
    p = distribution(labels).astype(float)
    expected = -np.sum(np.where(p > 0, p * np.log(np.maximum(p, 1e-30)), 0), axis=1)
    np.testing.assert_allclose(entropy(labels), expected, atol=1e-5)
    assert entropy(labels).min() >= 0
    assert entropy(labels).max() <= log(SLOTS + 1) + 1e-5


def test_moved_label_rows_continue_bitwise_equal() -> None:
    """Label rows are plain bytes that may be offloaded and loaded."""
    gaussians, labels = GaussianMap(), new_labels(20)
    gaussians.add(np.random.default_rng(0).normal(size=(20, 16)).astype(np.float32), 0)
    unmoved = new_labels(20)
    first, second = random_observations(20, 2, 9, seed=5)
    for rows in (labels, unmoved):
        observe(rows, first, LabelConfig())
    is_offloaded = np.arange(20) % 3 == 0
    kept, offloaded = labels[~is_offloaded], labels[is_offloaded].tobytes()
    loaded = np.empty_like(labels)
    loaded[~is_offloaded] = kept
    loaded[is_offloaded] = np.frombuffer(offloaded, np.uint8).reshape(-1, LABEL_BYTES)
    for rows in (loaded, unmoved):
        observe(rows, second, LabelConfig())
    assert loaded.tobytes() == unmoved.tobytes()


def test_result_is_bitwise_equal_for_any_thread_count() -> None:
    alone, many = new_labels(20_000), new_labels(20_000)
    for seen in random_observations(20_000, 5, 9, seed=6):
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
def test_invalid_observations_raise(change, message) -> None:
    valid = {
        "indices": np.array([0, 1], np.uint32),
        "labels": np.array([2, 3], np.int16),
        "confidences": np.ones(2, np.float32),
        "extents_m": np.ones(2, np.float32),
    }
    labels = new_labels(4)
    with pytest.raises(ValueError, match=message):
        observe(labels, Observations(**(valid | change)), LabelConfig())
    assert not labels.any()


@pytest.mark.parametrize(
    "wrong", [{"ema": "none"}, {"keep": 1.0}, {"miss_limit": 0}, {"hold_back": 2.0}]
)
def test_settings_out_of_range_raise_config_error(wrong) -> None:
    with pytest.raises(ConfigError):
        LabelConfig(**wrong)


def test_distribution_raises_for_label_above_class_count() -> None:
    labels = new_labels(1)
    observe(labels, one_observation(200), LabelConfig())
    with pytest.raises(ValueError, match="must be below 82"):
        distribution(labels, 82)
    assert background(labels)[0] == 0


def test_fast_background_and_count_equal_plain_sums() -> None:
    rng = np.random.default_rng(4)
    weights = rng.random((5000, 5), np.float32)
    weights *= rng.uniform(0, 1.2, (5000, 1)).astype(np.float32) / weights.sum(1, keepdims=True)
    labels = new_labels(len(weights))
    fields(labels)["weights"] = -np.sort(-weights, axis=1)
    fields(labels)["ids"] = 7
    plain = np.maximum(1 - fields(labels)["weights"].sum(axis=1), 0)
    assert np.array_equal(background(labels), plain)
    assert 0 < count_labelled(labels) < len(labels)
    assert count_labelled(labels) == np.count_nonzero(top_labels(labels))
