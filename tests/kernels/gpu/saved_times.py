"""Saved results of a benchmark, for tests of the choice of a device.

The environment variable LDO_CACHE names the folder of the test.
"""

from ldo_service.kernels.gpu.benchmark_result import BenchmarkResult, save_result
from ldo_service.kernels.gpu.device import Gpu


def save_times(gpu: Gpu, cpu_ms: dict[str, float], gpu_ms: dict[str, float]) -> None:
    """Save the times of a GPU that has passed."""
    save_result(
        BenchmarkResult(
            gpu=gpu.name,
            versions=gpu.versions_and_ours,
            scene="640x480 pixels",
            cpu_ms=cpu_ms,
            gpu_ms=gpu_ms,
        )
    )


def save_failure(gpu: Gpu, error: str) -> None:
    """Save the failure of a GPU."""
    versions = gpu.versions_and_ours
    save_result(BenchmarkResult(gpu=gpu.name, versions=versions, scene="", error=error))
