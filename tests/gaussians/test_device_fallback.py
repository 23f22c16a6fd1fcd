"""Failures of a device during a plan, injected into a backend that computes like the CPU."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.errors import DeviceError
from ldo_service.gaussians import (
    GaussianMap,
    GaussianOptimizer,
    GaussianOptimizerConfig,
    ImageLoss,
    TrainingView,
    VisibleGaussians,
    densify,
)
from ldo_service.gaussians.device_choice import choose_backend
from ldo_service.gaussians.exposure import Exposure
from ldo_service.gaussians.optimizer_backend import CpuBackend, Rate
from ldo_service.kernels.gpu.arrays import HostArrays
from ldo_service.kernels.gpu.device import Gpu
from tests.kernels.gpu.saved_times import save_times

CONFIG = GaussianOptimizerConfig(rotation_rate_rad=1e-3, translation_rate_m=1e-3)
PLAN = [4, 0, 4, 8]


class FlakyBackend(CpuBackend):
    """Backend on a copy of the map, which `end` writes back; a chosen call fails."""

    can_fail = True

    def __init__(self, failing: str = "", calls_before: int = 0) -> None:
        super().__init__(CONFIG.adam, CONFIG.loss, CONFIG.limits)
        self._failing, self._calls_before = failing, calls_before
        self._state = self.snapshot()

    def _count(self, call: str) -> None:
        if call == self._failing:
            if self._calls_before == 0:
                raise DeviceError("out of memory.") from RuntimeError("CUDA error 2")
            self._calls_before -= 1

    def begin(self, gaussians: GaussianMap) -> None:
        self._count("begin")
        self._master, self._state = gaussians, self.snapshot()
        super().begin(GaussianMap.restore(gaussians.snapshot()))

    def render(self, view: TrainingView, *, is_half: bool) -> None:
        self._count("render")
        super().render(view, is_half=is_half)

    def descend(self, exposure: Exposure, *, rate: Rate) -> tuple[ImageLoss, VisibleGaussians]:
        self._count("descend")
        loss, visible = super().descend(exposure, rate=rate)
        copies = visible.indices.copy(), visible.weights.copy()
        return loss, replace(visible, indices=copies[0], weights=copies[1])

    def end(self) -> None:
        self._count("end")
        self._master.rows[:] = self._map().rows
        self._state = self.snapshot()
        super().end()

    def on_cpu(self) -> CpuBackend:
        backend = CpuBackend(CONFIG.adam, CONFIG.loss, CONFIG.limits, threads=self.threads)
        backend.restore(self._state)
        return backend


class Fit:
    """Result of two plans on a map of three views."""

    def __init__(self, small_room: Callable, optimizer: GaussianOptimizer) -> None:
        self.gaussians, self.views = GaussianMap(), {}
        for i in (0, 4, 8):
            frame, T_map_camera = small_room(i)
            densify(self.gaussians, frame, T_map_camera, i)
            view = TrainingView.of(frame, T_map_camera, i)
            self.views[i] = replace(view, color=(view.color * 0.9).astype(np.uint8))
        self.optimizer, self.seen, self.losses = optimizer, [], []
        for _ in range(2):
            losses = optimizer.optimize(
                self.gaussians, self.views, PLAN, fixed=0, observe=self._observe
            )
            self.losses += [loss.total for loss in losses]

    def _observe(self, keyframe: int, visible: VisibleGaussians) -> None:
        self.seen.append((keyframe, visible.weights.copy()))

    def assert_equals(self, other: "Fit") -> None:
        """Check that all results are bitwise equal."""
        assert self.losses == other.losses
        np.testing.assert_array_equal(self.gaussians.rows, other.gaussians.rows)
        for view, wanted in zip(self.views.values(), other.views.values(), strict=True):
            np.testing.assert_array_equal(view.T_map_camera, wanted.T_map_camera)
            np.testing.assert_array_equal(view.exposure.matrix, wanted.exposure.matrix)
        assert [keyframe for keyframe, _ in self.seen] == [keyframe for keyframe, _ in other.seen]
        for (_, weights), (_, wanted) in zip(self.seen, other.seen, strict=True):
            np.testing.assert_array_equal(weights, wanted)
        state, wanted_state = self.optimizer.snapshot(), other.optimizer.snapshot()
        assert state.keys() == wanted_state.keys()
        for name, values in state.items():
            np.testing.assert_array_equal(values, wanted_state[name])


@pytest.fixture(scope="module")
def on_cpu(small_room: Callable) -> Fit:
    return Fit(small_room, GaussianOptimizer(CONFIG, threads=2))


@pytest.mark.parametrize("second_plan", [False, True])
@pytest.mark.parametrize("failing", ["begin", "render", "descend", "end"])
def test_plan_of_a_failed_device_is_repeated_by_the_cpu(
    small_room: Callable, on_cpu: Fit, failing: str, second_plan: bool, caplog
) -> None:
    calls = {"begin": 0, "render": 2, "descend": 3, "end": 0}[failing]
    per_plan = {"begin": 1, "end": 1}.get(failing, len(PLAN))
    backend = FlakyBackend(failing, calls + per_plan * second_plan)
    fit = Fit(small_room, GaussianOptimizer(CONFIG, threads=2, backend=backend))
    fit.assert_equals(on_cpu)
    assert fit.optimizer.device.device == "cpu"
    assert fit.optimizer.device.metrics() == {"device_failed": 1, "on_gpu": 0}
    assert fit.optimizer.threads == 2
    (record,) = caplog.records
    assert "out of memory. The CPU fits and renders the map from now on" in record.getMessage()
    assert "RuntimeError: CUDA error 2" in caplog.text  # The traceback of the cause.


def test_device_without_a_failure_keeps_computing(small_room: Callable, on_cpu: Fit) -> None:
    fit = Fit(small_room, GaussianOptimizer(CONFIG, backend=FlakyBackend()))
    fit.assert_equals(on_cpu)
    assert fit.optimizer.device.metrics() == {"device_failed": 0, "on_gpu": 1}


def test_map_is_unchanged_until_the_end_of_the_plan(small_room: Callable) -> None:
    gaussians, (frame, T_map_camera) = GaussianMap(), small_room(0)
    densify(gaussians, frame, T_map_camera, 0)
    before, steps = gaussians.rows.copy(), []
    optimizer = GaussianOptimizer(CONFIG, backend=FlakyBackend("end"))
    views = {0: TrainingView.of(frame, T_map_camera, 0)}
    is_usable = lambda _: steps.append((gaussians.rows == before).all()) or True  # noqa: E731
    optimizer.optimize(gaussians, views, [0, 0], is_usable=is_usable)
    assert steps == [True, True, True, False]  # The last two iterations are those of the CPU.


def test_error_of_the_program_is_not_hidden_by_a_failed_device(small_room: Callable) -> None:
    gaussians, (frame, T_map_camera) = GaussianMap(), small_room(0)
    densify(gaussians, frame, T_map_camera, 0)
    optimizer = GaussianOptimizer(CONFIG, backend=FlakyBackend("end"))
    views = {0: TrainingView.of(frame, T_map_camera, 0)}

    errors = iter([KeyboardInterrupt])

    def interrupt_once(_: int) -> bool:
        if error := next(errors, None):
            raise error
        return True

    with pytest.raises(KeyboardInterrupt):
        optimizer.optimize(gaussians, views, [0, 0], is_usable=interrupt_once)


def test_failed_single_step_changes_no_map(small_room: Callable) -> None:
    gaussians, (frame, T_map_camera) = GaussianMap(), small_room(0)
    densify(gaussians, frame, T_map_camera, 0)
    before = gaussians.rows.copy()

    class LateFailure(FlakyBackend):
        def descend(self, exposure: Exposure, *, rate: Rate) -> tuple[ImageLoss, VisibleGaussians]:
            super().descend(exposure, rate=rate)
            raise DeviceError("the download failed.")

    optimizer = GaussianOptimizer(CONFIG, backend=LateFailure())
    with pytest.raises(DeviceError, match="the download failed"):
        optimizer.step(gaussians, TrainingView.of(frame, T_map_camera, 0))
    np.testing.assert_array_equal(gaussians.rows, before)


# --- choice at the start --------------------------------------------------------------------------
def no_gpu() -> Gpu:
    raise DeviceError("there is no GPU.")


@pytest.mark.parametrize(("wanted", "warnings"), [("auto", 0), ("cuda", 1), ("cpu", 0)])
def test_missing_gpu_is_replaced_by_the_cpu(
    wanted: str, warnings: int, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", no_gpu)
    backend, choice = choose_backend(wanted, CONFIG.adam, CONFIG.loss, CONFIG.limits)
    assert type(backend) is CpuBackend
    assert choice.has_failed == bool(warnings) == bool(caplog.records)
    assert choice.reason == (
        "service.device=cpu was chosen." if wanted == "cpu" else "there is no GPU."
    )


def test_unexpected_error_of_the_self_test_selects_the_cpu(
    monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    pytest.importorskip("triton", reason="`make gpu-check` installs Triton")
    from ldo_service.gaussians import gpu_self_test

    def self_test(_: object) -> None:
        raise TypeError("launch() takes 3 arguments")

    gpu = Gpu("Some GPU", {}, HostArrays())
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", lambda: gpu)
    monkeypatch.setattr(gpu_self_test, "run_self_test", self_test)
    backend, choice = choose_backend("cuda", CONFIG.adam, CONFIG.loss, CONFIG.limits)
    assert type(backend) is CpuBackend
    assert "the self-test failed with TypeError: launch() takes 3 arguments" in choice.reason
    assert "in self_test" in caplog.text  # The traceback.


@pytest.mark.parametrize("error", [None, DeviceError("the loss differs.")])
@pytest.mark.parametrize("wanted", ["auto", "cuda"])
def test_gpu_is_chosen_if_it_passes_the_self_test(
    wanted: str, error: DeviceError | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("triton", reason="`make gpu-check` installs Triton")
    from ldo_service.gaussians import gpu_self_test

    def self_test(_: object) -> None:
        if error:
            raise error

    gpu = Gpu("Some GPU", {"triton": "3"}, HostArrays())
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", lambda: gpu)
    monkeypatch.setattr(gpu_self_test, "run_self_test", self_test)
    monkeypatch.setenv("LDO_CACHE", str(tmp_path))
    if wanted == "auto":
        save_times(gpu, {"iteration": 2.0}, {"iteration": 1.0})
    backend, choice = choose_backend(wanted, CONFIG.adam, CONFIG.loss, CONFIG.limits)
    assert choice.has_failed == bool(error)
    assert backend.can_fail == (error is None)
    if error:
        assert (choice.device, choice.versions) == ("cpu", {})
        assert choice.reason == "the GPU Some GPU failed: the loss differs."
    else:
        assert (choice.device, choice.name) == ("cuda", "Some GPU")
        assert choice.versions == {"triton": "3"}
