"""Motion of Gaussians, compared bitwise with NumPy."""

import numpy as np
import pytest

from ldo_service.gaussians.rows import aligned_rows, move_rows
from ldo_service.geometry import se3
from ldo_service.kernels import _motion
from tests.reference import motion


def scene(count: int, keyframes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows [N, 16] and the anchors [N] of random Gaussians, in runs of one anchor."""
    rng = np.random.default_rng(0)
    rows = aligned_rows(count)
    rows[:] = rng.normal(size=rows.shape)
    return rows, np.sort(rng.integers(0, keyframes, count)).astype(np.int32)


def motions(keyframes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    T = np.array([se3.exp(rng.normal(size=6)) for _ in keyframes])
    return T, se3.quaternion(T[:, :3, :3])


@pytest.mark.parametrize("count", [1, 1000, 70_000])
def test_motion_is_bitwise_that_of_numpy(count: int) -> None:
    rows, anchors = scene(count, 40)
    np.random.default_rng(2).shuffle(anchors[: count // 2])
    keyframes = np.arange(-3, 50, 2)  # Half of the anchors move; some keyframes have no Gaussian.
    T, q = motions(keyframes)
    expected = rows.copy()
    motion.move_rows(expected, anchors, keyframes, T, q)
    before = rows.copy()
    move_rows(rows, anchors, keyframes, T, q)
    assert rows.tobytes() == expected.tobytes()
    assert (rows[anchors % 2 == 0] == before[anchors % 2 == 0]).all()
    assert not (rows[anchors % 2 == 1, :3] == before[anchors % 2 == 1, :3]).any()


def test_result_is_bitwise_equal_for_any_number_of_threads() -> None:
    keyframes = np.arange(40)
    T, q = motions(keyframes)
    results = []
    for threads in (1, 3):
        rows, anchors = scene(70_000, 40)
        _motion.move_rows(rows, anchors, keyframes, T, q, threads)
        results.append(rows.tobytes())
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": np.zeros((4, 15), np.float32)}, r"rows must have shape \[N, 16\]"),
        ({"anchors": np.zeros(3, np.int32)}, r"anchors must have shape \[4\]"),
        ({"anchors": np.zeros(4, np.int64)}, "anchors must be int32"),
        ({"keyframes": np.array([1, 0])}, "keyframes must ascend"),
        ({"T_new_old": np.zeros((2, 3, 4))}, r"T_new_old must have shape \[2, 4, 4\]"),
        ({"quaternions": np.zeros((2, 4), np.float32)}, "quaternions must be float64"),
        ({"threads": 0}, "threads must be at least 1"),
    ],
)
def test_invalid_arguments_are_rejected(change: dict, message: str) -> None:
    T, q = motions(np.arange(2))
    arguments = {
        "rows": np.zeros((4, 16), np.float32),
        "anchors": np.zeros(4, np.int32),
        "keyframes": np.arange(2),
        "T_new_old": T,
        "quaternions": q,
    }
    with pytest.raises(ValueError, match=message):
        _motion.move_rows(**{**arguments, **change})
