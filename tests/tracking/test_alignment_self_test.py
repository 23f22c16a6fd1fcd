"""Self-test and failures of the alignment on a GPU, with the interpreter of Triton as the GPU."""

import gc
import weakref
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from ldo_service.errors import DeviceError
from ldo_service.geometry import se3
from ldo_service.kernels.gpu.arrays import HostArray
from ldo_service.kernels.gpu.device import Gpu
from ldo_service.tracking.aligner import choose_aligner
from ldo_service.tracking.alignment import AlignConfig, BrightnessModel, ResidualConfig, align
from tests.kernels.gpu.scenes import FilledArrays, equation_sums

from ldo_service.tracking import alignment_self_test, gpu_equations  # isort: skip  # Triton.

GUESS = se3.exp(alignment_self_test.XI)


class ChangingArrays(FilledArrays):
    """Arrays of a device that is lost, or whose results change, after a number of downloads.

    `change` replaces later results; without it, the device is lost.
    """

    def __init__(
        self,
        downloads: float = np.inf,
        change: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        self.downloads, self.change, self.uploads = downloads, change, 0

    def upload(self, values: np.ndarray) -> HostArray:
        self.uploads += 1
        return super().upload(values)

    def download(self, array: HostArray) -> np.ndarray:
        values = super().download(array)
        self.downloads -= 1
        if self.downloads < 0:
            if self.change is None:
                raise RuntimeError("CUDA error: out of memory")
            return self.change(values)
        return values


def with_other_bits(values: np.ndarray) -> np.ndarray:
    return np.nextafter(values, np.inf)


def with_nan(values: np.ndarray) -> np.ndarray:
    values[-1] = np.nan
    return values


@pytest.fixture(autouse=True)
def _large_programs(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Launch few large programs, and compute without warnings."""
    monkeypatch.setattr(equation_sums, "POINT_LANES", 2048)
    with np.errstate(all="ignore"):
        yield


def test_kernels_pass_the_self_test() -> None:
    alignment_self_test.run_self_test(FilledArrays(), 2)


def test_wrong_kernels_fail_the_self_test(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(*arguments: object) -> np.ndarray:
        problem = problem_of(*arguments)
        problem[22] += 0.01  # Nearest depth of the noise.
        return problem

    problem_of = gpu_equations.problem_of
    monkeypatch.setattr(gpu_equations, "problem_of", wrong)
    with pytest.raises(DeviceError, match=r"hessian differs by .* CPU result; at most 1e-06"):
        alignment_self_test.run_self_test(FilledArrays(), 1)


@pytest.mark.slow
def test_results_that_change_fail_the_self_test() -> None:
    steady = ChangingArrays(1000)
    alignment_self_test.run_self_test(steady, 1)
    noisy = ChangingArrays(1000 - steady.downloads, with_other_bits)  # Changes then.
    with pytest.raises(DeviceError, match="differ between two repetitions"):
        alignment_self_test.run_self_test(noisy, 2)


def test_lost_device_fails_the_self_test(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = Gpu("interpreter", {"triton": "3.7.1"}, ChangingArrays(3))
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", lambda: gpu)
    choice = choose_aligner("cuda").device
    assert (choice.device, choice.has_failed) == ("cpu", True)
    assert "failed with RuntimeError: CUDA error: out of memory" in choice.reason


@pytest.mark.parametrize(
    ("change", "cause"), [(None, "out of memory"), (with_nan, "NaN or infinity")]
)
def test_alignment_of_a_lost_device_has_the_bits_of_the_cpu(
    change: Callable[[np.ndarray], np.ndarray] | None,
    cause: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog,
) -> None:
    arrays = ChangingArrays(change=change)
    gpu = Gpu("interpreter", {"triton": "3.7.1"}, arrays)
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", lambda: gpu)
    monkeypatch.setattr(alignment_self_test, "run_self_test", lambda _: None)
    aligner, scene = choose_aligner("cuda"), alignment_self_test.make_scene(48, 36)
    on_gpu, on_cpu = (
        a.align(*scene, GUESS, AlignConfig()) for a in (aligner, choose_aligner("cpu"))
    )
    assert aligner.device.metrics() == {"device_failed": 0, "on_gpu": 1}
    difference = se3.log(se3.inverse(on_gpu.T_reference_camera) @ on_cpu.T_reference_camera)
    assert 0 < np.linalg.norm(difference) < 1e-6
    arrays.downloads = 2  # The device is lost in the third step.
    repeated = aligner.align(*scene, GUESS, AlignConfig())
    assert arrays.downloads < 0
    assert aligner.device.metrics() == {"device_failed": 1, "on_gpu": 0}
    assert cause in caplog.text
    np.testing.assert_array_equal(repeated.T_reference_camera, on_cpu.T_reference_camera)
    np.testing.assert_array_equal(repeated.information, on_cpu.information)


def test_points_and_texels_are_uploaded_once() -> None:
    arrays = ChangingArrays()
    equations, scene = gpu_equations.GpuEquations(arrays), alignment_self_test.make_scene(48, 36)
    first = align(*scene, GUESS, AlignConfig(), equations.normal_equations)
    assert equations.uploaded == 5  # Points and texels of two levels, and cells.
    uploads = arrays.uploads
    align(*scene, GUESS, AlignConfig(), equations.normal_equations)
    assert equations.uploaded == 5
    assert arrays.uploads - uploads == first.iterations + 3  # The pose of each step.
    del scene
    gc.collect()
    assert not equations._resident  # The copies go with the arrays of the host.


def test_copies_on_the_device_are_freed_without_the_garbage_collector() -> None:
    scene = alignment_self_test.make_scene(48, 36)
    equations = gpu_equations.GpuEquations(FilledArrays())
    align(*scene, GUESS, AlignConfig(), equations.normal_equations)
    copies = weakref.ref(equations._resident)
    assert copies()
    gc.disable()
    try:
        del equations
        assert copies() is None
    finally:
        gc.enable()


def test_arrays_beyond_the_limit_are_uploaded_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_equations, "MAX_ARRAYS", 2)
    equations, scene = (
        gpu_equations.GpuEquations(FilledArrays()),
        alignment_self_test.make_scene(48, 36),
    )
    found = align(*scene, GUESS, AlignConfig(), equations.normal_equations)
    assert found.converged
    assert equations.uploaded > 5
    assert len(equations._resident) == 2


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"T_camera_reference": 2 * np.eye(4)}, "rigid"),
        ({"points": np.zeros((6, 5), np.float32)}, "points"),
        ({"points": np.zeros((7, 5))}, "points"),
        ({"cells": np.zeros(3, np.uint8)}, "cells"),
        ({"appearance": BrightnessModel(intensity_sigma=0.0)}, "intensity_sigma"),
    ],
)
def test_bad_arguments_are_refused_as_on_the_cpu(changed: dict, message: str) -> None:
    reference, frame = alignment_self_test.make_scene(48, 36)
    arguments = {
        "points": reference.points[0],
        "target": frame.levels[0],
        "T_camera_reference": GUESS,
        "appearance": BrightnessModel(),
        "config": ResidualConfig(),
        "cells": reference.cells,
    }
    equations = gpu_equations.GpuEquations(FilledArrays())
    with pytest.raises(ValueError, match=message):
        equations.normal_equations(**{**arguments, **changed})
