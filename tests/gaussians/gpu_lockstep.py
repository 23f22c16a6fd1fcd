"""Backend that repeats each iteration of the GPU backend on the CPU, and compares the results."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ldo_service.gaussians import (
    GaussianMap,
    GaussianOptimizerConfig,
    ImageLoss,
    TrainingView,
    VisibleGaussians,
)
from ldo_service.gaussians.exposure import Exposure, estimate_exposure
from ldo_service.gaussians.loss import image_loss
from ldo_service.gaussians.optimizer_backend import CpuBackend, Rate
from ldo_service.gaussians.renderer import AdamStep, Rasterizer, RowGradients
from ldo_service.geometry import se3
from ldo_service.kernels import _adam
from tests.kernels.gpu.agreement import check, peak, relative
from tests.kernels.gpu.scenes import ARRAYS, descent, frame_loss, host
from tests.kernels.gpu.test_gradients import FIELDS, log_of_max_sigma

# A derivative below this fraction of the largest one in its column may have either sign. The
# parameter then moves in either direction, and its step is not compared.
CLEAR_RATIO = 1e-2
PARAMETERS = {group: columns for group, columns in FIELDS.items() if group != "weight"}


class Recorder:
    """Recorder of derivatives that stay on the device in an iteration.

    Attributes:
        by_planes: Derivatives of the last loss with respect to the planes, [5, H, W].
        by_rows: Derivatives of the last loss with respect to the visible Gaussians, [V, 16].
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.by_planes = self.by_rows = np.empty(0)
        self._loss = frame_loss.image_loss
        self._kernel = descent.projection_gradient.project_backward
        monkeypatch.setattr(frame_loss, "image_loss", self._image_loss)
        monkeypatch.setattr(descent, "projection_gradient", self)

    @property
    def project_backward(self) -> dict[tuple[int], Callable]:
        return _Launcher(self._project_backward)

    def _image_loss(self, *arguments: Any) -> tuple[Any, np.ndarray]:
        by_planes, means = self._loss(*arguments)
        self.by_planes = host(by_planes)
        return by_planes, means

    def _project_backward(self, grid: tuple[int], *arguments: Any, **constants: Any) -> None:
        """Launch the kernel twice: for the derivatives, and then for the step of Adam."""
        n_visible, parameters = arguments[5], list(arguments)
        parameters[9] = ARRAYS.empty((n_visible, 16), np.float32)
        self._kernel[grid](*parameters, **{**constants, "ADAM": False})
        self.by_rows = host(parameters[9])
        self._kernel[grid](*arguments, **constants)


class _Launcher(dict):
    """Kernel that calls a function with the grid and the arguments of each launch."""

    def __init__(self, function: Callable) -> None:
        self._function = function

    def __missing__(self, grid: tuple[int]) -> Callable:
        return lambda *arguments, **constants: self._function(grid, *arguments, **constants)


class LockstepBackend:
    """GPU backend of which each iteration is repeated in C++ from the same state.

    A difference of the last bit grows from step to step, because Adam divides each derivative by
    its own size. The C++ kernels therefore get rows, moments and step counts of the GPU before each
    iteration. The backend also checks that `begin` uploads the map, and that `end` downloads it,
    bit for bit.

    Attributes:
        gpu: The GPU backend.
        pairs: Number of pairs of a Gaussian and a tile in each iteration.
        halved: Number of iterations at half resolution.
    """

    can_fail = True
    threads = 1

    def __init__(self, config: GaussianOptimizerConfig, recorder: Recorder) -> None:
        from ldo_service.gaussians.gpu_backend import GpuBackend  # It imports Triton.

        self.gpu = GpuBackend(ARRAYS, config.adam, config.loss, config.limits)
        self.pairs: list[int] = []
        self.halved = 0
        self._config, self._recorder, self._rasterizer = config, recorder, Rasterizer()

    def begin(self, gaussians: GaussianMap) -> None:
        self._gaussians = gaussians
        self.gpu.begin(gaussians)
        self._require_equal("upload")

    def end(self) -> None:
        self.gpu.end()
        self._require_equal("download")

    def _require_equal(self, where: str) -> None:
        """Check that map and moments on the host equal those on the GPU."""
        state, saved = self._state(), self.gpu.snapshot()
        np.testing.assert_array_equal(state.rows, self._gaussians.rows, where)
        for name in ("mean", "square", "steps"):
            np.testing.assert_array_equal(getattr(state, name), saved[name], where)

    def _state(self) -> AdamStep:
        """Return copies of rows, moments and step counts of the GPU."""
        mirror, n, config = self.gpu.mirror, len(self._gaussians), self._config.adam
        arrays = mirror.rows, mirror.moments, mirror.squares, mirror.steps
        constants = config.rates(), config.beta1, config.beta2, config.epsilon
        return AdamStep(*(host(array)[:n] for array in arrays), *constants)

    def render(self, view: TrainingView, *, is_half: bool) -> None:
        self.gpu.render(view, is_half=is_half)
        self._image, self._binning = view.halved() if is_half else view, 2 if is_half else 1
        _, rendering, _ = self.gpu._last()
        self.pairs.append(len(rendering.lists.listed))
        self.halved += is_half
        self._where = f"iteration {len(self.pairs)}, keyframe {view.keyframe}"
        self._before, image = self._state(), self._image
        self._T_camera_map = se3.inverse(view.T_map_camera)
        self._planes = self._rasterizer.render(
            self._before.rows, image.camera, self._T_camera_map, binning=self._binning
        )
        got = host(rendering.planes)
        for k in range(5):
            check("planes to C++", peak(got[k], self._planes[k]), f"{self._where}, plane {k}")

    def estimate_exposure(self) -> Exposure | None:
        got, image, planes = self.gpu.estimate_exposure(), self._image, self._planes
        wanted = estimate_exposure(planes[:3], planes[4], image.color, image.mask)
        assert (got is None) == (wanted is None)
        if got is not None and wanted is not None:
            check("exposure of an iteration to C++", peak(got.matrix, wanted.matrix), self._where)
        return got

    def descend(self, exposure: Exposure, *, rate: Rate) -> tuple[ImageLoss, VisibleGaussians]:
        loss, visible = self.gpu.descend(exposure, rate=rate)
        by_planes, limits = self._compare_loss(loss, exposure), self._config.limits
        penalty = {"needle_weight": limits.needle_weight, "needle_ratio": limits.max_needle_ratio}
        wanted = self._rasterizer.gradients(by_planes, **penalty)
        self._compare_derivatives(visible, wanted)
        step = replace(self._before, rates=self._before.rates * np.float32(rate(loss)))
        self._compare_step_of_equal_derivatives(visible.indices, step)
        by_rows = wanted.rows.copy()
        max_sigma_px = limits.max_sigma_px / self._binning
        self._rasterizer.descend(by_planes, step, max_sigma_px=max_sigma_px, **penalty)
        self._compare_step(visible.indices, by_rows, step)
        return loss, visible

    def _compare_loss(self, loss: ImageLoss, exposure: Exposure) -> np.ndarray:
        """Compare loss and derivatives; return the derivatives [5, H, W] of the CPU."""
        image, got, wanted = self._image, self._recorder.by_planes, np.empty_like(self._planes)
        of_cpu = image_loss(
            self._planes,
            image.color,
            image.depth_m,
            exposure,
            self._config.loss,
            wanted,
            mask=image.mask,
        )
        for k in range(4):
            error = relative(got[k], wanted[k])
            check("derivatives of loss to C++", error, f"{self._where}, plane {k}")
        assert not got[4].any()
        for name in ("total", "l1", "d_ssim", "depth_m", "psnr_db"):
            error = abs(getattr(loss, name) / getattr(of_cpu, name) - 1)
            check("loss to C++", error, f"{self._where}, {name}")
        return wanted

    def _compare_derivatives(self, visible: VisibleGaussians, wanted: RowGradients) -> None:
        np.testing.assert_array_equal(visible.indices, wanted.indices)
        got = self._recorder.by_rows
        np.testing.assert_array_equal(visible.weights, got[:, 14] * self._binning**2)
        for group, columns in FIELDS.items():
            error = relative(got[:, columns], wanted.rows[:, columns])
            check("derivatives by rows to C++", error, f"{self._where}, {group}")
        check("derivative by pose to C++", relative(visible.xi, wanted.xi), self._where)

    def _compare_step_of_equal_derivatives(self, visible: np.ndarray, step: AdamStep) -> None:
        """Compare all rows with the C++ step for the derivatives that the GPU computed."""
        got, camera, by_rows = self._state(), self._image.camera, self._recorder.by_rows
        rows, mean, square = step.rows.copy(), step.mean.copy(), step.square.copy()
        steps, constants = step.steps.copy(), (step.rates, step.beta1, step.beta2, step.epsilon)
        _adam.adam_step(rows, mean, square, steps, visible, by_rows, *constants)
        is_moved = steps != step.steps
        max_sigma_px = self._config.limits.max_sigma_px / self._binning
        T, focal_px = self._T_camera_map.astype(np.float32).astype(float), max(camera.fx, camera.fy)
        limit = log_of_max_sigma(got.rows, T, focal_px, max_sigma_px)
        rows[is_moved, 3:6] = np.minimum(rows[:, 3:6], limit[:, None])[is_moved]
        for group, columns in PARAMETERS.items():
            error = peak(got.rows[:, columns], rows[:, columns])
            check("step of Adam to C++", error, f"{self._where}, {group}")
        np.testing.assert_array_equal(got.rows[~is_moved], step.rows[~is_moved])

    def _compare_step(self, visible: np.ndarray, by_rows: np.ndarray, wanted: AdamStep) -> None:
        """Compare with an iteration of the CPU: rows where its derivatives are clear, and state.

        Args:
            visible: Indices of the visible Gaussians, [V].
            by_rows: Derivatives that the CPU computed, [V, 16].
            wanted: Rows, moments and step counts after the iteration of the CPU.
        """
        got = self._state()
        np.testing.assert_array_equal(got.steps, wanted.steps)
        assert wanted.steps.any()
        is_clear = np.zeros(got.rows.shape, bool)
        is_clear[visible] = np.abs(by_rows) > CLEAR_RATIO * np.abs(by_rows).max(axis=0)
        for group, columns in PARAMETERS.items():
            where, chosen = f"{self._where}, {group}", is_clear[:, columns]
            rows = (state.rows[:, columns][chosen] for state in (got, wanted))
            check("rows of an iteration to C++", peak(*rows), where)
            for kind in ("mean", "square"):
                of_gpu, of_cpu = (getattr(state, kind)[:, columns] for state in (got, wanted))
                check("moments of an iteration to C++", relative(of_gpu, of_cpu), where)

    def on_cpu(self) -> CpuBackend:
        return self.gpu.on_cpu()

    def steps(self, gaussians: GaussianMap) -> np.ndarray:
        return self.gpu.steps(gaussians)

    def snapshot(self) -> dict[str, np.ndarray]:
        return self.gpu.snapshot()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self.gpu.restore(state)
