import doctest

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import entropy as kl_of

from ldo_service.semantics import distributions
from ldo_service.semantics.distributions import (
    common_mass,
    dense,
    divergence,
    entropy,
    mean_distributions,
    names,
    sparse,
)
from ldo_service.semantics.gaussian_labels import (
    MAX_LABELS,
    OTHER,
    distribution,
    fields,
    new_labels,
)

CHAIR, LAMP = 58, 90


def some(rng: np.random.Generator, count: int, used: int = 4) -> np.ndarray:
    """Distributions [count, C] over a few labels each."""
    p = np.zeros((count, MAX_LABELS))
    for row in p:
        row[rng.choice(MAX_LABELS, used, replace=False)] = rng.random(used) + 1e-3
    return p / p.sum(axis=1, keepdims=True)


def test_the_examples_hold() -> None:
    assert doctest.testmod(distributions).failed == 0


@given(st.integers(0, 2**32))
def test_divergence_is_that_of_scipy_where_nothing_is_impossible(seed: int) -> None:
    p, q = some(np.random.default_rng(seed), 2)
    q = (q + 0.01) / np.sum(q + 0.01)
    np.testing.assert_allclose(divergence(p, q), kl_of(p, q), atol=1e-12)
    np.testing.assert_allclose(entropy(p), kl_of(p), atol=1e-12)


@given(st.integers(0, 2**32))
def test_divergence_is_finite_zero_of_equals_and_never_negative_beyond_the_floor(seed: int) -> None:
    p, q = some(np.random.default_rng(seed), 2)
    assert np.isfinite(divergence(p, q))
    assert divergence(p, q) > -1e-9
    assert abs(divergence(p, p)) < 1e-12


@given(st.integers(0, 2**32), st.integers(1, 30))
def test_sparse_ones_keep_what_is_heavy_and_put_the_rest_on_other(seed: int, used: int) -> None:
    p = some(np.random.default_rng(seed), 3, used)
    again = dense(*sparse(p))
    np.testing.assert_allclose(again.sum(axis=1), 1, atol=1e-12)
    kept = np.argsort(-p, axis=1, kind="stable")[:, :8]
    expected = np.zeros_like(p)
    np.put_along_axis(expected, kept, np.take_along_axis(p, kept, 1), 1)
    expected[:, OTHER] += 1 - expected.sum(axis=1)
    np.testing.assert_allclose(again, expected, atol=1e-6)


@given(arrays(np.float64, (2, 5), elements=st.floats(0, 1)))
def test_pooled_is_the_weighted_mean(weights: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    labels = new_labels(10)
    rows = fields(labels)
    rows["ids"][:, 0], rows["weights"][:, 0] = rng.integers(2, 5, 10), rng.random(10)
    each = distribution(labels).reshape(2, 5, -1)
    got = mean_distributions(labels.reshape(2, 5, 32), weights)
    np.testing.assert_allclose(got.sum(axis=1), 1)
    for k in range(2):
        if weights[k].sum() > 1e-6:
            expected = np.average(each[k], axis=0, weights=weights[k])
            np.testing.assert_allclose(got[k], expected, atol=1e-6)


def test_nothing_is_background() -> None:
    assert mean_distributions(new_labels(4)[None], np.zeros((1, 4)))[0, 0] == 1
    assert mean_distributions(np.zeros((0, 4, 32), np.uint8), np.zeros((0, 4))).shape == (
        0,
        MAX_LABELS,
    )


@pytest.mark.parametrize(
    ("p", "q", "expected"),
    [
        ({CHAIR: 1}, {CHAIR: 1}, 1),
        ({CHAIR: 1}, {LAMP: 1}, 0),
        ({CHAIR: 0.2, 0: 0.8}, {CHAIR: 1}, 1),  # a chair beside a wall is a chair
        ({0: 1}, {0: 1}, 0),  # what two things that nobody named have in common is nothing
        ({CHAIR: 0.5, LAMP: 0.5}, {CHAIR: 1}, 0.5),
    ],
)
def test_classes_in_common(p: dict, q: dict, expected: float) -> None:
    one, other = (np.zeros(MAX_LABELS) for _ in range(2))
    for row, weights in ((one, p), (other, q)):
        row[list(weights)] = list(weights.values())
    before = one.copy()
    assert common_mass(one, other) == pytest.approx(expected)
    np.testing.assert_array_equal(one, before)


def test_the_name_is_the_heaviest_label_but_background() -> None:
    p = np.zeros(MAX_LABELS)
    p[[0, LAMP, CHAIR]] = 0.6, 0.3, 0.1
    assert names(p) == LAMP
