import doctest

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.semantics import gaussian_labels
from ldo_service.semantics.gaussian_labels import (
    ConsistencyConfig,
    LabelConfig,
    Observations,
    background,
    distribution,
    new_labels,
    observe,
    smooth_labels,
)
from tests.reference.consistency import agree_reference

CONFIG = ConsistencyConfig()


def crowd(n: int, side_m: float, classes: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians at random, a third of which have labels."""
    rng = np.random.default_rng(n)
    rows, labels = np.zeros((n, 16), np.float32), new_labels(n)
    rows[:, :3] = rng.uniform(-side_m, side_m, (n, 3))
    indices = np.sort(rng.choice(n, n // 3, replace=False)).astype(np.uint32)
    for _ in range(3):
        seen = rng.integers(2, classes, len(indices)).astype(np.int16)
        sure, size = rng.random((2, len(indices)), np.float32)
        observe(labels, Observations(indices, seen, sure, size), LabelConfig())
    return rows, labels


def test_examples_in_the_docstring_hold() -> None:
    assert doctest.testmod(gaussian_labels).failed == 0


@pytest.mark.parametrize("side_m", [0.1, 0.3, 1.0])
def test_kernel_does_what_its_twin_does(side_m: float) -> None:
    rows, labels = crowd(600, side_m)
    indices = np.flatnonzero(np.arange(600) % 5).astype(np.uint32)
    before = labels.copy()
    p, twin = agree_reference(rows, labels, indices, CONFIG)
    loss = smooth_labels(rows, labels, indices, CONFIG)
    np.testing.assert_allclose(distribution(labels[indices]), p, atol=2e-6)
    assert (loss.literal, loss.expected) == pytest.approx((twin.literal, twin.expected), rel=1e-4)
    np.testing.assert_array_equal(labels[::5], before[::5])  # not touched


def test_steps_make_neighbors_agree_and_keep_distributions() -> None:
    rows, labels = crowd(600, 0.15, classes=20)
    indices = np.arange(600, dtype=np.uint32)
    losses = [smooth_labels(rows, labels, indices, CONFIG).expected for _ in range(20)]
    assert np.all(np.diff(losses) < 0)
    np.testing.assert_allclose(distribution(labels).sum(axis=1), 1, atol=1e-5)


def test_a_lonely_gaussian_and_an_unlabelled_crowd_stay_as_they_are() -> None:
    rows, labels = crowd(300, 0.2)
    labels[:] = 0
    rows[0, :3] = 50
    observe(
        labels,
        Observations(np.zeros(1, np.uint32), np.array([5], np.int16), *np.ones((2, 1), np.float32)),
        LabelConfig(),
    )
    before = labels.copy()
    loss = smooth_labels(rows, labels, np.arange(300, dtype=np.uint32), CONFIG)
    assert (loss.literal, loss.expected) == (0, 0)
    assert labels.tobytes() == before.tobytes()


def test_rows_far_away_or_not_finite_are_left_out() -> None:
    rows, labels = crowd(300, 0.2)
    rows[::3, 1], rows[1::3, 0] = np.nan, 1e9
    before = labels.copy()
    smooth_labels(rows, labels, np.arange(300, dtype=np.uint32), CONFIG)
    np.testing.assert_array_equal(labels[::3], before[::3])
    np.testing.assert_array_equal(labels[1::3], before[1::3])
    assert np.all(np.isfinite(background(labels)))


def test_bits_do_not_depend_on_the_number_of_threads() -> None:
    rows, alone = crowd(20_000, 0.6)
    many, indices = alone.copy(), np.arange(20_000, dtype=np.uint32)
    losses = (
        smooth_labels(rows, alone, indices, CONFIG),
        smooth_labels(rows, many, indices, CONFIG, threads=3),
    )
    assert losses[0] == losses[1]
    assert alone.tobytes() == many.tobytes()


def test_arrays_and_settings_that_do_not_fit_are_refused() -> None:
    rows, labels = crowd(10, 0.2)
    with pytest.raises(ValueError, match="shape"):
        smooth_labels(rows[:5], labels, np.arange(5, dtype=np.uint32), CONFIG)
    with pytest.raises(ValueError, match="ascend"):
        smooth_labels(rows, labels, np.array([3, 3], np.uint32), CONFIG)
    with pytest.raises(ConfigError):
        ConsistencyConfig(rate=2.0)
