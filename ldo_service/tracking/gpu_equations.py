"""Normal equations of direct alignment on a GPU; experimental.

Conventions: `ldo_service.geometry`.
"""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any
from weakref import ref

import numpy as np

from ldo_service.errors import DeviceError
from ldo_service.kernels.gpu.arrays import Arrays
from ldo_service.kernels.gpu.device import device_errors
from ldo_service.kernels.gpu.equation_sums import (
    CELLS,
    Points,
    Texels,
    problem_of,
    strip_cells,
    sum_equations,
)

from .alignment import (
    BrightnessModel,
    NormalEquations,
    ResidualConfig,
    ResidualStatistics,
    normal_equations,
)
from .pyramid import Level

# Number of arrays that stay on the device. The largest one, the points at 320x240 pixels, has 2.2
# MB.
MAX_ARRAYS = 64
UPPER = np.triu_indices(8)
NO_POINTS = np.zeros((7, 0), np.float32)


class GpuEquations:
    """Normal equations by the kernels of `kernels.gpu`.

    The points, texels and cells of a call stay on the device as long as their arrays exist on the
    host. A call uploads only the arrays that the device lacks, and 100 bytes of parameters. It
    downloads 51 sums. A call with `cells` also downloads 896 gradient values, 14 for each of the 64
    possible image cells.

    The results are bitwise equal on one GPU model and one version of Triton. GPU and CPU
    results differ in the last bits. Residuals whose point, gray level or normal is not finite are
    excluded from the sums.

    Args:
        arrays: Arrays of the device.

    Attributes:
        uploaded: Number of arrays that were uploaded so far.
    """

    def __init__(self, arrays: Arrays) -> None:
        self._arrays = arrays
        self._resident: OrderedDict[tuple[str, int], tuple[ref[np.ndarray], Any]] = OrderedDict()
        self.uploaded = 0

    def normal_equations(
        self,
        points: np.ndarray,
        target: Level,
        T_camera_reference: np.ndarray,
        appearance: BrightnessModel,
        config: ResidualConfig,
        cells: np.ndarray | None = None,
    ) -> NormalEquations:
        """Linearize the residuals of reference points; see `alignment.normal_equations`.

        Do not change the contents of passed arrays later: the device would use an outdated copy.

        Raises:
            ValueError: An array has a wrong shape, or the transform is not rigid.
            DeviceError: The device failed, or it returned NaN or infinity.
        """
        # The CPU checks the arguments: it takes no points, so this costs microseconds.
        normal_equations(NO_POINTS, target, T_camera_reference, appearance, config)
        if points.ndim != 2 or len(points) != 7 or points.dtype != np.float32:
            raise ValueError(f"points must be [7, N] float32, not {points.shape} {points.dtype}.")
        if cells is not None and (len(cells) != points.shape[1] or (cells >= CELLS).any()):
            raise ValueError("cells must have one cell number per point, each below 64.")
        problem = problem_of(
            T_camera_reference,
            target.intrinsics,
            (appearance.gain, appearance.bias, appearance.intensity_sigma),
            (appearance.depth_noise_scale, *config.noise.coefficients),
            config.gate,
            config.occlusion,
        )
        height, width = target.texels.shape[:2]
        with device_errors("alignment"):
            sums, by_cell = sum_equations(
                self._arrays,
                Points(self._on_device("points", points), points.shape[1]),
                Texels(self._on_device("texels", target.texels), width, height),
                problem,
                None if cells is None else self._on_device("cells", cells, strip_cells),
            )
        if not (np.isfinite(sums).all() and np.isfinite(by_cell).all()):
            # The CPU repeats the alignment. The next pose would not be rigid, and the frame lost.
            raise DeviceError(
                "the GPU computed NaN or infinity in the alignment. If this happens again, set "
                "service.device=cpu."
            )
        return _equations(sums, by_cell)

    def _on_device(
        self,
        kind: str,
        values: np.ndarray,
        convert: Callable[[np.ndarray], np.ndarray] = np.ascontiguousarray,
    ) -> Any:
        """Return the copy of converted host values on the device; upload it if it is not there."""
        key = (kind, id(values))
        known = self._resident.get(key)
        if known is None or known[0]() is not values:
            # The copy goes with the array of the host, whose id may then belong to another one. A
            # weak reference to the copies frees them at once after a failure of the device.
            copies = ref(self._resident)
            forget = ref(values, lambda _: (copies() or {}).pop(key, None))
            known = self._resident[key] = forget, self._arrays.upload(convert(values))
            self.uploaded += 1
        self._resident.move_to_end(key)
        if len(self._resident) > MAX_ARRAYS:
            self._resident.popitem(last=False)
        return known[1]


def _equations(sums: np.ndarray, by_cell: np.ndarray) -> NormalEquations:
    hessian = np.zeros((8, 8))
    hessian[UPPER] = hessian.T[UPPER] = sums[:36]
    visible, *counts = sums[44:].tolist()
    return NormalEquations(
        hessian,
        sums[36:44],
        visible,
        ResidualStatistics(*counts[:3]),
        ResidualStatistics(*counts[3:]),
        by_cell,
    )
