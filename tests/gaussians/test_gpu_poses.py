"""Refinement of keyframe poses through the GPU backend, compared with the C++."""

from collections.abc import Iterator

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
from tests.gaussians.conftest import FEW, halved, window
from tests.kernels.gpu.agreement import check
from tests.kernels.gpu.scenes import ARRAYS, descent, frame_loss, plane_rendering

CONFIG = GaussianOptimizerConfig(
    half_share=0.2, usual_reach=500, rotation_rate_rad=1e-3, translation_rate_m=1e-3
)
SIZE = 32
PLAN = [4, 4, 0, 4, 8, 4, 8, 0, 4, 8]  # Keyframe 0 stays fixed.
SHIFT = np.array([0.004, -0.003, 0.002, 0.003, 0.004, -0.003])  # Error of the poses, rad and m.


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


class Refined:
    """A map of three keyframes with wrong poses, after the plan has refined the poses."""

    def __init__(self, room: Sequence, plan: list[int], *, on_gpu: bool) -> None:
        self.gaussians, self.before = GaussianMap(), {}
        views: dict[int, TrainingView] = {}
        for keyframe in (0, 4, 8):
            frame = window(halved(room[keyframe]), SIZE)
            T_map_camera = room.truth().T_world_camera[keyframe]
            densify(self.gaussians, frame, T_map_camera, keyframe, FEW)
            if keyframe:
                T_map_camera = T_map_camera @ se3.exp(SHIFT)
            views[keyframe] = TrainingView.of(frame, T_map_camera, keyframe)
            self.before[keyframe] = T_map_camera
        self.optimizer = self.new_optimizer(on_gpu=on_gpu)
        losses = self.optimizer.optimize(
            self.gaussians, views, plan, fixed=0, effort=0.6 * len(plan), after_keyframe=True
        )
        assert len(losses) == len(plan)
        self.losses = np.array([loss.total for loss in losses])
        self.poses = {keyframe: view.T_map_camera for keyframe, view in views.items()}

    @staticmethod
    def new_optimizer(*, on_gpu: bool) -> GaussianOptimizer:
        if not on_gpu:
            return GaussianOptimizer(CONFIG)
        from ldo_service.gaussians.gpu_backend import GpuBackend  # It imports Triton.

        backend = GpuBackend(ARRAYS, CONFIG.adam, CONFIG.loss, CONFIG.limits)
        return GaussianOptimizer(CONFIG, backend=backend)

    def motion(self, keyframe: int) -> np.ndarray:
        """Return rotation and translation of a keyframe by the plan, [6]."""
        return se3.log(se3.inverse(self.before[keyframe]) @ self.poses[keyframe])


@pytest.mark.slow
@pytest.mark.timeout(3600)  # It takes a minute of CPU time.
def test_ten_iterations_refine_poses_as_on_the_cpu(room: Sequence) -> None:
    cpu, gpu = (Refined(room, PLAN, on_gpu=on_gpu) for on_gpu in (False, True))
    assert gpu.optimizer.device.device == "cuda"
    name = f"{SIZE}x{SIZE}, poses"
    check("loss in ten iterations", np.abs(gpu.losses / cpu.losses - 1).max(), name)
    np.testing.assert_array_equal(gpu.poses[0], gpu.before[0])
    for keyframe in (4, 8):
        wanted = cpu.motion(keyframe)
        assert np.abs(wanted).max() > 1e-3
        error = np.linalg.norm(gpu.motion(keyframe) - wanted) / np.linalg.norm(wanted)
        check("motion of poses in ten iterations", error, f"{name}, keyframe {keyframe}")
    saved, expected = gpu.optimizer.snapshot(), cpu.optimizer.snapshot()
    np.testing.assert_array_equal(saved["keyframes"], expected["keyframes"])
    moments, wanted = saved["keyframe_moments"], expected["keyframe_moments"]
    np.testing.assert_array_equal(moments[:, 2], wanted[:, 2])  # Numbers of steps.
    for k in range(2):
        error = np.linalg.norm(moments[:, k] - wanted[:, k]) / np.linalg.norm(wanted[:, k])
        check("moments of poses in ten iterations", error, f"{name}, moment {k + 1}")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_order_of_the_programs_does_not_change_poses(
    room: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    from triton.runtime.interpreter import interpreter_builder

    monkeypatch.setattr(descent, "LANES", 32)  # More programs, whose sums the pose adds.
    forward = Refined(room, [4, 8, 4], on_gpu=True)
    set_place, is_moved = interpreter_builder.set_grid_idx, []

    def set_reversed(x: int, y: int, z: int) -> None:
        last = interpreter_builder.grid_dim[0] - 1
        is_moved.append(last > 0)
        set_place(last - x, y, z)

    monkeypatch.setattr(interpreter_builder, "set_grid_idx", set_reversed)
    backward = Refined(room, [4, 8, 4], on_gpu=True)
    assert sum(is_moved) > 20
    for keyframe, T_map_camera in forward.poses.items():
        np.testing.assert_array_equal(backward.poses[keyframe], T_map_camera)
    for name, values in forward.optimizer.snapshot().items():
        np.testing.assert_array_equal(backward.optimizer.snapshot()[name], values)
    np.testing.assert_array_equal(backward.gaussians.rows, forward.gaussians.rows)
