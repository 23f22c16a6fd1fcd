"""RGB-D frames as cameras deliver them and as the numerics read them.

A `RawFrame` is what a camera or a data set delivers; a `Rectifier` turns it into an `RgbdFrame`.
Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass
from math import isfinite

import cv2
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


Maps = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, slots=True)
class RawFrame:
    """Colour and depth registered to it, as a camera delivers them: distorted, in its own units.

    color       [H, W, 3] uint8 RGB
    depth       [H, W] uint16, float32 or float64; z in 1/depth_scale metres; 0, NaN, infinite or
                negative where not measured
    depth_scale units of `depth` per metre
    camera      with its lens distortion
    stamp_ns    time of the exposure
    Raises FrameError when the parts do not fit together.
    """

    index: int
    stamp_ns: int
    color: np.ndarray
    depth: np.ndarray
    depth_scale: float
    camera: Camera

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.color.dtype != np.uint8 or self.color.shape[2:] != (3,):
            raise FrameError(
                f"frame {self.index}: colour is {self.color.dtype}{self.color.shape}, "
                "expected uint8[H, W, 3] RGB."
            )
        if self.depth.dtype not in (np.uint16, np.float32, np.float64) or self.depth.ndim != 2:
            raise FrameError(
                f"frame {self.index}: depth is {self.depth.dtype}{self.depth.shape}, "
                "expected uint16[H, W] or float32[H, W]."
            )
        if self.color.shape[:2] != self.depth.shape:
            raise FrameError(
                f"frame {self.index}: colour is {_size(self.color)} and depth {_size(self.depth)} "
                "pixels. Register the depth into the colour camera before sending."
            )
        if self.depth.shape != size:
            raise FrameError(
                f"frame {self.index}: images are {_size(self.depth)} pixels and the intrinsics "
                f"are for {size[1]}x{size[0]}. Give the intrinsics of this resolution."
            )
        if not (isfinite(self.depth_scale) and self.depth_scale > 0):
            raise FrameError(
                f"frame {self.index}: depth_scale is {self.depth_scale}, expected the positive "
                "number of depth units per metre (1000 for millimetres)."
            )

    def depth_m(self) -> np.ndarray:
        """Depth [H, W] float32 in metres, 0 where not measured."""
        return in_meters(self.depth, self.depth_scale)


def in_meters(depth: np.ndarray, depth_scale: float) -> np.ndarray:
    """Depth [H, W] float32 in metres, 0 where `depth`, in 1/depth_scale metres, is no distance."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        depth_m = depth.astype(np.float32) / np.float32(depth_scale)
        depth_m[~((depth_m > 0) & (depth_m < np.inf))] = 0.0
    return depth_m


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def undistortion_maps(camera: Camera) -> Maps | None:
    """Where each rectified pixel lies in the distorted image: u, v [H, W]; None: nowhere else."""
    if not any(camera.distortion):
        return None
    K, coefficients = camera.matrix, np.array(camera.distortion)
    size = (camera.width, camera.height)
    u, v = cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    return u, v


def rectify(raw: RawFrame, maps: Maps | None) -> RgbdFrame:
    """Remove lens distortion and units, keeping the intrinsic matrix.

    `maps` are `undistortion_maps(raw.camera)`. Colour is interpolated bilinearly; depth takes the
    nearest pixel, since a mean across an edge is a surface that does not exist. Pixels that the
    lens did not see are black with depth 0. Without distortion the colour array is shared.
    """
    color, depth_m = raw.color, raw.depth_m()
    if maps is not None:
        color = cv2.remap(color, *maps, interpolation=cv2.INTER_LINEAR)
        depth_m = cv2.remap(depth_m, *maps, interpolation=cv2.INTER_NEAREST)
    return RgbdFrame(color, depth_m, raw.camera.rectified(), raw.stamp_ns, raw.index)


class Rectifier:
    """`rectify` with the maps of the last camera kept: a camera rarely changes."""

    def __init__(self) -> None:
        self._camera: Camera | None = None
        self._maps: Maps | None = None

    def __call__(self, raw: RawFrame) -> RgbdFrame:
        if raw.camera != self._camera:
            self._camera, self._maps = raw.camera, undistortion_maps(raw.camera)
        return rectify(raw, self._maps)
