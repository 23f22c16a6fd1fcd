from functools import cache

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad

from ldo_service.gaussians.renderer import AdamStep
from ldo_service.kernels import _adam
from tests.kernels.gpu.agreement import check, peak, relative
from tests.kernels.gpu.scenes import ARRAYS, NAMES, SCENES, Scene, descent, host, of_cpu, of_kernel
from tests.reference.render import render_reference

FIELDS = {
    "mean": slice(0, 3),
    "log scale": slice(3, 6),
    "quaternion": slice(6, 10),
    "opacity": slice(10, 11),
    "color": slice(11, 14),
    "weight": slice(14, 15),
}
BETAS, EPSILON = (0.9, 0.95), 1e-15
PENALTY = {"needle_weight": 30.0, "needle_ratio": 1.5}
MAX_SIGMA_PX = 1.2


def differentiated(name: str, **options: float) -> descent.Derivatives:
    scene = SCENES[name]
    by_planes = ARRAYS.upload(scene.by_planes())
    return descent.backpropagate(
        ARRAYS, ARRAYS.upload(scene.rows), of_kernel(name), by_planes, **options
    )


@cache
def gradients_of(name: str) -> descent.Derivatives:
    return differentiated(name)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_equal_those_of_the_cpu(name: str) -> None:
    scene = SCENES[name]
    rasterizer, _ = of_cpu(scene)
    wanted, got = rasterizer.gradients(scene.by_planes()), gradients_of(name)
    rows = host(got.rows)
    np.testing.assert_array_equal(host(got.weights), rows[:, 14])
    assert not rows[:, 15].any()
    for group, columns in FIELDS.items():
        error = relative(rows[:, columns], wanted.rows[:, columns])
        check("derivatives by rows to C++", error, f"{name}, {group}")
    check("derivative by pose to C++", relative(got.xi, wanted.xi), name)


def test_no_gaussians_have_no_derivatives() -> None:
    got = differentiated("no Gaussians")
    assert host(got.rows).shape == (0, 16)
    assert host(got.weights).shape == (0,)
    np.testing.assert_array_equal(got.xi, np.zeros(6))


@pytest.mark.parametrize("name", [n for n in NAMES if n not in ("dark", "broken rows", "ties")])
def test_derivatives_equal_the_reference(name: str) -> None:
    scene, by_planes = SCENES[name], SCENES[name].by_planes()

    def value(rows):
        shown = render_reference(rows, scene.camera, scene.T_rounded, anp, scene.binning)
        by_color = anp.sum(np.moveaxis(by_planes[:3], 0, -1) * shown.color)
        by_depth = anp.sum(by_planes[3] * shown.weighted_depth_m)
        return by_color + by_depth + anp.sum(by_planes[4] * shown.opacity)

    wanted, got = grad(value)(scene.drawable_rows()), gradients_of(name)
    visible = host(of_kernel(name).lists.visible)
    rasterizer, _ = of_cpu(scene)
    of_cpp = rasterizer.gradients(by_planes)
    for group, columns in list(FIELDS.items())[:5]:
        error = relative(host(got.rows)[:, columns], wanted[visible][:, columns])
        check("derivatives by rows to reference", error, f"{name}, {group}")
        error = relative(of_cpp.rows[:, columns], wanted[visible][:, columns])
        check("C++ derivatives by rows to reference", error, f"{name}, {group}")


def state_of(n: int) -> AdamStep:
    """Return moments, step counts around the last correction, and rates of n rows."""
    rng = np.random.default_rng(0)
    mean = rng.normal(0, 1, (n, 16)).astype(np.float32)
    square = rng.uniform(0.5, 2, (n, 16)).astype(np.float32)
    mean[:, 15] = square[:, 15] = 0
    steps = rng.choice([0, 1, 7, 1021, 1022, 1500], n).astype(np.int32)
    rates = [5e-3] * 3 + [0.06] * 3 + [0.01] * 4 + [0.1] + [0.01] * 3 + [0, 0]
    return AdamStep(np.empty(0), mean, square, steps, np.array(rates, np.float32), *BETAS, EPSILON)


def on_device(state: AdamStep) -> descent.AdamState:
    arrays = (ARRAYS.upload(x) for x in (state.mean, state.square, state.steps))
    corrections = ARRAYS.upload(descent.bias_corrections(*BETAS))
    return descent.AdamState(*arrays, corrections, *BETAS, EPSILON)


@pytest.mark.parametrize("name", ["turned", "capped", "broken rows", "binned"])
def test_step_equals_the_step_of_the_cpu(name: str) -> None:
    scene = SCENES[name]
    by_planes, n = scene.by_planes(), len(scene.rows)
    gradients = host(differentiated(name, **PENALTY).rows)
    adam, rows = on_device(state_of(n)), ARRAYS.upload(scene.rows)
    made = descent.backpropagate(
        ARRAYS,
        rows,
        of_kernel(name),
        ARRAYS.upload(by_planes),
        adam=adam,
        rates=state_of(n).rates,
        max_sigma_px=MAX_SIGMA_PX,
        **PENALTY,
    )
    rasterizer, _ = of_cpu(scene)
    wanted = rasterizer.gradients(by_planes, **PENALTY)
    for group, columns in FIELDS.items():
        error = relative(gradients[:, columns], wanted.rows[:, columns])
        check("derivatives by rows to C++", error, f"{name} with needles, {group}")
    stepped_by_cpu(name, scene, gradients, adam, host(rows))

    # The C++ kernel differentiates the same rendering and steps.
    cpu, cpu_rows = state_of(n), scene.rows.copy()
    rasterizer.render(cpu_rows, scene.camera, scene.T_camera_map, binning=scene.binning)
    step = AdamStep(cpu_rows, cpu.mean, cpu.square, cpu.steps, cpu.rates, *BETAS, EPSILON)
    reached = rasterizer.descend(by_planes, step, max_sigma_px=MAX_SIGMA_PX, **PENALTY)
    np.testing.assert_array_equal(host(adam.steps), cpu.steps)
    error = relative(host(made.weights), reached.weights)
    check("derivatives by rows to C++", error, f"{name}, weights of a step")
    check("derivative by pose to C++", relative(made.xi, reached.xi), f"{name}, step")


def stepped_by_cpu(
    name: str, scene: Scene, gradients: np.ndarray, adam: descent.AdamState, rows: np.ndarray
) -> None:
    """Compare the step with that of the C++ kernel for the same gradients."""
    cpu, wanted = state_of(len(scene.rows)), scene.rows.copy()
    visible = host(of_kernel(name).lists.visible).astype(np.uint32)
    before = cpu.steps.copy()
    _adam.adam_step(
        wanted, cpu.mean, cpu.square, cpu.steps, visible, gradients, cpu.rates, *BETAS, EPSILON
    )
    moved = cpu.steps != before
    np.testing.assert_array_equal(host(adam.steps), cpu.steps)
    check("step of Adam to C++", peak(host(adam.moments), cpu.mean), f"{name}, first moments")
    check("step of Adam to C++", peak(host(adam.squares), cpu.square), f"{name}, second moments")
    z = rows[:, :3].astype(float) @ scene.T_rounded[2, :3] + scene.T_rounded[2, 3]
    focal = max(scene.camera.fx, scene.camera.fy)
    with np.errstate(invalid="ignore"):
        limit = np.log(MAX_SIGMA_PX / focal * np.maximum(z, 0.05))
        limited = np.minimum(wanted[:, 3:6], limit[:, None])
    assert (limited[moved] < wanted[moved, 3:6]).any()
    assert (limited[moved] == wanted[moved, 3:6]).any()
    wanted[moved, 3:6] = limited[moved]
    is_finite = np.isfinite(scene.rows).all(axis=1)
    for group, columns in list(FIELDS.items())[:5]:
        error = peak(rows[is_finite][:, columns], wanted[is_finite][:, columns])
        check("step of Adam to C++", error, f"{name}, {group}")
    np.testing.assert_array_equal(rows[~moved], scene.rows[~moved])
