"""Tests of the texts in the panel of the window."""

import re

import pytest

from ldo_service.viewer import panel


def test_rate_covers_the_last_seconds() -> None:
    rate = panel.Rate()
    for second in range(100):
        rate.add(float(second), 10 * second if second < 50 else 500 + 2 * (second - 50))
    assert rate.hz == pytest.approx(2.0)


def test_rate_survives_a_restarted_counter() -> None:
    rate = panel.Rate()
    for now_s, count in ((0.0, 1000), (1.0, 1010), (2.0, 0), (3.0, 5)):
        rate.add(now_s, count)
    assert rate.hz == pytest.approx(5.0)


def test_rate_of_a_single_count_is_zero() -> None:
    rate = panel.Rate()
    rate.add(1.0, 7)
    assert rate.hz == 0


def test_summary_shows_valid_fields_and_skips_others() -> None:
    stages = {"tracker": {"p50": 12.4, "p95": 30.0}, "odd": 3}
    text_shown = panel.of_summary({"frames": 1234, "fps": 9.87, "stage_ms": stages})
    assert "1,234 frames, 9.9 frames/s" in text_shown
    assert "| tracker | 12 | 30 |" in text_shown
    assert "odd" not in text_shown
    assert panel.of_summary({"frames": "many"}) == ""


def test_note_appears_only_if_some_gaussians_are_not_drawn() -> None:
    assert panel.share_shown(10, 10) == ""
    assert panel.share_shown(300_000, 1_200_000) == "300,000 of 1,200,000 Gaussians are drawn"


@pytest.mark.parametrize("text", ["{1 + 1}", "<b>x</b>", "[x](http://y)", "a|b_c*d`e", "\\"])
def test_markup_in_names_is_escaped(text: str) -> None:
    text_shown = panel.escaped(text)
    assert re.sub(r"\\(.)", r"\1", text_shown) == text
    assert not re.search(r"(?<!\\)[{<\[|*_`]", text_shown.replace("\\\\", ""))
