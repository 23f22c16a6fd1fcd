"""Comparison of the surfaces of two views, with NumPy and with finite differences."""

import numpy as np
import pytest

from ldo_service.calibration.correction import bias_basis, unbiased_depth
from ldo_service.calibration.views import block_centers
from ldo_service.geometry import Camera, se3
from ldo_service.kernels import _surfaces
from tests.reference import surfaces as reference

CAMERA, BLOCK, STEP = Camera(160, 120, 130.0, 131.0, 78.0, 61.0), 4, (0.03, 0.01)
H, W = CAMERA.height // BLOCK, CAMERA.width // BLOCK
INTRINSICS = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
T = se3.exp(np.array([0.02, -0.05, 0.03, 0.1, -0.05, 0.02]))


def grid() -> tuple[np.ndarray, np.ndarray]:
    u, v = block_centers(CAMERA, BLOCK)
    return CAMERA.rays_at(u, v).reshape(-1, 3), bias_basis(u, v, CAMERA).reshape(-1, 3)


def bumpy_depth_m() -> np.ndarray:
    """Return depth [H, W] of a curved wall with a step and some holes."""
    v, u = np.mgrid[:H, :W]
    depth_m = 2.0 + 0.02 * u + 0.1 * np.sin(0.3 * v) * np.cos(0.2 * u)
    depth_m[:, W // 2 :] += 0.5
    depth_m[np.random.default_rng(0).random((H, W)) < 0.05] = 0.0
    return depth_m


def surfaces(depth_m: np.ndarray) -> np.ndarray:
    result = np.full((H * W, 6), np.nan)
    _surfaces.surfaces(depth_m, grid()[0], *STEP, result)
    return result


def compare(
    there: np.ndarray, here: np.ndarray, T_here_there: np.ndarray, stride: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, depths = np.empty((H * W, 10)), np.empty(H * W)
    indices = np.empty((H * W, 2), np.int64)
    count = _surfaces.compare(
        there, here, grid()[1], T_here_there, INTRINSICS, BLOCK, W, stride, 0.08,
        rows, depths, indices,
    )  # fmt: skip
    return rows[:count], depths[:count], indices[:count]


def test_surfaces_equal_those_of_numpy() -> None:
    depth_m = bumpy_depth_m()
    found = surfaces(depth_m)
    np.testing.assert_allclose(found, reference.surfaces(depth_m, grid()[0], *STEP), atol=1e-14)
    share = found[:, 3:].any(axis=1).mean()
    assert 0.5 < share < 0.9  # Holes, the step and the rim have no normal.


@pytest.mark.parametrize("stride", [1, 3])
def test_comparison_equals_that_of_numpy(stride: int) -> None:
    there = here = surfaces(bumpy_depth_m())
    rows, depths, indices = compare(there, here, T, stride)
    expected = reference.compare(there, here, grid()[1], T, INTRINSICS, BLOCK, W, stride, 0.08)
    assert len(rows) > 300 / stride**2
    assert np.array_equal(indices, expected[2])
    np.testing.assert_allclose(rows, expected[0], atol=1e-12)
    np.testing.assert_allclose(depths, expected[1], atol=1e-14)


def test_pose_derivatives_equal_finite_differences() -> None:
    there = here = surfaces(bumpy_depth_m())
    rows, _, indices = compare(there, here, T)
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        moved, _, same = compare(there, here, se3.exp(step) @ T)
        both, i, j = np.intersect1d(indices[:, 0], same[:, 0], return_indices=True)
        i, j = i[indices[i, 1] == same[j, 1]], j[indices[i, 1] == same[j, 1]]
        assert len(i) > 0.9 * len(both)
        difference = (moved[j, 9] - rows[i, 9]) / 1e-6
        np.testing.assert_allclose(difference, rows[i, 3 + axis], atol=1e-4)


def test_bias_derivatives_equal_finite_differences_with_fixed_normals() -> None:
    depth_m, (rays, basis) = bumpy_depth_m(), grid()
    there = surfaces(depth_m)
    rows, _, indices = compare(there, there, T)
    for axis in range(3):
        bias = 1e-6 * basis[:, axis].reshape(H, W)
        moved = there.copy()
        moved[:, :3] = rays * unbiased_depth(depth_m, bias).reshape(-1, 1)
        changed, _, same = compare(moved, moved, T)
        i = np.flatnonzero(np.isin(indices[:, 0], same[:, 0]))
        j = np.searchsorted(same[:, 0], indices[i, 0])
        i, j = i[indices[i, 1] == same[j, 1]], j[indices[i, 1] == same[j, 1]]
        assert len(i) > 300
        difference = (changed[j, 9] - rows[i, 9]) / 1e-6
        np.testing.assert_allclose(difference, rows[i, axis], atol=1e-4)


def test_wrong_shapes_are_rejected() -> None:
    with pytest.raises(ValueError, match="rays must have shape"):
        _surfaces.surfaces(bumpy_depth_m(), np.zeros((3, 3)), *STEP, np.zeros((H * W, 6)))
    there = surfaces(bumpy_depth_m())
    with pytest.raises(ValueError, match="a row for each compared block"):
        _surfaces.compare(
            there, there, grid()[1], T, INTRINSICS, BLOCK, W, 1, 0.08,
            np.empty((10, 10)), np.empty(10), np.empty((10, 2), np.int64),
        )  # fmt: skip
