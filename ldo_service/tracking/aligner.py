"""Direct alignment on the device that the tracker uses.

Conventions: `ldo_service.geometry`.
"""

import logging
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ldo_service.errors import DeviceError
from ldo_service.kernels.gpu.arrays import Arrays
from ldo_service.kernels.gpu.device import DeviceChoice, choose_device, on_cpu

from .alignment import (
    AlignConfig,
    Alignment,
    BrightnessModel,
    Linearizer,
    NormalEquations,
    ResidualConfig,
    align,
    normal_equations,
)
from .pyramid import Level, Pyramid, ReferencePoints

log = logging.getLogger(__name__)
Found = TypeVar("Found")


class Aligner:
    """Direct alignment on a GPU or on the CPU.

    If a GPU fails, the CPU repeats the current alignment and computes all later ones. The results
    of the CPU do not depend on earlier alignments.

    Args:
        on_gpu: Function that computes normal equations on a GPU and raises DeviceError if the GPU
            fails; None for the CPU.
        device: Device of the alignment, with the reason for its choice. None means the CPU.

    Attributes:
        device: Device of the alignment, with the reason for its choice.
    """

    def __init__(
        self, on_gpu: Linearizer | None = None, device: DeviceChoice | None = None
    ) -> None:
        self._on_gpu = on_gpu
        self.device = device or on_cpu("the program chose it.")

    def align(
        self,
        reference: ReferencePoints,
        frame: Pyramid,
        T_camera_reference: np.ndarray,
        config: AlignConfig,
    ) -> Alignment:
        """Align a frame to reference points; see `alignment.align`."""
        return self._computed(
            lambda linearize: align(reference, frame, T_camera_reference, config, linearize)
        )

    def linearize(
        self,
        points: np.ndarray,
        target: Level,
        T_camera_reference: np.ndarray,
        appearance: BrightnessModel,
        config: ResidualConfig,
    ) -> NormalEquations:
        """Linearize the residuals of a given pose; see `alignment.normal_equations`."""
        return self._computed(
            lambda linearize: linearize(points, target, T_camera_reference, appearance, config)
        )

    def _computed(self, compute: Callable[[Linearizer], Found]) -> Found:
        if self._on_gpu is not None:
            try:
                return compute(self._on_gpu)
            except DeviceError as error:
                self._continue_on_cpu(error)
        return compute(normal_equations)

    def _continue_on_cpu(self, error: DeviceError) -> None:
        self._on_gpu, self.device = None, self.device.failed(error)
        log.error(
            "tracker: %s The CPU aligns frames from now on, and no frame is lost. Restart the "
            "service to use the GPU again.",
            self.device.reason,
            exc_info=error.__cause__,
        )


def choose_aligner(wanted: str) -> Aligner:
    """Choose a device, and return the direct alignment on it.

    A GPU aligns frames if it passes the self-test. With auto, it must also have been faster in a
    saved benchmark; see `choose_device`.

    Args:
        wanted: Setting `service.device`.
    """

    def make(arrays: Arrays) -> Linearizer:
        # Both modules import Triton, which is optional.
        from .alignment_self_test import run_self_test
        from .gpu_equations import GpuEquations

        run_self_test(arrays)
        return GpuEquations(arrays).normal_equations

    return Aligner(*choose_device(wanted, "tracker", "frames are aligned", make))


CPU_ALIGNER = Aligner()  # It has no state.
