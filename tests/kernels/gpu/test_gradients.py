from dataclasses import dataclass, replace
from functools import cache

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad

from ldo_service.gaussians.renderer import AdamStep
from ldo_service.kernels import _adam
from ldo_service.kernels.gpu.arrays import HostArray
from tests.kernels.gpu.agreement import check, peak, relative
from tests.kernels.gpu.scenes import (
    ARRAYS,
    NAMES,
    SCENES,
    SEAM,
    FilledArrays,
    Scene,
    descent,
    host,
    of_cpu,
    of_kernel,
    plane_rendering,
    rendered,
)
from tests.reference.adam import adam_reference
from tests.reference.blend_gradient import pair_sums_reference
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


# Generators of the transforms exp(xi): rotation about x, y and z, then translation along x, y, z.
GENERATORS = np.zeros((6, 4, 4))
for _k in range(3):
    GENERATORS[_k, (_k + 2) % 3, (_k + 1) % 3] = 1
    GENERATORS[_k, (_k + 1) % 3, (_k + 2) % 3] = -1
    GENERATORS[_k + 3, _k, 3] = 1


class KeptArrays(FilledArrays):
    """Arrays that keep the last array of zeros: the sums by pairs, which only a kernel reads."""

    kept: HostArray

    def zeros(self, shape: tuple[int, ...], dtype: type) -> HostArray:
        self.kept = super().zeros(shape, dtype)
        return self.kept


def differentiated(
    scene: Scene, rendering: plane_rendering.PlaneRendering, **options: float
) -> tuple[descent.Derivatives, np.ndarray]:
    """Return the derivatives of a rendered scene, and the sums of its pairs, [P, 16]."""
    arrays = KeptArrays()
    by_planes, rows = ARRAYS.upload(scene.by_planes()), ARRAYS.upload(scene.rows)
    made = descent.backpropagate(arrays, rows, rendering, by_planes, **options)
    return made, host(arrays.kept)


@cache
def gradients_of(name: str) -> tuple[descent.Derivatives, np.ndarray]:
    return differentiated(SCENES[name], of_kernel(name))


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_equal_those_of_the_cpu(name: str) -> None:
    scene = SCENES[name]
    rasterizer, _ = of_cpu(scene)
    wanted, (got, _) = rasterizer.gradients(scene.by_planes()), gradients_of(name)
    rows = host(got.rows)
    np.testing.assert_array_equal(host(got.weights), rows[:, 14])
    assert not rows[:, 15].any()
    for group, columns in FIELDS.items():
        error = relative(rows[:, columns], wanted.rows[:, columns])
        check("derivatives by rows to C++", error, f"{name}, {group}")
    check("derivative by pose to C++", relative(got.xi, wanted.xi), name)


def test_no_gaussians_have_no_derivatives() -> None:
    got, _ = gradients_of("no Gaussians")
    assert host(got.rows).shape == (0, 16)
    assert host(got.weights).shape == (0,)
    np.testing.assert_array_equal(got.xi, np.zeros(6))


@pytest.mark.parametrize("name", [n for n in NAMES if n not in ("dark", "broken rows", "ties")])
def test_derivatives_equal_the_reference(name: str) -> None:
    scene, by_planes = SCENES[name], SCENES[name].by_planes()

    def value(rows, xi):
        T_camera_map = (np.eye(4) - anp.tensordot(xi, GENERATORS, 1)) @ scene.T_rounded
        shown = render_reference(rows, scene.camera, T_camera_map, anp, scene.binning)
        by_color = anp.sum(np.moveaxis(by_planes[:3], 0, -1) * shown.color)
        by_depth = anp.sum(by_planes[3] * shown.weighted_depth_m)
        return by_color + by_depth + anp.sum(by_planes[4] * shown.opacity)

    wanted, by_xi = grad(value, (0, 1))(scene.drawable_rows(), np.zeros(6))
    got, _ = gradients_of(name)
    check("derivative by pose to reference", relative(got.xi, by_xi), name)
    visible = host(of_kernel(name).lists.visible)
    rasterizer, _ = of_cpu(scene)
    of_cpp = rasterizer.gradients(by_planes)
    for group, columns in list(FIELDS.items())[:5]:
        error = relative(host(got.rows)[:, columns], wanted[visible][:, columns])
        check("derivatives by rows to reference", error, f"{name}, {group}")
        error = relative(of_cpp.rows[:, columns], wanted[visible][:, columns])
        check("C++ derivatives by rows to reference", error, f"{name}, {group}")


@pytest.mark.parametrize("name", NAMES)
def test_sums_by_pairs_equal_the_reference(name: str) -> None:
    compare_sums(name, SCENES[name], of_kernel(name), *gradients_of(name))


def compare_sums(
    name: str,
    scene: Scene,
    rendering: plane_rendering.PlaneRendering,
    got: descent.Derivatives,
    sums: np.ndarray,
) -> None:
    """Compare the sums of each pair, and the sums of each Gaussian over its pairs."""
    lists, n = rendering.lists, len(scene.rows)
    listed, origins = host(lists.listed), host(lists.origins)
    wanted = pair_sums_reference(
        host(rendering.splats.splats),
        listed,
        host(lists.starts),
        host(rendering.ends),
        scene.by_planes(),
    )
    assert not sums[:, 11:].any()
    for k in range(11):
        error = relative(sums[origins, k], wanted[:, k])
        check("sums by pairs to reference", error, f"{name}, sum {k}")
    gathered = np.zeros((n, 16))
    np.add.at(gathered, listed, sums[origins].astype(float))
    visible, rows = host(lists.visible), host(got.rows)
    for group, first, columns in (("color", 6, FIELDS["color"]), ("weight", 10, FIELDS["weight"])):
        of_pairs = gathered[visible, first : first + columns.stop - columns.start]
        error = relative(rows[:, columns], of_pairs)
        check("sums by Gaussians to reference", error, f"{name}, {group}")


def test_derivatives_across_the_seam_of_batches_are_correct() -> None:
    """The pairs of the tile fill two batches, and each block ends in the second one."""
    rendering, name = rendered(SEAM), "batch seam"
    assert host(rendering.ends).min() > 256
    got, sums = differentiated(SEAM, rendering)
    compare_sums(name, SEAM, rendering, got, sums)
    rasterizer, _ = of_cpu(SEAM)
    wanted = rasterizer.gradients(SEAM.by_planes())
    for group, columns in FIELDS.items():
        error = relative(host(got.rows)[:, columns], wanted.rows[:, columns])
        check("derivatives by rows to C++", error, f"{name}, {group}")
    check("derivative by pose to C++", relative(got.xi, wanted.xi), name)


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


@dataclass(frozen=True, eq=False)
class Stepped:
    """A step of Adam: derivatives with the penalty, state and rows after the step, results."""

    gradients: np.ndarray
    adam: descent.AdamState
    rows: np.ndarray
    made: descent.Derivatives


@cache
def step_of(name: str) -> Stepped:
    scene = SCENES[name]
    by_planes, n = scene.by_planes(), len(scene.rows)
    gradients = host(differentiated(scene, of_kernel(name), **PENALTY)[0].rows)
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
    return Stepped(gradients, adam, host(rows), made)


STEPPED = ("turned", "capped", "broken rows", "binned")


@pytest.mark.parametrize("name", STEPPED)
def test_step_equals_the_step_of_the_cpu(name: str) -> None:
    scene, stepped = SCENES[name], step_of(name)
    gradients, adam, made = stepped.gradients, stepped.adam, stepped.made
    by_planes, n = scene.by_planes(), len(scene.rows)
    rasterizer, _ = of_cpu(scene)
    wanted = rasterizer.gradients(by_planes, **PENALTY)
    for group, columns in FIELDS.items():
        error = relative(gradients[:, columns], wanted.rows[:, columns])
        check("derivatives by rows to C++", error, f"{name} with needles, {group}")
    stepped_by_cpu(name, scene, gradients, adam, stepped.rows)

    # The C++ kernel differentiates the same rendering and steps.
    cpu, cpu_rows = state_of(n), scene.rows.copy()
    rasterizer.render(cpu_rows, scene.camera, scene.T_camera_map, binning=scene.binning)
    step = AdamStep(cpu_rows, cpu.mean, cpu.square, cpu.steps, cpu.rates, *BETAS, EPSILON)
    reached = rasterizer.descend(by_planes, step, max_sigma_px=MAX_SIGMA_PX, **PENALTY)
    np.testing.assert_array_equal(host(adam.steps), cpu.steps)
    error = relative(host(made.weights), reached.weights)
    check("derivatives by rows to C++", error, f"{name}, weights of a step")
    check("derivative by pose to C++", relative(made.xi, reached.xi), f"{name}, step")


@pytest.mark.parametrize("name", STEPPED)
def test_step_equals_the_reference(name: str) -> None:
    scene, got, visible = SCENES[name], step_of(name), host(of_kernel(name).lists.visible)
    gradients = np.zeros(scene.rows.shape)
    gradients[visible] = got.gradients
    focal_px, before = max(scene.camera.fx, scene.camera.fy), state_of(len(scene.rows))
    state = replace(before, rows=scene.rows)
    wanted = adam_reference(state, gradients, scene.T_rounded, focal_px, MAX_SIGMA_PX)
    np.testing.assert_array_equal(host(got.adam.steps), wanted.steps)
    assert 0 < (wanted.steps != before.steps).sum() < len(scene.rows)
    kind, is_finite = "step of Adam to reference", np.isfinite(scene.rows).all(axis=1)
    check(kind, peak(host(got.adam.moments), wanted.mean), f"{name}, first moments")
    check(kind, peak(host(got.adam.squares), wanted.square), f"{name}, second moments")
    for group, columns in list(FIELDS.items())[:5]:
        error = peak(got.rows[is_finite][:, columns], wanted.rows[is_finite][:, columns])
        check(kind, error, f"{name}, {group}")


def log_of_max_sigma(
    rows: np.ndarray, T_camera_map: np.ndarray, focal_px: float, max_sigma_px: float
) -> np.ndarray:
    """Return the logarithm of the largest standard deviation of each row after a step, [N]."""
    z = rows[:, :3].astype(float) @ T_camera_map[2, :3] + T_camera_map[2, 3]
    with np.errstate(invalid="ignore"):
        return np.log(max_sigma_px / focal_px * np.maximum(z, 0.05))


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
    focal_px = max(scene.camera.fx, scene.camera.fy)
    limit = log_of_max_sigma(rows, scene.T_rounded, focal_px, MAX_SIGMA_PX)
    limited = np.minimum(wanted[:, 3:6], limit[:, None])
    assert (limited[moved] < wanted[moved, 3:6]).any()
    assert (limited[moved] == wanted[moved, 3:6]).any()
    wanted[moved, 3:6] = limited[moved]
    is_finite = np.isfinite(scene.rows).all(axis=1)
    for group, columns in list(FIELDS.items())[:5]:
        error = peak(rows[is_finite][:, columns], wanted[is_finite][:, columns])
        check("step of Adam to C++", error, f"{name}, {group}")
    np.testing.assert_array_equal(rows[~moved], scene.rows[~moved])
