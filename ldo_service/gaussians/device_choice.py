"""Choice of the device on which the map is optimized."""

import logging
from dataclasses import dataclass, field, replace
from typing import Literal

from ldo_service.errors import DeviceError
from ldo_service.kernels import isa
from ldo_service.kernels.gpu.device import device_errors, find_gpu

from .adam import AdamConfig
from .loss import LossWeights
from .optimizer_backend import CpuBackend, OptimizerBackend, ShapeLimits

log = logging.getLogger(__name__)

Device = Literal["auto", "cpu", "cuda", "openvino"]


@dataclass(frozen=True, slots=True)
class DeviceChoice:
    """Device on which the map is optimized.

    Attributes:
        device: cpu or cuda.
        reason: Sentence that says why.
        name: Instruction set of the CPU, or model of the GPU.
        versions: Versions that determine the bits of the results; empty on the CPU.
        has_failed: A GPU was found or asked for, and the CPU replaces it.
    """

    device: str
    reason: str
    name: str
    versions: dict[str, str] = field(default_factory=dict)
    has_failed: bool = False

    def failed(self, error: DeviceError) -> "DeviceChoice":
        """Return the choice after a failure of the GPU."""
        return replace(on_cpu(f"the GPU {self.name} failed: {error}"), has_failed=True)

    def metrics(self) -> dict[str, float]:
        """Return `device_failed` (1 if the CPU replaces a GPU) and `on_gpu` (1 on a GPU)."""
        return {"device_failed": float(self.has_failed), "on_gpu": float(self.device == "cuda")}


def on_cpu(reason: str) -> DeviceChoice:
    """Return the choice of the CPU."""
    return DeviceChoice("cpu", reason, isa())


def given(backend: OptimizerBackend) -> DeviceChoice:
    """Return the choice of a backend that the caller of the optimizer has chosen."""
    choice = on_cpu("the program chose it.")
    return replace(choice, device="cuda", name="GPU") if backend.can_fail else choice


def choose_backend(
    wanted: str, adam: AdamConfig, weights: LossWeights, limits: ShapeLimits
) -> tuple[OptimizerBackend, DeviceChoice]:
    """Choose a device, and return its backend of the optimizer.

    A GPU is used if `wanted` is cuda or auto, and if the GPU passes the self-test. The CPU replaces
    a GPU that is missing or fails.

    Args:
        wanted: Setting `service.device`.
        adam: Settings of Adam.
        weights: Weights of the image loss.
        limits: Limits on the shape of the Gaussians.
    """
    backend = CpuBackend(adam, weights, limits)
    if wanted not in ("auto", "cuda"):
        return backend, on_cpu(f"service.device={wanted} was chosen.")
    try:
        gpu = find_gpu()
    except DeviceError as error:
        choice = replace(on_cpu(str(error)), has_failed=wanted == "cuda")
        if choice.has_failed:
            log.warning("mapper: no GPU can be used, so the map is fitted on the CPU: %s", error)
        return backend, choice
    try:
        with device_errors("self-test"):
            # Both modules import Triton, which is optional.
            from .gpu_backend import GpuBackend
            from .gpu_self_test import run_self_test

            run_self_test(gpu.arrays)
            on_gpu = GpuBackend(gpu.arrays, adam, weights, limits)
    except DeviceError as error:
        choice = DeviceChoice("cuda", "", gpu.name).failed(error)
        log.warning(
            "mapper: %s The map is fitted on the CPU.", choice.reason, exc_info=error.__cause__
        )
        return backend, choice
    reason = "the GPU passed the self-test."
    choice = DeviceChoice("cuda", reason, gpu.name, gpu.versions)
    log.info("mapper: the map is fitted on %s (experimental): %s", gpu.name, reason)
    return on_gpu, choice
