"""Histograms compared by TF-IDF, with the weights of words learned from all that is known."""

import numpy as np


class Histograms:
    """Rows [N, W] float32 of counts, in the order they came; the document frequencies go along.

    similarity of rows a, b = cos(a * idf, b * idf),  idf_w = log(1 + N / n_w)

    n_w of the N rows hold word w (Sivic and Zisserman 2003; the 1 keeps a word that all of them
    hold from counting nothing while there are few rows). Sums run in a fixed order, on one thread.

    >>> known = Histograms(2)
    >>> known.add(np.array([1.0, 0.0]))
    >>> known.add(np.array([1.0, 1.0]))
    >>> known.idf().round(3).tolist()  # log(1 + 2 / 2), log(1 + 2 / 1)
    [0.693, 1.099]
    """

    def __init__(self, words: int) -> None:
        self._rows = np.zeros((16, words), np.float32)
        self._count = 0
        self._frequency = np.zeros(words, np.int64)

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> np.ndarray:
        return self._rows[: self._count]

    def add(self, row: np.ndarray) -> None:
        """Append a row [W]; capacity doubles."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = row
        self._count += 1
        self._frequency += row > 0

    def remove(self, index: int) -> None:
        self._frequency -= self._rows[index] > 0
        self._rows[index : self._count - 1] = self._rows[index + 1 : self._count]
        self._count -= 1

    def idf(self) -> np.ndarray:
        """[W] float32; words that nobody holds weigh most."""
        return np.log1p(self._count / np.maximum(self._frequency, 1)).astype(np.float32)

    def cosines(self, row: np.ndarray) -> np.ndarray:
        """[N] float32 in 0..1: how like each row a row [W] is; 0 where either is empty."""
        weight = self.idf() ** 2
        product = np.einsum("nw,w->n", self.rows, weight * row.astype(np.float32))
        squares = np.einsum("nw,w->n", self.rows**2, weight)
        own = float(np.einsum("w,w,w->", row.astype(np.float32), row.astype(np.float32), weight))
        norms = np.sqrt(squares * own)
        return np.clip(np.where(norms > 0, product / np.where(norms > 0, norms, 1), 0), 0, 1)
