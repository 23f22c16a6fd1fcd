"""Tests of the rasterizer against the reference, with every instruction set of this machine."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ldo_service.gaussians import Rendering, render
from ldo_service.geometry import Camera, se3
from ldo_service.kernels import _rasterize, isa
from tests.reference.render import render_reference

from .scenes import camera_of, gaussians

IMAGES = ("color", "weighted_depth_m", "median_depth_m", "opacity")
EYE = np.eye(4, dtype=np.float32)[:3]

RENDER_ALL = """
import sys, numpy as np
from ldo_service.kernels import _rasterize
scenes = np.load(sys.argv[1])
images = {}
for name in {key.split("/")[0] for key in scenes.files}:
    rows, T, camera = (scenes[f"{name}/{part}"] for part in ("rows", "T", "camera"))
    fx, fy, cx, cy, width, height = camera
    memory = _rasterize.Pass()
    size = int(width), int(height)
    out = _rasterize.rasterize(rows, T, fx, fy, cx, cy, *size, 2, memory)
    images |= {f"{name}/{k}": image for k, image in enumerate(out)}
    V = memory.visible
    indices, weights = np.zeros(V, np.uint32), np.zeros(V, np.float32)
    top = np.zeros(size[::-1], np.int32)
    _rasterize.contributions(memory, indices, weights, top, 2)
    images |= {f"{name}/indices": indices, f"{name}/weights": weights, f"{name}/top": top}
np.savez(sys.argv[2], isa=_rasterize.isa(), **images)
"""


def ties() -> np.ndarray:
    """Return rows at only three different depths."""
    rows = gaussians(120, 2)
    rows[:, 2] = np.random.default_rng(2).integers(1, 4, len(rows))
    return rows


def turned() -> np.ndarray:
    """Return the transform of a rotated and translated camera."""
    return se3.exp(np.array([0.2, -0.3, 0.1, 0.1, -0.2, 0.3]))


SCENES = {
    "many": (gaussians(150, 0), camera_of(40, 32), np.eye(4)),
    "turned_camera": (gaussians(150, 1), camera_of(40, 32), turned()),
    "depth_ties": (ties(), camera_of(40, 32), np.eye(4)),
    "straddling_the_camera": (gaussians(150, 3, depth_m=(-2.0, 2.0)), camera_of(32, 32), np.eye(4)),
    "all_behind": (gaussians(20, 4, depth_m=(-3.0, -1.0)), camera_of(16, 16), np.eye(4)),
    "one_pixel": (gaussians(60, 5), camera_of(1, 1), np.eye(4)),
    "odd_size": (gaussians(150, 6), camera_of(17, 33), np.eye(4)),
    "nothing": (gaussians(0, 7), camera_of(20, 20), np.eye(4)),
    "deep_stack": (gaussians(900, 8), camera_of(24, 24), np.eye(4)),
}
SETS = ("baseline", "avx2", "avx512")


@pytest.fixture(scope="module")
def by_reference() -> dict[str, Rendering]:
    """Return the rendering of every scene, computed by the reference implementation."""
    return {
        name: render_reference(rows.astype(float), camera, T.astype(np.float32).astype(float))
        for name, (rows, camera, T) in SCENES.items()
    }


@pytest.fixture(scope="module", params=SETS)
def by_kernel(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Return the images and contributions of every scene by the kernel."""
    folder = tmp_path_factory.mktemp(request.param)
    arrays = {}
    for name, (rows, c, T) in SCENES.items():
        arrays[f"{name}/rows"], arrays[f"{name}/T"] = rows, T[:3].astype(np.float32)
        arrays[f"{name}/camera"] = np.array([c.fx, c.fy, c.cx, c.cy, c.width, c.height])
    np.savez(folder / "scenes.npz", **arrays)
    done = run_with(request.param, RENDER_ALL, folder / "scenes.npz", folder / "images.npz")
    if "no such instructions" in done.stderr:
        pytest.skip(f"this machine has no {request.param}")
    assert done.returncode == 0, done.stderr
    images = dict(np.load(folder / "images.npz"))
    assert images["isa"] == request.param
    return images


def run_with(forced: str, program: str, *arguments: Path) -> subprocess.CompletedProcess:
    """Run a Python program with a forced instruction set."""
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        env=os.environ | {"LDO_ISA": forced},
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize("scene", SCENES)
def test_kernel_agrees_with_its_plain_twin(scene: str, by_kernel: dict, by_reference: dict) -> None:
    expected = by_reference[scene]
    # The early stop may drop this much at z = 4 m, and rounding adds to it.
    tolerance_m = 4.0 * 2e-4
    for k, (name, atol) in enumerate(zip(IMAGES, (2e-4, tolerance_m, 0, 2e-4), strict=True)):
        actual, wanted = by_kernel[f"{scene}/{k}"], getattr(expected, name)
        assert actual.shape == wanted.shape
        if name != "median_depth_m":
            np.testing.assert_allclose(actual, wanted, atol=atol, err_msg=name)
        else:  # The median has a step at T = 1/2, where the last bit decides.
            assert np.mean(np.abs(actual - wanted) > 1e-5) < 0.003


@pytest.mark.parametrize("scene", SCENES)
def test_contributions_agree_with_the_plain_twin(
    scene: str, by_kernel: dict, by_reference: dict
) -> None:
    expected, n = by_reference[scene].contributions, len(SCENES[scene][0])
    indices, weights, top = (by_kernel[f"{scene}/{k}"] for k in ("indices", "weights", "top"))
    assert np.all(np.diff(indices.astype(int)) > 0)
    by_row, wanted = np.zeros(n), np.zeros(n)
    by_row[indices], wanted[expected.indices] = weights, expected.weights
    pixels = top.size
    np.testing.assert_allclose(by_row, wanted, atol=2e-4 * pixels**0.5, rtol=1e-5)
    assert set(indices[weights > 0]) >= set(np.flatnonzero(wanted > 0.03 * pixels))
    # The top differs where two weights are equal up to rounding.
    assert np.mean(top != expected.top) < 0.003


def test_nearer_of_two_equal_weights_is_on_top() -> None:
    rows = np.repeat(gaussians(1, 0), 2, axis=0)
    rows[:, :3], rows[:, 3:6] = (0, 0, 1), 9  # Wide enough that alpha is the opacity.
    rows[:, 10] = [0, 20]  # One half, then the rest.
    rows[1, 2] = 2
    seen = render(rows, Camera(9, 9, 20, 20, 4, 4), np.eye(4), contributions=True).contributions
    assert seen is not None
    np.testing.assert_array_equal(seen.indices, [0, 1])
    np.testing.assert_allclose(seen.weights, [40.5, 0.99 * 40.5], rtol=1e-3)
    assert (seen.top == 0).all()


def test_contributions_follow_culling_and_leave_out_who_is_hidden() -> None:
    rows = np.concatenate([gaussians(5_000, 1), gaussians(5_000, 2, depth_m=(-3, -1))])
    rows[:, 10] += 4
    camera, bounds = camera_of(60, 50), _rasterize.Bounds()
    seen = [
        render(rows, camera, np.eye(4), contributions=True, **options).contributions
        for options in ({}, {"bounds": bounds}, {"bounds": bounds, "threads": 3})
    ]
    for other in seen[1:]:
        for name in ("indices", "weights", "top"):
            assert getattr(seen[0], name).tobytes() == getattr(other, name).tobytes()
    assert 100 < len(seen[0].indices) < 4_000
    assert set(np.unique(seen[0].top)) <= {-1, *seen[0].indices.tolist()}
    assert seen[0].weights.min() > 0


def test_scenes_cover_what_they_name(by_reference: dict) -> None:
    assert by_reference["many"].opacity.mean() > 0.3
    assert np.mean(by_reference["deep_stack"].opacity > 0.9999) > 0.3
    assert by_reference["all_behind"].opacity.max() == 0
    z = SCENES["depth_ties"][0][:, 2]
    assert len(np.unique(z)) < len(z) / 10


def test_equal_depths_are_blended_by_index() -> None:
    rows = np.repeat(gaussians(1, 0), 2, axis=0)
    rows[:, :3], rows[:, 10] = (0, 0, 1), 2
    rows[:, 11:14] = [[1, 0, 0], [0, 1, 0]]
    color = _rasterize.rasterize(rows, EYE, 20, 20, 4, 4, 9, 9)[0]
    assert color[4, 4, 0] > 2 * color[4, 4, 1] > 0
    assert color[4, 4, 1] > color[4, 4, 0] * 0.05


def test_depths_that_differ_in_the_last_bit_are_blended_in_order() -> None:
    rows = np.repeat(gaussians(1, 0), 3, axis=0)
    rows[:, :2], rows[:, 10] = 0, 2
    rows[:, 2] = [np.nextafter(np.float32(1), np.float32(2)), 1, 900]
    rows[:, 11:14] = np.eye(3)
    color = _rasterize.rasterize(rows, EYE, 20, 20, 4, 4, 9, 9)[0]
    assert color[4, 4, 1] > color[4, 4, 0]


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_number_of_threads_changes_no_bit(threads: int) -> None:
    rows = gaussians(30_000, 9)
    one, many = (
        _rasterize.rasterize(rows, EYE, 200, 200, 100, 80, 213, 157, n) for n in (1, threads)
    )
    for a, b in zip(one, many, strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_rows_that_are_not_finite_are_not_drawn(value: float) -> None:
    rows = gaussians(64, 10)
    broken = rows.copy()
    broken[np.arange(14), np.arange(14)] = value
    drawn = _rasterize.rasterize(broken, EYE, 20, 20, 10, 10, 20, 20)
    wanted = _rasterize.rasterize(rows[14:], EYE, 20, 20, 10, 10, 20, 20)
    for a, b in zip(drawn, wanted, strict=True):
        np.testing.assert_array_equal(a, b)


def test_python_picks_the_instruction_set_that_was_forced() -> None:
    assert isa() in SETS
    done = run_with("sse9", "import ldo_service.kernels")
    assert "must be avx512, avx2 or baseline" in done.stderr
    assert "ConfigError" in done.stderr
    assert done.returncode == 1


GOOD = {"fx": 20.0, "fy": 20.0, "cx": 4.0, "cy": 4.0, "width": 9, "height": 9, "threads": 1}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": np.zeros((3, 15), np.float32)}, r"\[N, 16\]"),
        ({"rows": np.zeros(16, np.float32)}, r"\[N, 16\]"),
        ({"rows": np.zeros((3, 16))}, "float32"),
        ({"rows": np.zeros((6, 16), np.float32)[::2]}, "contiguous"),
        ({"rows": np.zeros((16, 16), np.float32, order="F")}, "contiguous"),
        ({"T_camera_map": np.eye(4, dtype=np.float32)}, r"\[3, 4\]"),
        ({"T_camera_map": np.full((3, 4), np.nan, np.float32)}, "NaN"),
        ({"fx": np.nan}, "NaN"),
        ({"fx": 0.0}, "positive"),
        ({"width": 0}, "width"),
        ({"height": 40_000}, "height"),
        ({"threads": 0}, "threads"),
    ],
)
def test_bad_arguments_raise_value_error(change: dict, message: str) -> None:
    arguments = {"rows": gaussians(3, 0), "T_camera_map": EYE} | GOOD
    _rasterize.rasterize(**arguments)
    with pytest.raises(ValueError, match=message):
        _rasterize.rasterize(**arguments | change)
