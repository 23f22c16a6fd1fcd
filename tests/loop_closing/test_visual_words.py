import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.loop_closing.loop_detector import VisualWords, VisualWordsConfig


def flipped(descriptors: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    """The same with so many bits of each turned."""
    out = np.unpackbits(descriptors, axis=1)
    for row in out:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(out, axis=1)


def some(count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


def test_words_are_far_from_each_other_and_near_to_all_that_was_seen() -> None:
    rng = np.random.default_rng(0)
    seen = some(20, rng)
    words = VisualWords(VisualWordsConfig(count=100, learned_at_once=100))
    words.learn(np.concatenate([flipped(seen, 10, rng) for _ in range(5)]))
    bits = np.unpackbits(words.words, axis=1).astype(int)
    apart = np.abs(bits[:, None] - bits).sum(axis=2)
    assert len(bits) == 20, "each of the twenty once"
    assert apart[~np.eye(20, dtype=bool)].min() > 64


def test_a_feature_counts_for_its_nearest_word() -> None:
    rng = np.random.default_rng(1)
    seen = some(8, rng)
    words = VisualWords(VisualWordsConfig(count=10))
    words.learn(seen)
    again = flipped(seen[[2, 2, 5]], 30, rng)
    assert words.histogram(again).tolist() == [0, 0, 2, 0, 0, 1, 0, 0, 0, 0]


def test_one_image_teaches_so_many_words_and_all_together_no_more_than_there_is_room() -> None:
    rng = np.random.default_rng(2)
    words = VisualWords(VisualWordsConfig(count=50, learned_at_once=20))
    for expected in (20, 40, 50, 50):
        words.learn(some(100, rng))
        assert len(words.words) == expected


def test_an_image_without_features_has_no_words() -> None:
    words = VisualWords(VisualWordsConfig(count=5))
    nothing = np.zeros((0, 32), np.uint8)
    words.learn(nothing)
    assert words.histogram(nothing).tolist() == [0] * 5


def test_impossible_words_are_refused() -> None:
    with pytest.raises(ConfigError, match="apart_bits"):
        VisualWordsConfig(apart_bits=256)
