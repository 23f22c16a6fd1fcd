import doctest

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.errors import ConfigError
from ldo_service.semantics import semantic_fusion
from ldo_service.semantics.semantic_fusion import FusedLabels, FusionConfig, fuse_confidences

FRACTIONS = st.floats(0, 1, width=32)


def fuse_one(
    overlap: float, detector: float, labeller: float, rule: str = "adaptive"
) -> FusedLabels:
    """Fuse label 3 of the detector with label 4 of the labeller."""
    columns = np.array([[3], [detector], [overlap], [4], [labeller]])
    return fuse_confidences(*columns, FusionConfig(rule=rule))  # type: ignore[arg-type]


def test_docstring_examples_pass() -> None:
    assert doctest.testmod(semantic_fusion).failed == 0


@given(FRACTIONS, FRACTIONS)
def test_zero_labeller_confidence_gives_detector_label(overlap, confidence) -> None:
    for rule in ("adaptive", "fixed", "detector"):
        fused = fuse_one(overlap, confidence, 0.0, rule)
        assert (fused.labels[0], fused.alpha[0]) == (3, 1)
        assert fused.confidences[0] == np.float32(confidence)


@given(FRACTIONS, FRACTIONS, FRACTIONS)
def test_fused_confidence_lies_between_both_sources(overlap, detector, labeller) -> None:
    fused = fuse_one(overlap, detector, labeller)
    if labeller > 0:
        assert min(detector, labeller) - 1e-6 <= fused.confidences[0]
    assert fused.confidences[0] <= max(detector, labeller) + 1e-6
    assert 0 <= fused.alpha[0] <= 1


@given(FRACTIONS, FRACTIONS, FRACTIONS, st.floats(0, 1, width=32))
def test_higher_confidence_increases_weight_of_its_source(
    overlap, detector, labeller, other
) -> None:
    if labeller == 0:
        return
    alpha = fuse_one(overlap, detector, labeller).alpha[0]
    assert fuse_one(overlap, max(detector, other), labeller).alpha[0] >= alpha
    assert fuse_one(overlap, detector, max(labeller, other)).alpha[0] <= alpha


@given(FRACTIONS, FRACTIONS, FRACTIONS)
def test_fused_label_has_larger_weighted_confidence(overlap, detector, labeller) -> None:
    fused = fuse_one(overlap, detector, labeller)
    from_detector = fused.alpha[0] * np.float32(detector)
    from_labeller = (1 - fused.alpha[0]) * np.float32(labeller)
    assert fused.labels[0] == (3 if from_detector >= from_labeller else 4)


def test_fixed_and_detector_rules_ignore_adaptive_weight() -> None:
    half, alone = fuse_one(1, 0.4, 0.9, "fixed"), fuse_one(1, 0.4, 0.9, "detector")
    assert (half.labels[0], round(float(half.confidences[0]), 4)) == (4, 0.65)
    assert (alone.labels[0], round(float(alone.confidences[0]), 4)) == (3, 0.4)


def test_unknown_rule_raises_config_error() -> None:
    with pytest.raises(ConfigError, match="adaptive"):
        FusionConfig(rule="mean")  # type: ignore[arg-type]
