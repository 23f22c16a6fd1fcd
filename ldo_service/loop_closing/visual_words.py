"""Visual words: a vocabulary of ORB descriptors. Each word represents all similar descriptors.

The words are learned while the loop detector runs, beginning with the first image.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.errors import ConfigError, named

BYTES = 32  # Length of an ORB descriptor.
BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class VisualWordsConfig:
    """Parameters of the visual words."""

    # Maximum number of words; the counts of 1024 words need 4 kB per subgraph. On the sequences
    # kitchen and `synthetic:flat`, 2048 words find as many loops as 1024, and 512 words find 2 %
    # fewer.
    count: int = 1024
    # A descriptor becomes a word if it differs from every word in more than this many of 256 bits.
    apart_bits: int = 64
    # Maximum new words per image, so that many images contribute words.
    learned_at_once: int = 64

    def __post_init__(self) -> None:
        if min(self.count, self.learned_at_once) < 1 or not 0 <= self.apart_bits < 8 * BYTES:
            raise ConfigError(
                named(self, "count", "apart_bits", "learned_at_once")
                + ": count and learned_at_once must be at least 1, and apart_bits must be within "
                "0..255."
            )


class VisualWords:
    """Vocabulary of ORB descriptors, called visual words.

    A histogram counts each feature for its nearest word. Words never change and are never removed.
    The same images in the same order give the same words.
    """

    def __init__(self, config: VisualWordsConfig, words: np.ndarray | None = None) -> None:
        """Start with the words [n, 32] uint8 of a snapshot; None starts without words."""
        self._config = config
        self.words = np.zeros((0, BYTES), np.uint8) if words is None else words

    def learn(self, descriptors: np.ndarray) -> None:
        """Add each descriptor as a new word if it differs enough from all words.

        The Hamming distance to every word must be more than `apart_bits`. One call adds at most
        `learned_at_once` words, and all calls together at most `count` words.

        Args:
            descriptors: ORB descriptors of an image, [N, 32] uint8.
        """
        room = min(self._config.count - len(self.words), self._config.learned_at_once)
        if room <= 0 or not len(descriptors):
            return
        nearest = self._distances(descriptors)
        fresh: list[int] = []
        while len(fresh) < room and len(far := np.flatnonzero(nearest > self._config.apart_bits)):
            fresh.append(int(far[0]))
            differing = BITS[descriptors ^ descriptors[fresh[-1]]].sum(axis=1)
            nearest = np.minimum(nearest, differing)
        if fresh:
            self.words = np.concatenate([self.words, descriptors[fresh]])

    def histogram(self, descriptors: np.ndarray) -> np.ndarray:
        """Count the descriptors [N, 32] by their nearest word; return [count] float32."""
        if not len(descriptors) or not len(self.words):
            return np.zeros(self._config.count, np.float32)
        nearest = [m.trainIdx for m in _matches(descriptors, self.words)]
        return np.bincount(nearest, minlength=self._config.count).astype(np.float32)

    def _distances(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the Hamming distance of each descriptor to its nearest word, [N], in bits.

        All distances are 256 if there are no words.
        """
        if not len(self.words):
            return np.full(len(descriptors), 8 * BYTES)
        return np.array([int(m.distance) for m in _matches(descriptors, self.words)])


def _matches(descriptors: np.ndarray, words: np.ndarray) -> tuple[cv2.DMatch, ...]:
    return tuple(cv2.BFMatcher(cv2.NORM_HAMMING).match(descriptors, words))
