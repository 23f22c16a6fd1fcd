"""Nested foregrounds against sets of pixels."""

import doctest
from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.regions import foreground
from ldo_service.regions.foreground import Foreground, NestingConfig, without_nested

CONFIG = NestingConfig()
SHAPE = 24, 32


def square(row: int, column: int, height: int, width: int) -> Foreground:
    return Foreground(row, column, np.ones((height, width), bool))


def test_docstring_examples_pass() -> None:
    result = doctest.testmod(foreground)
    assert (result.attempted > 0, result.failed) == (True, 0)


TABLE, CUP = square(4, 4, 16, 20), square(6, 8, 5, 4)


@pytest.mark.parametrize(
    ("small", "score"),
    [
        (square(2, 8, 5, 4), 0.9),  # Extends beyond the table.
        (square(4, 4, 14, 20), 0.9),  # Nearly as large: the same object.
        (CUP, 0.4),  # Score below the limit.
        (Foreground(6, 8, np.zeros((5, 4), bool)), 0.9),
        (square(20, 24, 3, 3), 0.9),  # Outside of the table.
    ],
)
def test_parts_that_are_not_nested_stay_whole(small: Foreground, score: float) -> None:
    table, one = without_nested([TABLE, small], np.array([0.9, score]), CONFIG)
    assert np.array_equal(table.mask, TABLE.mask)
    assert np.array_equal(one.mask, small.mask)


def test_doubly_nested_part_is_cut_from_both() -> None:
    tray, spoon = square(6, 6, 8, 8), square(7, 7, 2, 4)
    table, left, top = without_nested([TABLE, tray, spoon], np.full(3, 0.5), CONFIG)
    counts = [int(part.mask.sum()) for part in (table, left, top)]
    assert counts == [16 * 20 - 8 * 8, 8 * 8 - 2 * 4, 2 * 4]


def test_random_parts_match_pixel_sets() -> None:
    rng = np.random.default_rng(5)
    for _ in range(30):
        parts = [
            Foreground(int(r), int(c), rng.random((int(h), int(w))) < 0.8)
            for r, c, h, w in rng.integers(1, 12, (6, 4))
        ]
        scores, images = rng.random(6), [part.image(SHAPE) for part in parts]
        left = without_nested(parts, scores, CONFIG)
        for k, image in enumerate(images):
            nested = [
                one
                for one, score in zip(images, scores, strict=True)
                if score >= CONFIG.min_score
                and 0 < CONFIG.times * one.sum() <= image.sum()
                and (one & image).sum() >= CONFIG.inside * one.sum()
            ]
            expected = image & ~np.any([np.zeros(SHAPE, bool), *nested], axis=0)
            assert np.array_equal(left[k].image(SHAPE), expected)


@pytest.mark.parametrize("fields", [{"inside": 0}, {"times": 1}, {"min_score": -1}])
def test_invalid_settings_raise_config_error(fields: dict) -> None:
    with pytest.raises(ConfigError):
        replace(CONFIG, **fields)
