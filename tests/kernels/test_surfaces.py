"""Comparison of the surfaces of two views, with NumPy and with finite differences."""

from collections.abc import Callable
from pathlib import Path

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
VELOCITIES = np.array([0.4, -0.6, 0.2, 0.3, 0.1, -0.2]), np.array([-0.3, 0.5, 0.1, -0.2, 0.2, 0.1])
TIMES_S = 0.025, 0.015  # Readout and delay of depth.
STILL = np.zeros(6), np.zeros(6)


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
    there: np.ndarray,
    here: np.ndarray,
    T_here_there: np.ndarray,
    stride: int = 1,
    velocities: tuple[np.ndarray, np.ndarray] = STILL,
    times_s: tuple[float, float] = (0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, depths = np.empty((H * W, 13)), np.empty(H * W)
    indices = np.empty((H * W, 2), np.int64)
    count = _surfaces.compare(
        there, here, grid()[1], T_here_there, *velocities, times_s, INTRINSICS, BLOCK, W, stride,
        0.08, rows, depths, indices,
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
    rows, depths, indices = compare(there, here, T, stride, VELOCITIES, TIMES_S)
    expected = reference.compare(
        there, here, grid()[1], T, VELOCITIES, TIMES_S, INTRINSICS, BLOCK, W, stride, 0.08
    )
    assert len(rows) > 300 / stride**2
    assert np.array_equal(indices, expected[2])
    np.testing.assert_allclose(rows, expected[0], atol=1e-12)
    np.testing.assert_allclose(depths, expected[1], atol=1e-14)


def plane_depths_m() -> tuple[np.ndarray, np.ndarray]:
    """Return the depth [H, W] of one plane in two cameras, whose relative pose is T."""
    rays = grid()[0]
    normal, distance = np.array([0.3, -0.2, 1.0]), 2.0
    moved = T[:3, :3] @ normal
    here = (distance + moved @ T[:3, 3]) / (rays @ moved)
    return (distance / (rays @ normal)).reshape(H, W), here.reshape(H, W)


def test_derivatives_equal_finite_differences_where_both_views_agree() -> None:
    depths, (rays, basis) = plane_depths_m(), grid()
    there, here = surfaces(depths[0]), surfaces(depths[1])
    rows, _, indices = compare(there, here, T)
    assert len(rows) > 500
    np.testing.assert_allclose(rows[:, 12], 0, atol=1e-12)

    def difference(changed: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Return rows that were compared in both cases, and the change of their residuals."""
        _, i, j = np.intersect1d(indices[:, 0], changed[2][:, 0], return_indices=True)
        is_same = indices[i, 1] == changed[2][j, 1]
        assert is_same.sum() > 0.9 * len(rows)
        i, j = i[is_same], j[is_same]
        return i, (changed[0][j, 12] - rows[i, 12]) / 1e-6

    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        i, change = difference(compare(there, here, se3.exp(step) @ T))
        np.testing.assert_allclose(change, rows[i, 6 + axis], atol=1e-4)
    for axis in range(3):
        bias = 1e-6 * basis[:, axis].reshape(H, W)
        biased = there.copy(), here.copy()
        for surface, depth_m in zip(biased, depths, strict=True):
            surface[:, :3] = rays * unbiased_depth(depth_m, bias).reshape(-1, 1)
        i, change = difference(compare(*biased, T))
        np.testing.assert_allclose(change, rows[i, axis], atol=1e-4)
    at_once = compare(there, here, T, velocities=VELOCITIES)
    np.testing.assert_array_equal(at_once[0][:, 12], rows[:, 12])
    for axis, times_s in enumerate([(1e-6, 0.0), (0.0, 1e-6)]):
        i, change = difference(compare(there, here, T, velocities=VELOCITIES, times_s=times_s))
        np.testing.assert_allclose(change, at_once[0][i, 4 + axis], atol=1e-4)


def test_noise_of_the_depth_does_not_bias_the_gradient() -> None:
    # The camera rolls by 90 degrees in front of a wall, so that the basis of a point changes.
    roll, rng = se3.exp(np.array([0, 0, np.pi / 2, 0, 0, 0])), np.random.default_rng(0)
    gradients, one_sided = [], []
    for _ in range(200):
        there, here = (surfaces(2.0 + 0.01 * rng.normal(size=(H, W))) for _ in range(2))
        rows, _, indices = compare(there, here, roll)
        gradients.append(np.mean(rows[:, 0] * rows[:, 12]))
        # The derivative at the measurement itself, for comparison.
        a, b = indices.T
        basis, n = grid()[1][:, 0], here[b, 3:]
        slope_here = np.sum(here[b, :3] * n, axis=1) * here[b, 2]
        slope_there = np.sum(there[a, :3] @ roll[:3, :3].T * n, axis=1) * there[a, 2]
        one_sided.append(np.mean((slope_here * basis[b] - slope_there * basis[a]) * rows[:, 12]))

    def error_in_sigmas(samples: list[float]) -> float:
        return abs(np.mean(samples)) / (np.std(samples) / np.sqrt(len(samples)))

    assert error_in_sigmas(gradients) < 3
    assert error_in_sigmas(one_sided) > 6


def test_wrong_shapes_are_rejected() -> None:
    with pytest.raises(ValueError, match="rays must have shape"):
        _surfaces.surfaces(bumpy_depth_m(), np.zeros((3, 3)), *STEP, np.zeros((H * W, 6)))
    there = surfaces(bumpy_depth_m())
    with pytest.raises(ValueError, match="a row for each compared block"):
        _surfaces.compare(
            there, there, grid()[1], T, *STILL, TIMES_S, INTRINSICS, BLOCK, W, 1, 0.08,
            np.empty((10, 10)), np.empty(10), np.empty((10, 2), np.int64),
        )  # fmt: skip


def random_features() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels there [M, 2], their depth [M] and pixels here [M, 2], also at the rim."""
    rng = np.random.default_rng(1)
    pixels = rng.uniform(-0.4, (CAMERA.width - 0.6, CAMERA.height - 0.6), (200, 2))
    return pixels, rng.uniform(1.0, 4.0, 200), pixels + rng.normal(size=(200, 2))


def test_comparison_of_features_equals_that_of_numpy() -> None:
    there, (pixels, depth_m, pixels_here) = surfaces(bumpy_depth_m()), random_features()
    bias, times_s, size = (0.01, -0.02, 0.005), (0.02, *TIMES_S), (CAMERA.width, CAMERA.height)
    rows = np.empty((2 * len(pixels), 13))
    given = there, pixels, depth_m, pixels_here, T
    _surfaces.compare_features(*given, *VELOCITIES, bias, times_s, INTRINSICS, size, BLOCK, rows)
    expected = reference.compare_features(
        *given, VELOCITIES, np.array(bias), times_s, INTRINSICS, size, BLOCK
    )
    np.testing.assert_allclose(rows, expected, rtol=1e-10, atol=1e-10)


def test_reprojection_equals_that_of_numpy() -> None:
    pixels, depth_m, _ = random_features()
    points = CAMERA.points_at(pixels[:, 0], pixels[:, 1], depth_m)
    points[0, 2] = -T[2, 3]  # Near the plane of the camera center.
    found = np.empty((200, 2)), np.empty((200, 2, 6)), np.empty((200, 3))
    _surfaces.reproject(points, pixels, T, INTRINSICS, *found)
    for values, expected in zip(
        found, reference.reproject(points, pixels, T, INTRINSICS), strict=True
    ):
        np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-10)


def test_features_of_wrong_shapes_are_rejected() -> None:
    pixels, depth_m, pixels_here = random_features()
    rows, size = np.empty((2 * len(pixels), 13)), (CAMERA.width, CAMERA.height)
    rest = T, *STILL, (0.0,) * 3, (0.0,) * 3, INTRINSICS, size, BLOCK, rows
    there = surfaces(bumpy_depth_m())
    with pytest.raises(ValueError, match="there must have shape"):
        _surfaces.compare_features(there[1:], pixels, depth_m, pixels_here, *rest)
    with pytest.raises(ValueError, match="pixels_here must have shape"):
        _surfaces.compare_features(there, pixels, depth_m, pixels_here[1:], *rest)
    outputs = np.empty((200, 2)), np.empty((200, 2, 6)), np.empty((200, 2))
    with pytest.raises(ValueError, match="moved must have shape"):
        _surfaces.reproject(np.ones((200, 3)), pixels, T, INTRINSICS, *outputs)


# Program for one instruction set, which runs the comparisons with NumPy of this file.
COMPARE_ALL = f"""
sys.path.insert(0, {str(Path(__file__).parents[2])!r})
from tests.kernels import test_surfaces as test
test.test_surfaces_equal_those_of_numpy()
test.test_comparison_equals_that_of_numpy(1)
test.test_comparison_of_features_equals_that_of_numpy()
test.test_reprojection_equals_that_of_numpy()
"""


def test_each_instruction_set_gives_the_results_of_numpy(with_isa: Callable) -> None:
    with_isa(COMPARE_ALL, {})
