"""What the detector learns from, on a drawing of one thing."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

RED, FLOOR, ID, NAME = (200, 0, 0), (90, 90, 60), 7, 3
MADE = ("examples", "cells", "views", "layout", "regions", "wear")


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """With the paints as they are."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "training")
    import examples

    monkeypatch.setattr(examples, "recolor", lambda color, _plane, _rng: color)
    monkeypatch.setattr(examples, "degrade", lambda color, _rng, _blur_px: color)
    yield examples
    for name in MADE:
        sys.modules.pop(name, None)


def drawn() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A frame, its ids and their names: a red thing of 120x90 pixels from (100, 80)."""
    color, plane = np.full((240, 320, 3), FLOOR, np.uint8), np.zeros((240, 320), np.uint8)
    color[80:170, 100:220], plane[80:170, 100:220] = RED, ID
    names = np.full(256, -1)
    names[ID] = NAME
    return color, plane, names


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("is_small", [False, True])
def test_boxes_are_where_the_thing_is_seen(examples: ModuleType, seed: int, is_small: bool) -> None:
    canvas = examples.SMALL if is_small else examples.Canvas()
    image, names, _, boxes, tells = examples._example(*drawn(), canvas, np.random.default_rng(seed))
    assert image.shape == (*canvas.size_px[::-1], 3)
    is_red = (image[..., 0].astype(int) - image[..., 2]) > 100
    v, u = np.nonzero(is_red)
    seen = u.min(), v.min(), u.max() + 1, v.max() + 1
    assert tells.any()
    assert set(names[tells]) == {NAME}
    np.testing.assert_allclose(boxes[tells], np.tile(seen, (tells.sum(), 1)), atol=1.5)


def test_zoom_is_as_asked_and_the_rest_is_padding(examples: ModuleType) -> None:
    canvas = examples.Canvas((192, 160), (0.5, 0.5))
    for seed in range(8):
        image, *_ = examples._example(*drawn(), canvas, np.random.default_rng(seed))
        is_red = (image[..., 0].astype(int) - image[..., 2]) > 100
        assert is_red.sum() == pytest.approx(60 * 45, rel=0.05)
        is_padding = (image == examples.PADDING).all(axis=-1)
        assert is_padding.sum() == pytest.approx(192 * 160 - 160 * 120, abs=300)


def test_a_large_zoom_shows_a_part_without_padding(examples: ModuleType) -> None:
    canvas = examples.Canvas((192, 160), (1.2, 1.2))
    for seed in range(8):
        image, *_ = examples._example(*drawn(), canvas, np.random.default_rng(seed))
        assert not (image == examples.PADDING).all(axis=-1).any()
