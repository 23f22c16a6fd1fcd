"""Planted errors in the kernels, each of which a test must detect."""

import importlib.util
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest

from ldo_service.errors import DeviceError
from tests.kernels.gpu import agreement, scenes, test_gradients, test_residuals
from tests.kernels.gpu.scenes import descent, equation_sums, frame_loss, plane_rendering
from tests.kernels.gpu.test_blending import test_planes_equal_those_of_the_cpu as judge_planes
from tests.kernels.gpu.test_gradients import test_derivatives_equal_those_of_the_cpu as judge_rows
from tests.kernels.gpu.test_gradients import test_step_equals_the_step_of_the_cpu as judge_step
from tests.kernels.gpu.test_loss import test_loss_equals_that_of_the_cpu as judge_loss
from tests.kernels.gpu.test_projection import test_splats_equal_the_reference as judge_splats
from tests.kernels.gpu.test_residuals import test_equations_equal_those_of_the_cpu as judge_sums

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]  # Minutes, on a busy machine.
KERNELS = Path(descent.__file__).parent
# Module, correct text, wrong text, and the test that must fail.
SLIPS = {
    "row that is not finite": (
        "projection",
        "& (total * 0.0 >= 0.0)",
        "",
        partial(judge_splats, "broken rows"),
    ),
    "ridge without its slope": (
        "projection",
        "clamp(side_y * x_slope",
        "clamp(0.0 * x_slope",
        partial(judge_planes, "needles"),
    ),
    "late early stop": (
        "blending",
        "STOP = tl.constexpr(1e-4)",
        "STOP = tl.constexpr(5e-5)",
        partial(judge_planes, "dark"),
    ),
    "inexact mean behind a splat": (
        "blending",
        "weight * (q - mean)",
        "weight * (q - mean * 1.0001)",
        partial(judge_rows, "cloud"),
    ),
    "missing derivative of binning": (
        "projection_gradient",
        "tl.where(is_binned, Suv - uv * narrow - V * Kuv, Suv)",
        "Suv",
        partial(judge_rows, "binned"),
    ),
    "wrong bias correction": (
        "projection_gradient",
        "corrections + step * 2 + 1",
        "corrections + step * 2",
        partial(judge_step, "turned"),
    ),
    "half a derivative of SSIM": (
        "loss",
        "x * 2.0 * by_squares",
        "x * by_squares",
        partial(judge_loss, "wide"),
    ),
    "lever arm of the point instead of the surface": (
        "residuals",
        "turn = cross(n, q)",
        "turn = cross(n, p)",
        partial(judge_sums, "slope"),
    ),
    "late occlusion": (
        "residuals",
        "1.0 + tl.load(problem + 24)",
        "1.5 + tl.load(problem + 24)",
        partial(judge_sums, "holes"),
    ),
    "clipped pixel": ("residuals", "& (darkest > 0.0) ", "", partial(judge_sums, "holes")),
    "point too close": (
        "residuals",
        "(z > NEAREST)",
        "(z > 0.0)",
        partial(judge_sums, "partly behind the camera"),
    ),
    "linear noise of depth": (
        "residuals",
        "growth * beyond * beyond",
        "growth * beyond",
        partial(judge_sums, "slope"),
    ),
    "strips of another cell": (
        "residuals",
        "live, 0) == cell)",
        "live, 0) >= cell)",
        partial(judge_sums, "slope"),
    ),
    "normal that is not finite": (
        "residuals",
        "& (size * 0.0 >= 0.0)",
        "",
        test_residuals.test_points_that_are_not_finite_add_nothing,
    ),
}


@pytest.fixture(autouse=True)
def _fresh_results(monkeypatch: pytest.MonkeyPatch):
    """Compute all results again, and leave the planted differences out of the summary."""
    monkeypatch.setattr(agreement, "measured", {})
    forget_results()
    yield
    forget_results()


def forget_results() -> None:
    of_gradients = test_gradients.gradients_of, test_gradients.step_of
    for cached in (scenes.of_kernel, *of_gradients, test_residuals.of_kernel):
        cached.cache_clear()


def changed_module(name: str, text: str, folder: Path) -> ModuleType:
    """Return a module of kernels whose code is `text`; it imports the other modules unchanged."""
    path = folder / f"changed_{name}.py"
    path.write_text(text)
    full_name = f"ldo_service.kernels.gpu.changed_{name}"
    spec = importlib.util.spec_from_file_location(full_name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("slip", SLIPS)
def test_planted_error_is_detected(
    slip: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, correct, wrong, judge = SLIPS[slip]
    text = (KERNELS / f"{name}.py").read_text()
    assert text.count(correct) == 1
    for content, is_wrong in ((text, False), (text.replace(correct, wrong), True)):
        folder = tmp_path / str(is_wrong)
        folder.mkdir()
        module = changed_module(name, content, folder)
        for user in (plane_rendering, frame_loss, descent, equation_sums):
            if hasattr(user, name):
                monkeypatch.setattr(user, name, module)
        forget_results()
        judge_must(judge, fail=is_wrong)


def judge_must(judge: Callable[[], None], *, fail: bool) -> None:
    """Run a test, which must pass, or must fail by an assertion or by a check of the kernels."""
    if not fail:
        judge()
        return
    with pytest.raises((AssertionError, DeviceError)):
        judge()
