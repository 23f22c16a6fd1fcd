"""Training crops of the encoder, on drawings."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

pytest.importorskip("jax", reason="needs the trainer's libraries: pip install --group train")

RED, GREEN, GRAY = (200, 0, 0), (0, 200, 0), 90


@pytest.fixture
def encoder(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "training")
    import encoder

    yield encoder
    for name in ("encoder", "crops", "layers", "regions", "training", "views", "layout", "wear"):
        sys.modules.pop(name, None)


def drawn(encoder: ModuleType, shape: tuple[int, int], color: tuple, instance: int):
    """Return a gray board with an object in its middle half."""
    plane = np.zeros(shape, np.uint8)
    height, width = shape
    plane[height // 4 : -height // 4, width // 4 : -width // 4] = instance
    image = np.full((*shape, 3), GRAY, np.uint8)
    image[plane > 0] = color
    return encoder.Shown(image, plane, instance)


def test_occluder_covers_with_its_own_pixels_only(encoder: ModuleType) -> None:
    covered = set()
    for seed in range(20):
        shown, by = drawn(encoder, (48, 32), RED, 3), drawn(encoder, (20, 24), GREEN, 7)
        encoder._cover(shown.color, by, np.random.default_rng(seed))
        is_green = (shown.color == GREEN).all(axis=-1)
        assert is_green.sum() <= (by.plane > 0).sum()
        # Pixels outside it are unchanged.
        assert (shown.color[~is_green & (shown.plane > 0)] == RED).all()
        assert (shown.color[~is_green & (shown.plane == 0)] == GRAY).all()
        covered.add(int(is_green.sum()))
    assert len(covered) > 5


def test_walls_cover_nothing(encoder: ModuleType) -> None:
    shown, wall = drawn(encoder, (40, 40), RED, 3), drawn(encoder, (20, 20), GREEN, 0)
    before = shown.color.copy()
    encoder._cover(shown.color, wall, np.random.default_rng(0))
    assert (shown.color == before).all()


def test_crop_of_a_box_is_resized_and_centered(encoder: ModuleType) -> None:
    image = np.full((60, 80, 3), GRAY, np.uint8)
    image[10:30, 20:60] = RED
    taken = encoder.crop(image, np.array([20.0, 10.0, 60.0, 30.0]), 32)
    assert taken.shape == (32, 32, 3)
    assert (taken[8:24] == RED).all()
    mean = np.round(encoder.MEAN * 255)
    assert (taken[:8] == mean).all()
    assert (taken[24:] == mean).all()
