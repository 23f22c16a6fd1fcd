import doctest

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import entropy as kl_divergence

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


def random_distributions(rng: np.random.Generator, count: int, used: int = 4) -> np.ndarray:
    """Return distributions [count, C] over `used` labels each."""
    p = np.zeros((count, MAX_LABELS))
    for row in p:
        row[rng.choice(MAX_LABELS, used, replace=False)] = rng.random(used) + 1e-3
    return p / p.sum(axis=1, keepdims=True)


def test_docstring_examples_pass() -> None:
    assert doctest.testmod(distributions).failed == 0


@given(st.integers(0, 2**32))
def test_divergence_and_entropy_match_scipy_for_positive_probabilities(seed: int) -> None:
    p, q = random_distributions(np.random.default_rng(seed), 2)
    q = (q + 0.01) / np.sum(q + 0.01)
    np.testing.assert_allclose(divergence(p, q), kl_divergence(p, q), atol=1e-12)
    np.testing.assert_allclose(entropy(p), kl_divergence(p), atol=1e-12)


@given(st.integers(0, 2**32))
def test_divergence_is_finite_nonnegative_and_zero_for_equal_distributions(seed: int) -> None:
    p, q = random_distributions(np.random.default_rng(seed), 2)
    assert np.isfinite(divergence(p, q))
    assert divergence(p, q) > -1e-9
    assert abs(divergence(p, p)) < 1e-12


@given(st.integers(0, 2**32), st.integers(1, 30))
def test_sparse_distribution_keeps_heaviest_labels_and_moves_rest_to_other(
    seed: int, used: int
) -> None:
    p = random_distributions(np.random.default_rng(seed), 3, used)
    restored = dense(*sparse(p))
    np.testing.assert_allclose(restored.sum(axis=1), 1, atol=1e-12)
    kept = np.argsort(-p, axis=1, kind="stable")[:, :8]
    expected = np.zeros_like(p)
    np.put_along_axis(expected, kept, np.take_along_axis(p, kept, 1), 1)
    expected[:, OTHER] += 1 - expected.sum(axis=1)
    np.testing.assert_allclose(restored, expected, atol=1e-6)


@given(arrays(np.float64, (2, 5), elements=st.floats(0, 1)))
def test_mean_distributions_match_weighted_average(weights: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    labels = new_labels(10)
    rows = fields(labels)
    rows["ids"][:, 0], rows["weights"][:, 0] = rng.integers(2, 5, 10), rng.random(10)
    each = distribution(labels).reshape(2, 5, -1)
    mean = mean_distributions(labels.reshape(2, 5, 32), weights)
    np.testing.assert_allclose(mean.sum(axis=1), 1)
    for k in range(2):
        if weights[k].sum() > 1e-6:
            expected = np.average(each[k], axis=0, weights=weights[k])
            np.testing.assert_allclose(mean[k], expected, atol=1e-6)


def test_mean_without_weights_or_rows_is_background() -> None:
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
        ({CHAIR: 0.2, 0: 0.8}, {CHAIR: 1}, 1),  # Background does not count against the chair.
        ({0: 1}, {0: 1}, 0),  # Two unlabelled distributions have no common class.
        ({CHAIR: 0.5, LAMP: 0.5}, {CHAIR: 1}, 0.5),
    ],
)
def test_common_mass_ignores_background(p: dict, q: dict, expected: float) -> None:
    one, other = (np.zeros(MAX_LABELS) for _ in range(2))
    for row, weights in ((one, p), (other, q)):
        row[list(weights)] = list(weights.values())
    before = one.copy()
    assert common_mass(one, other) == pytest.approx(expected)
    np.testing.assert_array_equal(one, before)


def test_name_is_heaviest_label_except_background() -> None:
    p = np.zeros(MAX_LABELS)
    p[[0, LAMP, CHAIR]] = 0.6, 0.3, 0.1
    assert names(p) == LAMP
