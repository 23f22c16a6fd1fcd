"""Histograms by TF-IDF, against figures worked out by hand and a plain twin."""

import numpy as np

from ldo_service.loop_closing.place_database import Histograms


def known(*rows: list[float]) -> Histograms:
    histograms = Histograms(len(rows[0]))
    for row in rows:
        histograms.add(np.array(row))
    return histograms


def twin(rows: np.ndarray, row: np.ndarray) -> np.ndarray:
    idf = np.log(1 + len(rows) / np.maximum((rows > 0).sum(axis=0), 1))
    a, b = rows * idf, row * idf
    return np.array([x @ b / (np.linalg.norm(x) * np.linalg.norm(b)) for x in a])


def test_a_word_that_few_hold_weighs_more() -> None:
    """Three rooms with a chair, one of them with a sink: idf is log 2 and log 4 = 2 log 2."""
    rooms = known([1, 0], [1, 0], [1, 1])
    np.testing.assert_allclose(rooms.idf(), [np.log(2), np.log(4)], rtol=1e-6)
    # of (1, 1): cos between (1, 0) and (1, 2) is 1 / sqrt(5)
    np.testing.assert_allclose(rooms.cosines(np.array([1, 1])), [5**-0.5, 5**-0.5, 1], rtol=1e-6)


def test_the_weights_are_learned_as_rows_come_and_forgotten_as_they_go() -> None:
    rng = np.random.default_rng(0)
    rows = rng.poisson(0.7, (40, 30)).astype(np.float32)
    histograms, kept = Histograms(30), list(rows)
    for row in rows:
        histograms.add(row)
    for index in (39, 17, 0, 5):
        histograms.remove(index)
        del kept[index]
    row = rng.poisson(0.7, 30)
    np.testing.assert_allclose(histograms.cosines(row), twin(np.array(kept), row), rtol=1e-5)
    assert len(histograms) == 36


def test_what_is_empty_is_like_nothing() -> None:
    assert known([0, 0], [1, 0]).cosines(np.array([1, 0])).tolist() == [0, 1]
    assert known([0, 0], [1, 0]).cosines(np.array([0, 0])).tolist() == [0, 0]
    assert Histograms(2).cosines(np.array([1, 0])).shape == (0,)
