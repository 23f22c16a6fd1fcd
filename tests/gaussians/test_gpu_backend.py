"""Optimization through the GPU backend in the interpreter of Triton, compared with the C++."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.gaussians import (
    GaussianMap,
    GaussianOptimizer,
    GaussianOptimizerConfig,
    TrainingView,
    densify,
)
from ldo_service.geometry import se3
from ldo_service.kernels.gpu.arrays import HostArray
from tests.gaussians.conftest import FEW, halved, window
from tests.kernels.gpu.agreement import check
from tests.kernels.gpu.scenes import FilledArrays, descent, frame_loss, plane_rendering

from tests.gaussians.gpu_lockstep import LockstepBackend, Recorder  # isort: skip  # Triton.

CONFIG = GaussianOptimizerConfig(half_share=0.2, usual_reach=500)


@pytest.fixture(autouse=True)
def _setting(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Halve small images, launch few large programs, and compute without warnings."""
    monkeypatch.setattr("ldo_service.gaussians.optimizer.MIN_HALVED_PX", 32)
    monkeypatch.setattr("ldo_service.gaussians.exposure.MIN_BLOCK_PX", 4)
    monkeypatch.setattr(plane_rendering, "LANES", 1024)
    monkeypatch.setattr(descent, "LANES", 1024)
    monkeypatch.setattr(frame_loss, "PIXEL_LANES", 4096)
    with np.errstate(all="ignore"):
        yield


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    return Recorder(monkeypatch)


class Mapping:
    """A map of the room, which grows and shrinks between plans of the optimizer.

    With a recorder, the GPU runs the plans, and the CPU repeats each iteration.
    """

    def __init__(self, room: Sequence, size: int, recorder: Recorder | None = None) -> None:
        self.room, self.size, self.recorder = room, size, recorder
        self.gaussians, self.views = GaussianMap(), {}
        self.optimizer = self.new_optimizer()
        self.losses: list[float] = []
        self.weights: list[float] = []

    def new_optimizer(self) -> GaussianOptimizer:
        if self.recorder is None:
            return GaussianOptimizer(CONFIG)
        self.backend = LockstepBackend(CONFIG, self.recorder)
        return GaussianOptimizer(CONFIG, backend=self.backend)

    def insert(self, index: int) -> None:
        frame = window(halved(self.room[index]), self.size)
        T_map_camera = self.room.truth().T_world_camera[index]
        densify(self.gaussians, frame, T_map_camera, index, FEW)
        view = TrainingView.of(frame, T_map_camera, index)
        if index:  # The camera sees later frames darker.
            view = replace(view, color=(view.color * 0.9).astype(np.uint8))
        self.views[index] = view

    def fit(self, plan: list[int]) -> None:
        effort = 0.6 * len(plan)  # Enough for all iterations; the first ones are halved.
        losses = self.optimizer.optimize(
            self.gaussians,
            self.views,
            plan,
            fixed=0,
            effort=effort,
            after_keyframe=True,
            observe=lambda _, visible: self.weights.append(float(visible.weights.sum())),
        )
        assert len(losses) == len(plan)
        self.losses += [loss.total for loss in losses]

    def restart(self) -> None:
        """Continue with the state of a snapshot."""
        self.continue_from(self)

    def continue_from(self, other: "Mapping") -> None:
        """Continue with map, views and moments of another mapping, in a new optimizer."""
        saved, moments = other.gaussians.snapshot(), other.optimizer.snapshot()
        self.gaussians, self.views = GaussianMap.restore(saved), dict(other.views)
        self.optimizer = self.new_optimizer()
        self.optimizer.restore(moments)

    def run(self, plans: list[list[int]]) -> None:
        """Run three plans, with insertion, pruning, offloading and a snapshot in between."""
        first, second, third = plans
        self.insert(0)
        self.insert(4)
        self.fit(first)
        self.gaussians.remove(self.gaussians.ids % 17 == 3)
        offloaded = self.gaussians.extract(self.gaussians.ids % 11 == 5)
        self.insert(8)
        self.fit(second)
        self.restart()
        self.gaussians.reinsert(*offloaded)
        self.gaussians.move_anchors({4: se3.exp(np.array([0, 0.002, 0, 0.001, 0, 0]))})
        self.fit(third)


def run_both(room: Sequence, recorder: Recorder, size: int, plans: list[list[int]]) -> Mapping:
    """Run plans on both backends, compare the results, and return the GPU's mapping."""
    cpu, gpu = Mapping(room, size), Mapping(room, size, recorder)
    cpu.run(plans)
    gpu.run(plans)
    compare(gpu, cpu)
    return gpu


def compare(gpu: Mapping, cpu: Mapping) -> None:
    """Compare map, exposures, moments and losses of two mappings."""
    name = f"{cpu.size}x{cpu.size}"
    assert len(gpu.losses) == len(cpu.losses)
    losses = np.array(gpu.losses) / cpu.losses - 1
    check("loss in ten iterations", np.abs(losses).max(), name)
    np.testing.assert_allclose(gpu.weights, cpu.weights, rtol=1e-3)
    np.testing.assert_array_equal(gpu.gaussians.ids, cpu.gaussians.ids)
    np.testing.assert_array_equal(gpu.gaussians.anchors, cpu.gaussians.anchors)
    gains = np.array([view.exposure.gain for view in cpu.views.values()])
    assert np.abs(gains[1:] - 1).max() > 0.01
    for index, view in cpu.views.items():
        error = np.abs(gpu.views[index].exposure.matrix - view.exposure.matrix).max()
        check("exposure after ten iterations", error, f"{name}, keyframe {index}")
    difference = np.abs(gpu.gaussians.rows - cpu.gaussians.rows)
    spread = cpu.gaussians.rows[:, :14].std(axis=0)
    check("rows after ten iterations", (difference[:, :14] / spread).mean(), name)
    check("median of rows after ten iterations", np.median(difference[:, :14] / spread), name)
    saved, wanted = gpu.optimizer.snapshot(), cpu.optimizer.snapshot()
    assert saved.keys() == wanted.keys()
    np.testing.assert_array_equal(saved["ids"], wanted["ids"])
    assert np.mean(saved["steps"] != wanted["steps"]) < 0.01
    assert gpu.gaussians.version > 0


def test_iterations_on_a_small_window_agree_with_the_cpu(
    room: Sequence, recorder: Recorder
) -> None:
    gpu = run_both(room, recorder, 32, [[4], [8], [4, 0, 4]])
    mirror = gpu.backend.gpu.mirror
    assert 0 < mirror.downloaded <= len(gpu.gaussians)


@pytest.mark.slow
@pytest.mark.timeout(3600)  # It takes a minute of CPU time.
def test_ten_iterations_through_the_mirror_agree_with_the_cpu(
    room: Sequence, recorder: Recorder
) -> None:
    gpu = run_both(room, recorder, 32, [[4, 0, 4, 4], [8, 0, 8], [8, 4, 8]])
    assert len(gpu.losses) == 10


class PoisonedArrays(FilledArrays):
    """Arrays of a device that downloads NaN in the first value of the arrays of one width."""

    def __init__(self, width: int) -> None:
        self.width = width

    def download(self, array: HostArray) -> np.ndarray:
        values = super().download(array)
        if values.shape[1:] == (self.width,):
            values[0, 0] = np.nan
        return values


class PoisonedMapping(Mapping):
    """A map on a GPU with `PoisonedArrays`."""

    def __init__(self, room: Sequence, size: int, width: int) -> None:
        self.arrays = PoisonedArrays(width)
        super().__init__(room, size)

    def new_optimizer(self) -> GaussianOptimizer:
        from ldo_service.gaussians.gpu_backend import GpuBackend  # It imports Triton.

        backend = GpuBackend(self.arrays, CONFIG.adam, CONFIG.loss, CONFIG.limits)
        return GaussianOptimizer(CONFIG, backend=backend)


@pytest.mark.slow
@pytest.mark.parametrize(("what", "width"), [("rows of the map", 16), ("loss", 8)])
def test_cpu_repeats_a_plan_whose_results_are_nan(
    room: Sequence, what: str, width: int, caplog: pytest.LogCaptureFixture
) -> None:
    cpu, gpu = Mapping(room, 32), PoisonedMapping(room, 32, width)
    for mapping in (cpu, gpu):
        mapping.insert(0)
        mapping.insert(4)
        mapping.fit([4])
    assert gpu.optimizer.device.metrics() == {"device_failed": 1, "on_gpu": 0}
    assert f"the GPU computed NaN or infinity in the {what}" in caplog.text
    assert "no keyframe is lost" in caplog.text
    assert gpu.losses == cpu.losses
    np.testing.assert_array_equal(gpu.gaussians.rows, cpu.gaussians.rows)
    for name, values in cpu.optimizer.snapshot().items():
        np.testing.assert_array_equal(gpu.optimizer.snapshot()[name], values)


@pytest.mark.slow
@pytest.mark.timeout(3600)  # It takes three minutes of CPU time.
def test_plan_of_a_keyframe_agrees_with_the_cpu_in_each_iteration(
    room: Sequence, recorder: Recorder
) -> None:
    """The map has moments and step counts of earlier plans, and new Gaussians of the keyframe."""
    cpu, gpu = Mapping(room, 64), Mapping(room, 64, recorder)
    cpu.insert(0)
    cpu.insert(4)
    cpu.fit([4, 0, 4])
    cpu.insert(8)
    gpu.continue_from(cpu)
    cpu.restart()
    cpu.losses, cpu.weights = [], []
    plan = [8, 8, 0, 8, 4, 8, 8, 0, 8, 4]
    for mapping in (cpu, gpu):
        mapping.fit(plan)
    compare(gpu, cpu)
    assert len(gpu.backend.pairs) == 10
    assert min(gpu.backend.pairs) > 200
    assert 0 < gpu.backend.halved < 10


def test_images_are_uploaded_again_if_they_changed(room: Sequence, recorder: Recorder) -> None:
    mapping = Mapping(room, 32, recorder)
    mapping.insert(0)
    view, backend = mapping.views[0], mapping.backend.gpu
    first = backend._frame(view, is_half=False)
    assert backend._frame(replace(view, T_map_camera=np.eye(4)), is_half=False) is first
    assert backend._frame(view, is_half=True) is not first
    masked = replace(view, mask=np.zeros((32, 32), np.uint8))
    assert backend._frame(masked, is_half=False).image.measured == 0
    assert backend._frame(view, is_half=False) is not first
