"""Tests of visual words of binary descriptors."""

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.loop_closing.visual_words import VisualWords, VisualWordsConfig


def flipped(descriptors: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    """Return the descriptors with `bits` random bits of each flipped."""
    out = np.unpackbits(descriptors, axis=1)
    for row in out:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(out, axis=1)


def random_descriptors(count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


def test_noisy_copies_of_a_descriptor_become_one_word() -> None:
    rng = np.random.default_rng(0)
    descriptors_seen = random_descriptors(20, rng)
    words = VisualWords(VisualWordsConfig(count=100, learned_at_once=100))
    words.learn(np.concatenate([flipped(descriptors_seen, 10, rng) for _ in range(5)]))
    bits = np.unpackbits(words.words, axis=1).astype(int)
    distances = np.abs(bits[:, None] - bits).sum(axis=2)
    assert len(bits) == 20, "one word per descriptor"
    assert distances[~np.eye(20, dtype=bool)].min() > 64


def test_feature_counts_for_its_nearest_word() -> None:
    rng = np.random.default_rng(1)
    descriptors_seen = random_descriptors(8, rng)
    words = VisualWords(VisualWordsConfig(count=10))
    words.learn(descriptors_seen)
    query = flipped(descriptors_seen[[2, 2, 5]], 30, rng)
    assert words.histogram(query).tolist() == [0, 0, 2, 0, 0, 1, 0, 0, 0, 0]


def test_learning_is_bounded_per_image_and_in_total() -> None:
    rng = np.random.default_rng(2)
    words = VisualWords(VisualWordsConfig(count=50, learned_at_once=20))
    for expected in (20, 40, 50, 50):
        words.learn(random_descriptors(100, rng))
        assert len(words.words) == expected


def test_image_without_features_has_an_empty_histogram() -> None:
    words = VisualWords(VisualWordsConfig(count=5))
    no_features = np.zeros((0, 32), np.uint8)
    words.learn(no_features)
    assert words.histogram(no_features).tolist() == [0] * 5


def test_impossible_word_distance_is_rejected() -> None:
    with pytest.raises(ConfigError, match="apart_bits"):
        VisualWordsConfig(apart_bits=256)
