"""Views of one region, made one opinion."""

import doctest

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.detection import labellers
from ldo_service.detection.labellers import chat_completion, dual_encoder, fused_over_views

PROBABILITIES = st.floats(0, 1)
VIEW = st.dictionaries(st.sampled_from("abcd"), PROBABILITIES).map(lambda view: list(view.items()))


@pytest.mark.parametrize("module", [labellers, chat_completion, dual_encoder])
def test_the_examples_hold(module) -> None:
    result = doctest.testmod(module, extraglobs={"np": __import__("numpy")})
    assert result.attempted > 0
    assert result.failed == 0


@given(st.lists(VIEW, min_size=1, max_size=5))
def test_means_are_sorted_and_within_what_the_views_say(views) -> None:
    fused = fused_over_views(views)
    means = [mean for _, mean in fused]
    assert means == sorted(means, reverse=True)
    for name, mean in fused:
        told = [dict(view).get(name, 0.0) for view in views]
        assert mean == pytest.approx(sum(told) / len(told))


def test_nobody_saying_anything_is_no_opinion() -> None:
    assert fused_over_views([]) == fused_over_views([[], []]) == []
