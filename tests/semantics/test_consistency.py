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


def random_gaussians(n: int, side_m: float, classes: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and labels of random Gaussians; a third of them is labelled."""
    rng = np.random.default_rng(n)
    rows, labels = np.zeros((n, 16), np.float32), new_labels(n)
    rows[:, :3] = rng.uniform(-side_m, side_m, (n, 3))
    indices = np.sort(rng.choice(n, n // 3, replace=False)).astype(np.uint32)
    for _ in range(3):
        seen = rng.integers(2, classes, len(indices)).astype(np.int16)
        confidence, size = rng.random((2, len(indices)), np.float32)
        observe(labels, Observations(indices, seen, confidence, size), LabelConfig())
    return rows, labels


def test_docstring_examples_pass() -> None:
    assert doctest.testmod(gaussian_labels).failed == 0


@pytest.mark.parametrize("side_m", [0.1, 0.3, 1.0])
def test_kernel_matches_reference_and_keeps_other_rows(side_m: float) -> None:
    rows, labels = random_gaussians(600, side_m)
    indices = np.flatnonzero(np.arange(600) % 5).astype(np.uint32)
    before = labels.copy()
    p, reference = agree_reference(rows, labels, indices, CONFIG)
    loss = smooth_labels(rows, labels, indices, CONFIG)
    np.testing.assert_allclose(distribution(labels[indices]), p, atol=2e-6)
    assert (loss.literal, loss.expected) == pytest.approx(
        (reference.literal, reference.expected), rel=1e-4
    )
    np.testing.assert_array_equal(labels[::5], before[::5])  # Rows outside of `indices`.


def test_repeated_smoothing_lowers_loss_and_keeps_distributions_normalized() -> None:
    rows, labels = random_gaussians(600, 0.15, classes=20)
    indices = np.arange(600, dtype=np.uint32)
    losses = [smooth_labels(rows, labels, indices, CONFIG).expected for _ in range(20)]
    assert np.all(np.diff(losses) < 0)
    np.testing.assert_allclose(distribution(labels).sum(axis=1), 1, atol=1e-5)


def test_isolated_and_unlabelled_gaussians_are_not_changed() -> None:
    rows, labels = random_gaussians(300, 0.2)
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


def test_distant_and_non_finite_rows_are_not_changed() -> None:
    rows, labels = random_gaussians(300, 0.2)
    rows[::3, 1], rows[1::3, 0] = np.nan, 1e9
    before = labels.copy()
    smooth_labels(rows, labels, np.arange(300, dtype=np.uint32), CONFIG)
    np.testing.assert_array_equal(labels[::3], before[::3])
    np.testing.assert_array_equal(labels[1::3], before[1::3])
    assert np.all(np.isfinite(background(labels)))


def test_result_is_bitwise_equal_for_any_thread_count() -> None:
    rows, alone = random_gaussians(20_000, 0.6)
    many, indices = alone.copy(), np.arange(20_000, dtype=np.uint32)
    losses = (
        smooth_labels(rows, alone, indices, CONFIG),
        smooth_labels(rows, many, indices, CONFIG, threads=3),
    )
    assert losses[0] == losses[1]
    assert alone.tobytes() == many.tobytes()


def test_invalid_arrays_and_settings_raise() -> None:
    rows, labels = random_gaussians(10, 0.2)
    with pytest.raises(ValueError, match="shape"):
        smooth_labels(rows[:5], labels, np.arange(5, dtype=np.uint32), CONFIG)
    with pytest.raises(ValueError, match="ascend"):
        smooth_labels(rows, labels, np.array([3, 3], np.uint32), CONFIG)
    with pytest.raises(ConfigError):
        ConsistencyConfig(rate=2.0)
