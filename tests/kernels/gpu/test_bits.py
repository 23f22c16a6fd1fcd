"""The results are bitwise equal in each run, in any order of the programs, and for any memory."""

import numpy as np
import pytest

from ldo_service.kernels.gpu.arrays import Arrays, HostArray, HostArrays, TorchArrays
from tests.kernels.gpu.scenes import (
    ARRAYS,
    SCENES,
    descent,
    equation_sums,
    frame_loss,
    plane_rendering,
)
from tests.kernels.gpu.test_gradients import BETAS, EPSILON, PENALTY, state_of
from tests.kernels.gpu.test_loss import IMAGES, WEIGHTS
from tests.kernels.gpu.test_residuals import SCENES as ALIGNED
from tests.kernels.gpu.test_residuals import equations_of, numbers_of


class OtherwiseFilledArrays(HostArrays):
    """Arrays whose undefined values are 3."""

    def empty(self, shape: tuple[int, ...], dtype: type) -> HostArray:
        return HostArray(np.full(shape, 3, dtype))


def results_of(arrays: Arrays, names: tuple[str, ...] = ("turned",)) -> list[np.ndarray]:
    """Return all results of the kernels on some scenes."""
    out = []
    for name in names:
        scene = SCENES[name]
        camera, n = scene.camera, len(scene.rows)
        rows, by_planes = arrays.upload(scene.rows), arrays.upload(scene.by_planes())
        rendering = plane_rendering.render(arrays, rows, n, scene.view, camera.width, camera.height)
        derivatives = descent.backpropagate(arrays, rows, rendering, by_planes)
        state = state_of(n)
        moments = (arrays.upload(x) for x in (state.mean, state.square, state.steps))
        corrections = arrays.upload(descent.bias_corrections(*BETAS))
        adam = descent.AdamState(*moments, corrections, *BETAS, EPSILON)
        stepped = descent.backpropagate(
            arrays, rows, rendering, by_planes, adam=adam, rates=state.rates, **PENALTY
        )
        lists = rendering.lists
        out += [rendering.planes, rendering.ends, lists.listed, lists.origins, derivatives.rows]
        out += [stepped.weights, rows, adam.moments, adam.squares, adam.steps]
        out += [arrays.upload(x) for x in (derivatives.xi, stepped.xi)]
        out.append(arrays.upload(plane_rendering.mean_blocks(arrays, rendering, 8)))
        _, color, depth_m, mask, exposure = IMAGES["wide"]
        crop = slice(0, camera.height), slice(0, camera.width)
        if camera.height <= 18:
            images = (np.ascontiguousarray(x[..., *crop]) for x in (color, depth_m, mask))
            frame = frame_loss.Frame(*map(arrays.upload, images), 100)
            weights = WEIGHTS.l1, WEIGHTS.d_ssim, WEIGHTS.depth
            by_loss, means = frame_loss.image_loss(arrays, rendering, frame, exposure, weights)
            out += [by_loss, arrays.upload(means)]
    equations = numbers_of(equations_of(arrays, ALIGNED["holes"]))
    return [*(arrays.download(x) for x in out), *equations]


def assert_same_bits(first: list[np.ndarray], second: list[np.ndarray]) -> None:
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


SQUARE_SCENES = ("beyond the edges", "ties")  # Scenes of 16x16 pixels, so that the loss takes part.


@pytest.mark.slow
def test_second_run_has_the_same_bits() -> None:
    assert_same_bits(results_of(ARRAYS, SQUARE_SCENES), results_of(ARRAYS, SQUARE_SCENES))


@pytest.mark.slow
def test_undefined_memory_has_no_effect() -> None:
    assert_same_bits(
        results_of(ARRAYS, SQUARE_SCENES), results_of(OtherwiseFilledArrays(), SQUARE_SCENES)
    )


@pytest.mark.slow
def test_order_of_the_programs_has_no_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program reads nothing that another one writes, and no two programs write the same place."""
    from triton.runtime.interpreter import interpreter_builder

    monkeypatch.setattr(plane_rendering, "LANES", 32)  # More programs.
    monkeypatch.setattr(descent, "LANES", 32)
    monkeypatch.setattr(frame_loss, "PIXEL_LANES", 128)
    monkeypatch.setattr(equation_sums, "POINT_LANES", 64)
    names = ("turned", *SQUARE_SCENES)
    forward = results_of(ARRAYS, names)
    set_place, is_moved = interpreter_builder.set_grid_idx, []

    def set_reversed(x: int, y: int, z: int) -> None:
        last = interpreter_builder.grid_dim[0] - 1
        is_moved.append(last > 0)
        set_place(last - x, y, z)

    monkeypatch.setattr(interpreter_builder, "set_grid_idx", set_reversed)
    assert_same_bits(forward, results_of(ARRAYS, names))
    assert sum(is_moved) > 100


def test_torch_arrays_give_the_same_bits() -> None:
    pytest.importorskip("torch", reason="install torch to test the arrays of a GPU on the CPU")
    assert_same_bits(
        results_of(ARRAYS, SQUARE_SCENES), results_of(TorchArrays("cpu"), SQUARE_SCENES)
    )
