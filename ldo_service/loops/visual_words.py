"""Words of ORB features, learned from the first images on."""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.errors import ConfigError

BYTES = 32  # of an ORB descriptor
BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class VisualWordsConfig:
    count: int = 1024  # 4 kB of counts a subgraph; 512 find 2 % less on kitchen and flat, 2048 no
    # more
    apart_bits: int = 64  # of 256: a feature farther from every word becomes one
    learned_at_once: int = 64  # of one image, so that many images have a part in the words

    def __post_init__(self) -> None:
        if min(self.count, self.learned_at_once) < 1 or not 0 <= self.apart_bits < 8 * BYTES:
            raise ConfigError(f"{self}: counts must be at least 1, apart_bits within 0..255.")


class VisualWords:
    """Descriptors that stand for those nearest to them: leaders, that never change or go.

    The same images in the same order give the same words.
    """

    def __init__(self, config: VisualWordsConfig, words: np.ndarray | None = None) -> None:
        self._config = config
        self.words = np.zeros((0, BYTES), np.uint8) if words is None else words

    def learn(self, descriptors: np.ndarray) -> None:
        """Take what is far from every word among descriptors [N, 32], up to the limits."""
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
        """[count] float32: how many descriptors [N, 32] are nearest to each word."""
        if not len(descriptors) or not len(self.words):
            return np.zeros(self._config.count, np.float32)
        nearest = [m.trainIdx for m in _matches(descriptors, self.words)]
        return np.bincount(nearest, minlength=self._config.count).astype(np.float32)

    def _distances(self, descriptors: np.ndarray) -> np.ndarray:
        """[N] bits to the nearest word; 256 while there is none."""
        if not len(self.words):
            return np.full(len(descriptors), 8 * BYTES)
        return np.array([int(m.distance) for m in _matches(descriptors, self.words)])


def _matches(descriptors: np.ndarray, words: np.ndarray) -> tuple[cv2.DMatch, ...]:
    return tuple(cv2.BFMatcher(cv2.NORM_HAMMING).match(descriptors, words))
