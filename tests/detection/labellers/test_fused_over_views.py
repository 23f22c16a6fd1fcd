"""Fusion of the label probabilities of several views of a region."""

import doctest

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.detection import labellers
from ldo_service.detection.labellers import chat_completion, dual_encoder, fused_over_views

PROBABILITIES = st.floats(0, 1)
VIEW = st.dictionaries(st.sampled_from("abcd"), PROBABILITIES).map(lambda view: list(view.items()))


@pytest.mark.parametrize("module", [labellers, chat_completion, dual_encoder])
def test_docstring_examples_pass(module) -> None:
    result = doctest.testmod(module, extraglobs={"np": __import__("numpy")})
    assert result.attempted > 0
    assert result.failed == 0


@given(st.lists(VIEW, min_size=1, max_size=5))
def test_fused_probabilities_are_sorted_means_of_the_views(views) -> None:
    fused = fused_over_views(views)
    means = [mean for _, mean in fused]
    assert means == sorted(means, reverse=True)
    for name, mean in fused:
        probabilities = [dict(view).get(name, 0.0) for view in views]
        assert mean == pytest.approx(sum(probabilities) / len(probabilities))


def test_views_without_labels_give_no_labels() -> None:
    assert fused_over_views([]) == fused_over_views([[], []]) == []
