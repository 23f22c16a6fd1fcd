"""Benchmark of a GPU and the CPU, which first checks that both give the same results.

The benchmark times an iteration of the Gaussian optimizer and an image alignment of the tracker.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.errors import DeviceError
from ldo_service.gaussians import Exposure, GaussianMap, LossWeights, TrainingView
from ldo_service.gaussians.adam import AdamConfig
from ldo_service.gaussians.gpu_backend import GpuBackend
from ldo_service.gaussians.gpu_self_test import iterate, require_equal, run_self_test
from ldo_service.gaussians.optimizer_backend import CpuBackend, OptimizerBackend, ShapeLimits
from ldo_service.geometry import Camera
from ldo_service.kernels.gpu.arrays import Arrays
from ldo_service.tracking import alignment_self_test
from ldo_service.tracking.alignment import AlignConfig, Linearizer, align, normal_equations
from ldo_service.tracking.gpu_equations import GpuEquations

from .iteration import Steps, medians_ms, noise_frame, walls

ADAM, WEIGHTS = AdamConfig(), LossWeights(l1=0.8, d_ssim=0.2, depth=1.0)
LIMITS = ShapeLimits(needle_weight=0.01, max_needle_ratio=4.0, max_sigma_px=20.0)
ALIGNED_PX = 320, 240  # Size of the finest level of the tracker.


@dataclass(frozen=True, slots=True)
class DeviceTimes:
    """Median times by stage in milliseconds, and the peak memory of the GPU.

    Attributes:
        cpu_ms: Times on the CPU. The stage "alignment" always aligns a frame of 320x240 pixels
            (`ALIGNED_PX`); the other stages use the size of the training image.
        gpu_ms: Times on the GPU. The host waits for the GPU at the end of each stage.
        gpu_mb: Peak memory of the arrays on the GPU, MB; 0 if Triton runs in its interpreter.
    """

    cpu_ms: dict[str, float]
    gpu_ms: dict[str, float]
    gpu_mb: float


def device_times(
    arrays: Arrays,
    n: int,
    camera: Camera,
    repeats: int,
    *,
    threads: int = 1,
    self_test_repeats: int = 20,
    clock: Callable[[], float] = time.perf_counter,
) -> DeviceTimes:
    """Measure an optimizer iteration and a frame alignment on GPU and CPU if their results agree.

    Args:
        arrays: Array operations of the GPU.
        n: Number of Gaussians in front of the camera.
        camera: Camera of the training image.
        repeats: Number of measurements of each stage; the results are their medians.
        threads: Number of CPU threads.
        self_test_repeats: Number of repetitions of the self-test.
        clock: Function that returns the time in seconds.

    Raises:
        DeviceError: The GPU fails, or its results differ from those of the CPU.
    """
    run_self_test(arrays, self_test_repeats)
    alignment_self_test.run_self_test(arrays, self_test_repeats)
    rows, (color, depth_m) = walls(n, camera), noise_frame(camera)
    view = TrainingView(0, camera, color, depth_m, np.eye(4))
    makers = (
        lambda: CpuBackend(ADAM, WEIGHTS, LIMITS, threads=threads),
        lambda: GpuBackend(arrays, ADAM, WEIGHTS, LIMITS),
    )
    try:
        wanted, got = (iterate(make(), rows, view) for make in makers)
        require_equal(got, wanted)
    except DeviceError as error:
        raise DeviceError(
            "the GPU failed or differed from the CPU in an iteration of the Gaussian optimizer at "
            f"{camera.width}x{camera.height} pixels with {n} Gaussians: {error} No times were "
            "measured. Use the CPU (`service.device=cpu`), and report the GPU model and its driver."
        ) from error
    steps = []
    for make in makers:
        gaussians, backend = GaussianMap(n), make()
        gaussians.add(rows, 0)
        backend.begin(gaussians)
        steps.append(stages(backend, view))
    iterations = [with_sum(times) for times in medians_ms(steps, repeats, clock)]
    alignments = medians_ms(alignment_steps(arrays), repeats, clock)
    cpu_ms, gpu_ms = (a | b for a, b in zip(iterations, alignments, strict=True))
    return DeviceTimes(cpu_ms, gpu_ms, arrays.peak_bytes() / 1e6)


def stages(backend: OptimizerBackend, view: TrainingView) -> Steps:
    """Return the stages of an optimizer iteration as functions by name.

    Each stage ends with a download from the GPU, so that its time includes all work of the GPU.
    """

    def rendering() -> None:
        backend.render(view, is_half=False)
        backend.estimate_exposure()

    def descent() -> None:
        backend.descend(Exposure(), rate=lambda _: 0.1)

    return {"rendering and exposure": rendering, "loss and step": descent}


def alignment_steps(arrays: Arrays) -> list[Steps]:
    """Return functions that align a new frame to known points: on the CPU, then on the GPU.

    Raises:
        DeviceError: The results of the GPU differ from those of the CPU.
    """
    reference, frame = scene = alignment_self_test.make_scene(*ALIGNED_PX)
    computed: list[Linearizer] = [normal_equations, GpuEquations(arrays).normal_equations]
    wanted, got = (alignment_self_test.outcome(scene, linearize) for linearize in computed)
    alignment_self_test.require_equal(got, wanted)

    def alignment(linearize: Linearizer) -> Callable[[], object]:
        def run() -> object:
            # A copy of the texels is uploaded, as those of each frame of a camera are.
            levels = [replace(level, texels=level.texels.copy()) for level in frame.levels]
            new = replace(frame, levels=tuple(levels))
            return align(reference, new, np.eye(4), AlignConfig(), linearize)

        return run

    return [{"alignment": alignment(linearize)} for linearize in computed]


def with_sum(times_ms: dict[str, float]) -> dict[str, float]:
    """Return the times by stage, and their sum under the key "iteration"."""
    return {**times_ms, "iteration": sum(times_ms.values())}
