"""One RGB-D frame as the numerics see it. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import FrameError

from .camera import Camera


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """Colour and depth on one pixel grid, from one rectified camera.

    color    [H, W, 3] uint8 RGB
    depth_m  [H, W] float32, z in metres, 0 where not measured
    stamp_ns time of the exposure
    index    running number in its source
    Raises FrameError when the arrays do not fit the camera or depth is NaN or negative.
    """

    color: np.ndarray
    depth_m: np.ndarray
    camera: Camera
    stamp_ns: int = 0
    index: int = 0

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.color.shape != (*size, 3) or self.color.dtype != np.uint8:
            raise FrameError(
                f"frame {self.index}: colour is {self.color.dtype}{self.color.shape}, "
                f"its camera says uint8{(*size, 3)}."
            )
        if self.depth_m.shape != size or self.depth_m.dtype != np.float32:
            raise FrameError(
                f"frame {self.index}: depth is {self.depth_m.dtype}{self.depth_m.shape}, "
                f"its camera says float32{size}."
            )
        lowest, highest = float(self.depth_m.min()), float(self.depth_m.max())
        if not (lowest >= 0.0 and highest < np.inf):  # NaN fails every comparison
            raise FrameError(
                f"frame {self.index}: depth must be finite and at least 0 (0 = not measured)."
            )
