"""Search for nearest descriptors, compared with OpenCV."""

import cv2
import numpy as np
import pytest

from ldo_service.kernels import _matching

BODY = """
from ldo_service.kernels import _matching
n = len(given["a"])
result["index"], least, second = np.empty(n, np.int64), np.empty(n, np.int32), np.empty(n, np.int32)
_matching.nearest(given["a"], given["b"], result["index"], least, second)
result["distances"] = np.stack([least, second], axis=1)
"""


def descriptors(count: int, seed: int) -> np.ndarray:
    """Return descriptors [count, 32] of few distinct bytes, so that many distances are equal."""
    return np.random.default_rng(seed).choice(np.array([0, 1, 3, 255], np.uint8), (count, 32))


@pytest.mark.parametrize("count", [2, 3, 400])
def test_nearest_descriptors_are_those_of_opencv(with_isa, count: int) -> None:
    a, b = descriptors(300, 0), descriptors(count, 1)
    b[-1] = b[0]  # Two candidates at the same distance from every descriptor.
    found = with_isa(BODY, {"a": a, "b": b})
    expected = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a, b, k=2)
    np.testing.assert_array_equal(found["index"], [m.trainIdx for m, _ in expected])
    np.testing.assert_array_equal(
        found["distances"], [(m.distance, n.distance) for m, n in expected]
    )


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (np.zeros((3, 31), np.uint8), np.zeros((3, 32), np.uint8), "descriptors must have shape"),
        (np.zeros((3, 32), np.uint8), np.zeros((3, 32), np.int8), "candidates must be uint8"),
        (np.zeros((3, 32), np.uint8), np.zeros((1, 32), np.uint8), "at least 2 rows"),
        (np.zeros((4, 32), np.uint8), np.zeros((3, 32), np.uint8), "index must have shape"),
    ],
)
def test_wrong_arrays_are_refused(a: np.ndarray, b: np.ndarray, message: str) -> None:
    index, least, second = np.empty(3, np.int64), np.empty(3, np.int32), np.empty(3, np.int32)
    with pytest.raises(ValueError, match=message):
        _matching.nearest(a, b, index, least, second)
