"""Choice of the device on which the map is optimized."""

from dataclasses import replace

from ldo_service.kernels.gpu.arrays import Arrays
from ldo_service.kernels.gpu.device import DeviceChoice, choose_device, on_cpu

from .adam import AdamConfig
from .loss import LossWeights
from .optimizer_backend import CpuBackend, OptimizerBackend, ShapeLimits


def given(backend: OptimizerBackend) -> DeviceChoice:
    """Return the device choice that describes a backend given by the caller of the optimizer."""
    choice = on_cpu("the program chose it.")
    return replace(choice, device="cuda", name="GPU") if backend.can_fail else choice


def choose_backend(
    wanted: str, adam: AdamConfig, weights: LossWeights, limits: ShapeLimits
) -> tuple[OptimizerBackend, DeviceChoice]:
    """Return the backend of the Gaussian optimizer for the chosen device, and the device choice.

    A GPU is chosen if `wanted` is cuda or auto and the GPU passes the self-test. With auto, it must
    also have been faster in a saved benchmark; see `choose_device`. Otherwise, the CPU is chosen.

    Args:
        wanted: Setting `service.device`.
        adam: Settings of Adam.
        weights: Weights of the image loss.
        limits: Limits on the shape of the Gaussians.
    """

    def make(arrays: Arrays) -> OptimizerBackend:
        # Both modules import Triton, which is optional.
        from .gpu_backend import GpuBackend
        from .gpu_self_test import run_self_test

        run_self_test(arrays)
        return GpuBackend(arrays, adam, weights, limits)

    backend, choice = choose_device(wanted, "mapper", "the map is fitted", make)
    return backend or CpuBackend(adam, weights, limits), choice
