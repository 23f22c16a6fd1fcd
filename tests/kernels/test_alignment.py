"""Tests of the alignment kernels: values against NumPy, and rejected arguments."""

import os
import subprocess
import sys

import numpy as np
import pytest

from ldo_service.kernels import _align

INTRINSICS = (60.0, 55.0, 31.0, 23.5)
NOISE = (0.0012, 0.0019, 0.4)
SCALARS = {
    "intrinsics": INTRINSICS,
    "gain": 1.0,
    "bias": 0.0,
    "intensity_sigma": 8.0,
    "depth_noise_scale": 1.0,
    "noise": NOISE,
    "gate": 0.1,
    "occlusion": 0.08,
}


def problem() -> dict:
    """Return the arguments of a slanted, textured plane and a camera that moved slightly."""
    v, u = np.mgrid[:48, :64].astype(np.float32)
    depth_m = (2.0 + 0.004 * u + 0.006 * v).astype(np.float32)
    image = (120 + 60 * np.sin(0.3 * u) * np.cos(0.2 * v)).astype(np.float32)
    texels = _align.pack(image, depth_m, 30.0)
    points = _align.points(texels, _align.normals(depth_m, INTRINSICS, 2), INTRINSICS)
    T = np.eye(4)
    T[:3, 3] = [0.01, -0.005, 0.02]
    return {"points": points, "texels": texels, "T_camera_reference": T, **SCALARS}


def test_halving_averages_what_lies_near_the_nearest() -> None:
    depth_m = np.random.default_rng(0).choice([0.0, 1.0, 1.02, 1.5], (21, 33)).astype(np.float32)
    blocks = depth_m[:20, :32].reshape(10, 2, 16, 2).swapaxes(1, 2).reshape(10, 16, 4)
    nearest = np.where(blocks > 0, blocks, np.inf).min(axis=-1, keepdims=True)
    near = (blocks > 0) & (blocks <= 1.03 * nearest)
    expected = np.where(near, blocks, 0).sum(axis=-1) / np.maximum(near.sum(axis=-1), 1)
    np.testing.assert_allclose(_align.halve(depth_m, 0.03), expected, rtol=1e-6)
    enough = np.where(near.sum(axis=-1) >= 3, expected, 0)
    np.testing.assert_allclose(_align.halve(depth_m, 0.03, 3), enough, rtol=1e-6)


@pytest.mark.parametrize("least", [1, 4])
def test_halved_gray_image_has_no_clipped_pixels(least: int) -> None:
    gray = np.random.default_rng(0).choice([0, 9, 250, 249, 251], (21, 33)).astype(np.uint8)
    exposed = np.where(gray < 250, gray, 0).astype(np.float32)
    expected = _align.halve(exposed, 1e3, least)
    assert 0 < np.count_nonzero(expected) < expected.size
    np.testing.assert_array_equal(_align.halve_gray(gray, 250, least), expected)


def test_texels_hold_intensity_central_differences_and_depth() -> None:
    rng = np.random.default_rng(1)
    image, depth_m = rng.uniform(0, 255, (2, 11, 14)).astype(np.float32)
    texels = _align.pack(image, depth_m, 100.0)
    np.testing.assert_array_equal(texels[..., 0], image)
    np.testing.assert_array_equal(texels[..., 3], np.where(depth_m <= 100, depth_m, 0))
    inner = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(texels[..., 1][inner], (image[1:-1, 2:] - image[1:-1, :-2]) / 2)
    np.testing.assert_allclose(texels[..., 2][inner], (image[2:, 1:-1] - image[:-2, 1:-1]) / 2)
    assert not texels[0, :, 1:3].any()
    assert not texels[:, -1, 1:3].any()


@pytest.mark.parametrize("radius", [1, 3])
def test_normals_of_a_plane_are_its_normal(radius: int) -> None:
    normal = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0])
    fx, fy, cx, cy = INTRINSICS
    v, u = np.mgrid[:48, :64]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u, float)], axis=-1)
    depth_m = (-2.0 / (rays @ normal)).astype(np.float32)
    normals = _align.normals(depth_m, INTRINSICS, radius)
    inner = normals[radius:-radius, radius:-radius]
    np.testing.assert_allclose(inner, np.broadcast_to(normal, inner.shape), atol=2e-4)
    assert not normals[:radius].any()


def test_normals_stop_at_an_edge() -> None:
    depth_m = np.ones((10, 10), np.float32)
    depth_m[:, 5:] = 2.0
    normals = _align.normals(depth_m, INTRINSICS, 1)
    assert normals[1:-1, 3].any(axis=-1).all()
    assert not normals[:, 4:6].any()


def test_points_are_the_measured_pixels_back_projected() -> None:
    given = problem()
    fx, fy, cx, cy = INTRINSICS
    given["texels"][10:20, 10:30, 3] = 0
    points = _align.points(given["texels"], np.zeros((48, 64, 3), np.float32), INTRINSICS)
    assert points.shape == (7, 46 * 62 - 200)
    x, y, z = points[:3]
    column, row = np.rint(fx * x / z + cx).astype(int), np.rint(fy * y / z + cy).astype(int)
    np.testing.assert_array_equal(z, given["texels"][row, column, 3])


def test_equations_of_no_points_are_zero() -> None:
    hessian, gradient, counts, _ = _align.normal_equations(
        **{**problem(), "points": np.zeros((7, 0), np.float32)}
    )
    assert not hessian.any()
    assert not gradient.any()
    assert counts == (0.0,) * 7


def test_equations_do_not_depend_on_how_points_fill_the_last_block() -> None:
    given = problem()
    points = given["points"]
    whole, _, counts, _ = _align.normal_equations(**given)
    parts = [
        _align.normal_equations(**{**given, "points": np.ascontiguousarray(part)})
        for part in (points[:, :301], points[:, 301:])
    ]
    np.testing.assert_allclose(parts[0][0] + parts[1][0], whole, rtol=1e-4, atol=1e-2)
    assert parts[0][2][0] + parts[1][2][0] == counts[0]


def test_equations_are_symmetric_and_bitwise_reproducible() -> None:
    first, second = (_align.normal_equations(**problem()) for _ in range(2))
    np.testing.assert_array_equal(first[0], first[0].T)
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1].tobytes() == second[1].tobytes()


BLOCK = 256  # Points whose values the kernel holds at a time.


def test_block_of_points_outside_the_image_changes_no_bit() -> None:
    given = problem()
    points = given["points"]
    behind = -points[:, :BLOCK]
    moved = np.concatenate([points[:, :BLOCK], behind, points[:, BLOCK:]], axis=1)
    cells = np.zeros(points.shape[1], np.uint8)
    there = np.concatenate([cells[:BLOCK], np.ones(BLOCK, np.uint8), cells[BLOCK:]])
    wanted = _align.normal_equations(**given, cells=cells)
    found = _align.normal_equations(**{**given, "points": moved}, cells=there)
    assert wanted[2][0] > BLOCK
    assert found[2] == wanted[2]
    for a, b in zip((*found[:2], found[3]), (*wanted[:2], wanted[3]), strict=True):
        assert a.tobytes() == b.tobytes()


STRIP = 16  # Consecutive points that are added to the cell of their middle point.


def test_gradients_by_cell_are_those_of_the_strips_in_the_cell() -> None:
    given = problem()
    points = given["points"]
    count = points.shape[1]
    assert count % STRIP  # The last strip is shorter, and its middle may lie beyond the end.
    cells = np.random.default_rng(8).integers(0, 5, count).astype(np.uint8)
    middles = np.minimum(np.arange(count) // STRIP * STRIP + STRIP // 2, count - 1)
    *_, by_cell = _align.normal_equations(**given, cells=cells)
    assert by_cell.shape == (64, 2, 8)
    assert not by_cell[5:].any()
    without_gray = given["texels"].copy()
    without_gray[..., 0] = 0
    for cell in range(5):
        given["points"] = np.ascontiguousarray(points[:, cells[middles] == cell])
        _, both, _, _ = _align.normal_equations(**given)
        _, geometric, _, _ = _align.normal_equations(**{**given, "texels": without_gray})
        np.testing.assert_allclose(by_cell[cell].sum(axis=0), both, rtol=1e-4, atol=1e-2)
        np.testing.assert_allclose(by_cell[cell, 1], geometric, rtol=1e-4, atol=1e-2)


def test_cells_do_not_change_the_equations() -> None:
    given = problem()
    cells = np.zeros(given["points"].shape[1], np.uint8)
    without, with_cells = (_align.normal_equations(**given, cells=c) for c in (None, cells))
    assert without[3].size == 0
    for a, b in zip(without[:2], with_cells[:2], strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("size", [(2, 2), (2, 9), (3, 3)])
def test_smallest_images_are_handled(size: tuple[int, int]) -> None:
    texels = _align.pack(np.ones(size, np.float32), np.ones(size, np.float32), 9.0)
    hessian, *_ = _align.normal_equations(**{**problem(), "texels": texels})
    assert np.isfinite(hessian).all()


def test_not_a_number_in_points_is_not_seen() -> None:
    given = problem()
    given["points"][0] = np.nan
    hessian, _, counts, _ = _align.normal_equations(**given)
    assert counts[0] == 0
    assert hessian.shape == (8, 8)


IMAGE = np.ones((8, 8), np.float32)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: _align.halve(np.ones((1, 8), np.float32), 0.03), "2x2"),
        (lambda: _align.halve(IMAGE, float("nan")), "tolerance"),
        (lambda: _align.halve(IMAGE, 0.03, 5), "least"),
        (lambda: _align.pack(IMAGE, np.ones((8, 9), np.float32), 1.0), "differ in size"),
        (lambda: _align.pack(IMAGE, IMAGE, 0.0), "max_depth_m"),
        (lambda: _align.normals(IMAGE, INTRINSICS, 0), "radius"),
        (lambda: _align.normals(IMAGE, (0.0, 1.0, 0.0, 0.0), 1), "intrinsics"),
        (lambda: _align.normals(IMAGE, (1.0, 1.0, float("nan"), 0.0), 1), "intrinsics"),
        (
            lambda: _align.points(
                np.ones((8, 8, 3), np.float32), np.ones((8, 8, 3), np.float32), INTRINSICS
            ),
            "texels",
        ),
        (
            lambda: _align.points(
                np.ones((8, 8, 4), np.float32), np.ones((8, 8, 2), np.float32), INTRINSICS
            ),
            "normals",
        ),
    ],
)
def test_bad_images_are_refused(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"points": np.zeros((6, 5), np.float32)}, "points"),
        ({"texels": np.zeros((8, 8, 3), np.float32)}, "texels"),
        ({"T_camera_reference": 2 * np.eye(4)}, "rigid"),
        ({"T_camera_reference": np.full((4, 4), np.nan)}, "rigid"),
        ({"T_camera_reference": np.diag([1.0, 1.0, -1.0, 1.0])}, "rigid"),
        ({"intensity_sigma": 0.0}, "intensity_sigma"),
        ({"depth_noise_scale": -1.0}, "depth_noise_scale"),
        ({"gain": float("inf")}, "gain"),
        ({"bias": float("nan")}, "bias"),
        ({"noise": (0.0, 1.0, 1.0)}, "floor"),
        ({"noise": (0.1, -1.0, 1.0)}, "growth"),
        ({"gate": 0.0}, "gate"),
        ({"occlusion": float("nan")}, "occlusion"),
        ({"cells": np.zeros(3, np.uint8)}, "for each point"),
        ({"cells": np.full(problem()["points"].shape[1], 64, np.uint8)}, "below 64"),
    ],
)
def test_bad_equations_are_refused(changed: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _align.normal_equations(**{**problem(), **changed})


@pytest.mark.parametrize(
    "image", [np.ones((8, 8)), np.ones((8, 16), np.float32)[:, ::2], np.ones(8, np.float32)]
)
def test_arrays_of_another_layout_are_not_converted_in_silence(image: np.ndarray) -> None:
    with pytest.raises(TypeError):
        _align.halve(image, 0.03)


def run_with(isa: str, program: str) -> subprocess.CompletedProcess[str]:
    """Run a Python program with a forced instruction set."""
    return subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "LDO_ISA": isa},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("isa", ["baseline", "avx2"])
def test_each_instruction_set_gives_the_same_to_rounding(isa: str) -> None:
    program = (
        "import sys, importlib.util as u, numpy as np\n"
        f"s = u.spec_from_file_location('test_align', {__file__!r})\n"
        "m = u.module_from_spec(s); s.loader.exec_module(m)\n"
        "H, g, c, _ = m._align.normal_equations(**m.problem())\n"
        "print(m._align.isa, *H.ravel(), *g, *c)"
    )
    done = run_with(isa, program)
    if "no such instructions" in done.stderr:
        pytest.skip(f"this machine has no {isa}")
    assert done.returncode == 0, done.stderr
    used, *numbers = done.stdout.split()
    assert used == isa
    hessian, gradient, counts, _ = _align.normal_equations(**problem())
    expected = np.array([*hessian.ravel(), *gradient, *counts])
    scale = np.abs(hessian).max() * 1e-5
    np.testing.assert_allclose(np.array(numbers, float), expected, rtol=1e-3, atol=scale)


def test_unknown_instruction_set_is_an_import_error_not_a_crash() -> None:
    done = run_with("mmx", "import ldo_service.kernels._align")
    assert done.returncode == 1
    assert "LDO_ISA=mmx" in done.stderr
