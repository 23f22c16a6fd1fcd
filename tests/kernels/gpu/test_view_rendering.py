"""Median depth and contributions by the GPU kernels, and planted errors that the tests detect."""

import importlib.util
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from ldo_service.gaussians.renderer import Rendering, render
from ldo_service.kernels.gpu.arrays import Arrays, HostArray, HostArrays
from tests.kernels.gpu import agreement
from tests.kernels.gpu.agreement import check, peak
from tests.kernels.gpu.scenes import (
    ARRAYS,
    SCENES,
    SEAM,
    Scene,
    camera_of,
    contributions,
    plane_rendering,
    view_rendering,
)
from tests.reference.render import render_reference

ALL = {**SCENES, "batch seam": SEAM}


def equal_weights() -> np.ndarray:
    """Return two rows with equal blending weights; the second one is farther away."""
    rows = np.zeros((2, 16), np.float32)
    rows[:, 2], rows[:, 3:6], rows[:, 6] = (1, 2), 9, 1
    rows[:, 10] = -np.log(2) - 14e-6, -278e-7  # Alphas of a third and a half, up to rounding.
    return rows


class OtherwiseFilledArrays(HostArrays):
    """Arrays whose undefined values are 3."""

    def empty(self, shape: tuple[int, ...], dtype: type) -> HostArray:
        return HostArray(np.full(shape, 3, dtype))


class Shown:
    """Median depth [H, W], weights [N] and top row [H, W] of a scene, by the GPU kernels."""

    def __init__(self, scene: Scene, arrays: Arrays = ARRAYS) -> None:
        camera, n = scene.camera, len(scene.rows)
        rendering = plane_rendering.render(
            arrays, arrays.upload(scene.rows), n, scene.view, camera.width, camera.height
        )
        found = view_rendering.contributions_to(arrays, rendering)
        self.median_depth_m = arrays.download(view_rendering.median_depth(arrays, rendering))
        self.top, self.weights = arrays.download(found.top), np.zeros(n, np.float32)
        self.weights[arrays.download(rendering.lists.visible)] = arrays.download(found.weights)


@cache
def of_kernel(name: str) -> Shown:
    return Shown(ALL[name])


def weights_of(rendering: Rendering, n: int) -> np.ndarray:
    found, weights = rendering.contributions, np.zeros(n)
    assert found is not None
    weights[found.indices] = found.weights
    return weights


@pytest.mark.parametrize("name", [name for name in ALL if ALL[name].binning == 1])
def test_view_equals_that_of_the_cpu(name: str) -> None:
    scene, got = ALL[name], of_kernel(name)
    wanted = render(scene.rows, scene.camera, scene.T_camera_map, contributions=True)
    assert wanted.contributions is not None
    # The order of sums does not affect these values, so they are bitwise equal.
    np.testing.assert_array_equal(got.median_depth_m, wanted.median_depth_m)
    np.testing.assert_array_equal(got.top, wanted.contributions.top)
    weights = weights_of(wanted, len(scene.rows))
    np.testing.assert_array_equal(got.weights > 0, weights > 0)
    check("weights of Gaussians to C++", peak(got.weights, weights), name)


@pytest.mark.parametrize("name", ALL)
def test_view_equals_the_reference(name: str) -> None:
    """The reference does not stop early, so the limit is wider for scenes with dark pixels."""
    scene, got = ALL[name], of_kernel(name)
    wanted = render_reference(
        scene.drawable_rows(), scene.camera, scene.T_rounded, binning=scene.binning
    )
    assert wanted.contributions is not None
    np.testing.assert_allclose(got.median_depth_m, wanted.median_depth_m, rtol=1e-6)
    np.testing.assert_array_equal(got.top, wanted.contributions.top)
    weights = weights_of(wanted, len(scene.rows))
    if wanted.opacity.max() < 1 - 2e-4:
        check("weights of Gaussians to reference", peak(got.weights, weights), name)
    np.testing.assert_allclose(got.weights, weights, atol=2e-4 * max(weights, default=0))


def test_scenes_have_each_kind_of_pixel() -> None:
    medians, tops = (
        np.concatenate([getattr(of_kernel(name), kind).ravel() for name in ALL])
        for kind in ("median_depth_m", "top")
    )
    assert 0.3 < np.mean(medians > 0) < 0.7
    assert np.mean(tops < 0) > 0.1
    hidden = of_kernel("cloud").weights == 0
    assert 5 < hidden.sum() < 85


def test_nearer_of_two_equal_weights_is_on_top() -> None:
    scene = Scene(equal_weights(), camera_of(1, 1), np.eye(4))
    wanted = render(scene.rows, scene.camera, scene.T_camera_map, contributions=True).contributions
    assert wanted is not None
    assert wanted.weights[0] == wanted.weights[1]
    got = Shown(scene)
    np.testing.assert_array_equal(got.weights, wanted.weights)
    np.testing.assert_array_equal(got.top, [[0]])


def assert_same_bits(one: Shown, other: Shown) -> None:
    for name in ("median_depth_m", "weights", "top"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("arrays", [ARRAYS, OtherwiseFilledArrays()])
def test_second_run_and_other_memory_have_the_same_bits(arrays: Arrays) -> None:
    for name in ("turned", "empty tiles"):
        assert_same_bits(of_kernel(name), Shown(ALL[name], arrays))


def test_order_of_the_programs_has_no_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    from triton.runtime.interpreter import interpreter_builder

    monkeypatch.setattr(view_rendering, "LANES", 16)  # More programs.
    names = ("turned", "beyond the edges")
    forward = [Shown(ALL[name]) for name in names]
    set_place, is_moved = interpreter_builder.set_grid_idx, []

    def set_reversed(x: int, y: int, z: int) -> None:
        last = interpreter_builder.grid_dim[0] - 1
        is_moved.append(last > 0)
        set_place(last - x, y, z)

    monkeypatch.setattr(interpreter_builder, "set_grid_idx", set_reversed)
    for name, wanted in zip(names, forward, strict=True):
        assert_same_bits(Shown(ALL[name]), wanted)
    assert sum(is_moved) > 10


# --- planted errors -------------------------------------------------------------------------------
# Correct text, wrong text, and the test that must fail.
SLIPS = {
    "late median": (
        "(T < HALF)",
        "(T < HALF * 0.98)",
        partial(test_view_equals_that_of_the_cpu, "beyond the edges"),
    ),
    "last depth instead of the median": (
        "& (median == 0.0)",
        "",
        partial(test_view_equals_that_of_the_cpu, "ties"),
    ),
    "median in one chunk only": (
        "& (largest >= HALF)",
        "& (i == tl.load(starts + tile))",
        partial(test_view_equals_that_of_the_cpu, "dark"),
    ),
    "weights behind the end of a block": (
        "tl.where(j < block_end, alpha * T, 0.0)",
        "alpha * T",
        partial(test_view_equals_that_of_the_cpu, "dark"),
    ),
    "farther of two equal weights": (
        "largest < weight",
        "largest <= weight",
        test_nearer_of_two_equal_weights_is_on_top,
    ),
    "missing last tile": (
        "k < count,",
        "k < tl.maximum(count - 1, 1),",
        partial(test_view_equals_that_of_the_cpu, "turned"),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("slip", SLIPS)
def test_planted_error_is_detected(
    slip: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    correct, wrong, judge = SLIPS[slip]
    text = Path(contributions.__file__).read_text()
    assert text.count(correct) == 1
    monkeypatch.setattr(agreement, "measured", {})  # The summary leaves these differences out.
    use(monkeypatch, text, tmp_path / "same.py")
    judge()
    use(monkeypatch, text.replace(correct, wrong), tmp_path / "wrong.py")
    with pytest.raises(AssertionError):
        judge()
    of_kernel.cache_clear()


def use(monkeypatch: pytest.MonkeyPatch, text: str, path: Path) -> None:
    """Replace the module `contributions` by one whose code is `text`."""
    path.write_text(text)
    name = f"ldo_service.kernels.gpu.changed_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(view_rendering, "contributions", module)
    of_kernel.cache_clear()
