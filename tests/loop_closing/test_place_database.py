"""Tests of TF-IDF histograms against values by hand and a NumPy reference."""

import numpy as np

from ldo_service.loop_closing.place_database import Histograms


def histograms_of(*rows: list[float]) -> Histograms:
    histograms = Histograms(len(rows[0]))
    for row in rows:
        histograms.add(np.array(row))
    return histograms


def reference_cosines(rows: np.ndarray, row: np.ndarray) -> np.ndarray:
    idf = np.log(1 + len(rows) / np.maximum((rows > 0).sum(axis=0), 1))
    a, b = rows * idf, row * idf
    return np.array([x @ b / (np.linalg.norm(x) * np.linalg.norm(b)) for x in a])


def test_word_in_few_histograms_weighs_more() -> None:
    """Three rooms have a chair and one of them a sink: idf is log 2 and log 4 = 2 log 2."""
    rooms = histograms_of([1, 0], [1, 0], [1, 1])
    np.testing.assert_allclose(rooms.idf(), [np.log(2), np.log(4)], rtol=1e-6)
    # The query (1, 1) is weighted to (1, 2); its cosine to (1, 0) is 1 / sqrt(5).
    np.testing.assert_allclose(rooms.cosines(np.array([1, 1])), [5**-0.5, 5**-0.5, 1], rtol=1e-6)


def test_cosines_follow_added_and_removed_histograms() -> None:
    rng = np.random.default_rng(0)
    rows = rng.poisson(0.7, (40, 30)).astype(np.float32)
    histograms, remaining = Histograms(30), list(rows)
    for row in rows:
        histograms.add(row)
    for index in (39, 17, 0, 5):
        histograms.remove(index)
        del remaining[index]
    row = rng.poisson(0.7, 30)
    np.testing.assert_allclose(
        histograms.cosines(row), reference_cosines(np.array(remaining), row), rtol=1e-5
    )
    assert len(histograms) == 36


def test_empty_histogram_has_zero_cosine_to_all() -> None:
    assert histograms_of([0, 0], [1, 0]).cosines(np.array([1, 0])).tolist() == [0, 1]
    assert histograms_of([0, 0], [1, 0]).cosines(np.array([0, 0])).tolist() == [0, 0]
    assert Histograms(2).cosines(np.array([1, 0])).shape == (0,)
