import doctest

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.errors import ConfigError
from ldo_service.semantics import semantic_fusion
from ldo_service.semantics.semantic_fusion import FusedLabels, FusionConfig, fuse_confidences

SHARES = st.floats(0, 1, width=32)


def of(overlap: float, detector: float, labeller: float, rule: str = "adaptive") -> FusedLabels:
    """Of label 3 by the detector, 4 by the labeller."""
    columns = np.array([[3], [detector], [overlap], [4], [labeller]])
    return fuse_confidences(*columns, FusionConfig(rule=rule))  # type: ignore[arg-type]


def test_examples_in_the_docstring_hold() -> None:
    assert doctest.testmod(semantic_fusion).failed == 0


@given(SHARES, SHARES)
def test_without_the_labeller_it_is_the_detector_alone(overlap, confidence) -> None:
    for rule in ("adaptive", "fixed", "detector"):
        one = of(overlap, confidence, 0.0, rule)
        assert (one.labels[0], one.alpha[0]) == (3, 1)
        assert one.confidences[0] == np.float32(confidence)


@given(SHARES, SHARES, SHARES)
def test_confidence_lies_between_the_two(overlap, detector, labeller) -> None:
    one = of(overlap, detector, labeller)
    if labeller > 0:
        assert min(detector, labeller) - 1e-6 <= one.confidences[0]
    assert one.confidences[0] <= max(detector, labeller) + 1e-6
    assert 0 <= one.alpha[0] <= 1


@given(SHARES, SHARES, SHARES, st.floats(0, 1, width=32))
def test_a_surer_source_gains_weight(overlap, detector, labeller, more) -> None:
    if labeller == 0:
        return
    alpha = of(overlap, detector, labeller).alpha[0]
    assert of(overlap, max(detector, more), labeller).alpha[0] >= alpha
    assert of(overlap, detector, max(labeller, more)).alpha[0] <= alpha


@given(SHARES, SHARES, SHARES)
def test_label_is_that_of_the_larger_weighted_confidence(overlap, detector, labeller) -> None:
    one = of(overlap, detector, labeller)
    ours, theirs = one.alpha[0] * np.float32(detector), (1 - one.alpha[0]) * np.float32(labeller)
    assert one.labels[0] == (3 if ours >= theirs else 4)


def test_ablations_fix_the_weight_or_ignore_the_labeller() -> None:
    half, alone = of(1, 0.4, 0.9, "fixed"), of(1, 0.4, 0.9, "detector")
    assert (half.labels[0], round(float(half.confidences[0]), 4)) == (4, 0.65)
    assert (alone.labels[0], round(float(alone.confidences[0]), 4)) == (3, 0.4)


def test_unknown_rules_are_refused() -> None:
    with pytest.raises(ConfigError, match="adaptive"):
        FusionConfig(rule="mean")  # type: ignore[arg-type]
