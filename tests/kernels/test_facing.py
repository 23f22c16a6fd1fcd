"""Angles between normals and viewing rays, compared bit for bit with NumPy."""

import numpy as np
import pytest

from ldo_service.kernels import _facing
from tests.reference import facing

BODY = """
from ldo_service.kernels import _facing
cosines = np.empty(given["mask"].size)
count = _facing.facing_cosines(
    given["depth_m"], given["ray_x"], given["ray_y"], given["mask"], cosines
)
result["cosines"] = cosines[:count]
"""


def window(height: int, width: int) -> dict[str, np.ndarray]:
    """Return a window with a rough surface, holes in its depth and a flat patch at depth 0."""
    rng = np.random.default_rng(height * width)
    depth_m = rng.uniform(1.0, 1.2, (height, width)).astype(np.float32)
    depth_m[rng.uniform(size=depth_m.shape) < 0.1] = 0
    depth_m[: height // 3, : width // 3] = 0
    return {
        "depth_m": depth_m,
        "ray_x": (np.arange(width) - 0.4 * width) / 120,
        "ray_y": (np.arange(height) - 0.6 * height) / 130,
        "mask": (rng.uniform(size=depth_m.shape) < 0.7).astype(np.uint8),
    }


@pytest.mark.parametrize(("height", "width"), [(2, 2), (3, 5), (40, 70), (33, 3)])
def test_cosines_are_those_of_numpy_bit_for_bit(with_isa, height: int, width: int) -> None:
    given = window(height, width)
    found = with_isa(BODY, given)["cosines"]
    expected = facing.facing_cosines(**{**given, "mask": given["mask"] > 0})
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth_m": np.zeros((1, 5), np.float32)}, "sides of at least 2"),
        ({"depth_m": np.zeros((3, 5))}, "depth_m must be float32"),
        ({"ray_x": np.zeros(4)}, "ray_x must have shape"),
        ({"ray_y": np.zeros(5)}, "ray_y must have shape"),
        ({"mask": np.zeros((3, 4), np.uint8)}, "mask must have shape"),
        ({"cosines": np.zeros(14)}, "cosines must have shape"),
    ],
)
def test_wrong_arrays_are_refused(change: dict[str, np.ndarray], message: str) -> None:
    arrays = {**window(3, 5), "cosines": np.zeros(15), **change}
    with pytest.raises(ValueError, match=message):
        _facing.facing_cosines(**arrays)
