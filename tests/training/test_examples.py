"""Training examples of the detector, on a drawing of one object."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

RED, FLOOR, ID, NAME = (200, 0, 0), (90, 90, 60), 7, 3
MODULES = ("examples", "cells", "views", "layout", "regions", "wear")


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Return the module with recoloring and degradation switched off."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "training")
    import examples

    monkeypatch.setattr(examples, "recolor", lambda color, _plane, _rng: color)
    monkeypatch.setattr(examples, "degrade", lambda color, _rng, _blur_px: color)
    yield examples
    for name in MODULES:
        sys.modules.pop(name, None)


def drawn() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a frame, its ids and their names.

    A red object has 120x90 pixels from (100, 80).
    """
    color, plane = np.full((240, 320, 3), FLOOR, np.uint8), np.zeros((240, 320), np.uint8)
    color[80:170, 100:220], plane[80:170, 100:220] = RED, ID
    names = np.full(256, -1)
    names[ID] = NAME
    return color, plane, names


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("is_small", [False, True])
def test_boxes_enclose_the_visible_object(examples: ModuleType, seed: int, is_small: bool) -> None:
    canvas = examples.SMALL if is_small else examples.Canvas()
    image, names, _, boxes, has_box = examples._example(
        *drawn(), canvas, np.random.default_rng(seed)
    )
    assert image.shape == (*canvas.size_px[::-1], 3)
    is_red = (image[..., 0].astype(int) - image[..., 2]) > 100
    v, u = np.nonzero(is_red)
    seen = u.min(), v.min(), u.max() + 1, v.max() + 1
    assert has_box.any()
    assert set(names[has_box]) == {NAME}
    np.testing.assert_allclose(boxes[has_box], np.tile(seen, (has_box.sum(), 1)), atol=1.5)


def test_zoom_scales_the_object_and_pads_the_rest(examples: ModuleType) -> None:
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
