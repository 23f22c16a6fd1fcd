"""RGB-D frames before and after rectification.

A camera or a data set delivers a `RawFrame`; a `Rectifier` converts it to an `RgbdFrame`.
Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass
from math import isfinite

import cv2
import numpy as np

from ldo_service.errors import FrameError

from .camera import Camera

# Depth from which on a value means "not measured", meters. Depth cameras measure up to 100 m. Some
# simulators write their far plane, 1e30 or the largest float where they measured nothing.
MAX_DEPTH_M = 1000.0
# Depth below which a value means "not measured", meters. It is the smallest depth of an image in
# millimeters. The inverse of a much smaller depth, multiplied by a focal length, has no float32.
MIN_DEPTH_M = 0.001


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """Rectified frame: color and depth on one pixel grid.

    Raises:
        FrameError: An array does not fit the camera, or depth is NaN, infinite or negative.
    """

    color: np.ndarray  # [H, W, 3] uint8 RGB.
    depth_m: np.ndarray  # [H, W] float32, z in meters; 0 where not measured.
    camera: Camera
    stamp_ns: int = 0  # Time of the exposure.
    index: int = 0  # Running number of the frame in its source.

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.color.shape != (*size, 3) or self.color.dtype != np.uint8:
            raise FrameError(
                f"frame {self.index}: color is {self.color.dtype}{self.color.shape}, "
                f"expected uint8{(*size, 3)} to fit the intrinsics."
            )
        if self.depth_m.shape != size or self.depth_m.dtype != np.float32:
            raise FrameError(
                f"frame {self.index}: depth is {self.depth_m.dtype}{self.depth_m.shape}, "
                f"expected float32{size} to fit the intrinsics."
            )
        lowest, highest = float(self.depth_m.min()), float(self.depth_m.max())
        if not (lowest >= 0.0 and highest < MAX_DEPTH_M):  # NaN fails each comparison.
            raise FrameError(
                f"frame {self.index}: depth is {lowest:g} to {highest:g} m, must be finite, at "
                f"least 0 and below {MAX_DEPTH_M:g}. Set pixels without a measurement to 0."
            )


Maps = tuple[np.ndarray, np.ndarray]  # Results of `undistortion_maps`.


@dataclass(frozen=True, slots=True)
class RawFrame:
    """Unrectified frame of a camera: color with lens distortion, and depth on its pixel grid.

    Raises:
        FrameError: The images, the camera and the depth scale do not fit together.
    """

    index: int  # Running number of the frame in its source.
    stamp_ns: int  # Time of the exposure.
    color: np.ndarray  # [H, W, 3] uint8 RGB.
    # [H, W] uint16, float32 or float64, z in 1/depth_scale meters; NaN, below MIN_DEPTH_M or at
    # least MAX_DEPTH_M where not measured.
    depth: np.ndarray
    depth_scale: float  # Units of `depth` per meter.
    camera: Camera  # Intrinsics with lens distortion.

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.color.dtype != np.uint8 or self.color.shape[2:] != (3,):
            raise FrameError(
                f"frame {self.index}: color is {self.color.dtype}{self.color.shape}, "
                "expected uint8[H, W, 3] RGB."
            )
        if self.depth.dtype not in (np.uint16, np.float32, np.float64) or self.depth.ndim != 2:
            raise FrameError(
                f"frame {self.index}: depth is {self.depth.dtype}{self.depth.shape}, "
                "expected uint16[H, W], float32[H, W] or float64[H, W]."
            )
        if self.color.shape[:2] != self.depth.shape:
            raise FrameError(
                f"frame {self.index}: color is {_size(self.color)} and depth {_size(self.depth)} "
                "pixels. Register the depth to the color camera before sending it."
            )
        if self.depth.shape != size:
            raise FrameError(
                f"frame {self.index}: images are {_size(self.depth)} pixels and the intrinsics "
                f"are for {size[1]}x{size[0]}. Use intrinsics for the size of the images."
            )
        if not (isfinite(self.depth_scale) and self.depth_scale > 0):
            raise FrameError(
                f"frame {self.index}: depth_scale is {self.depth_scale}, expected the positive "
                "number of depth units per meter (1000 for millimeters)."
            )

    def depth_m(self) -> np.ndarray:
        """Return the depth [H, W] float32 in meters; 0 where not measured."""
        return in_meters(self.depth, self.depth_scale)

    def too_far(self) -> int:
        """Return the number of pixels whose depth is finite but at least `MAX_DEPTH_M`."""
        limit = min(MAX_DEPTH_M * self.depth_scale, float(np.finfo(np.float32).max))
        return int(np.count_nonzero((self.depth >= limit) & (self.depth < np.inf)))


def brightest(color: np.ndarray) -> np.ndarray:
    """Return the largest of the three channels of a color image [H, W, 3], as [H, W]."""
    red, green, blue = cv2.split(color)
    return np.asarray(cv2.max(cv2.max(red, green), blue))


def in_meters(depth: np.ndarray, depth_scale: float) -> np.ndarray:
    """Convert a depth image to meters.

    Args:
        depth: Depth, [H, W], in 1/depth_scale meters.
        depth_scale: Units of `depth` per meter.

    Returns:
        [H, W] float32; 0 where the depth is below `MIN_DEPTH_M` or not below `MAX_DEPTH_M`.
    """
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        depth_m = depth.astype(np.float32) / np.float32(depth_scale)
        depth_m[~((depth_m >= np.float32(MIN_DEPTH_M)) & (depth_m < MAX_DEPTH_M))] = 0.0
    return depth_m


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def undistortion_maps(camera: Camera) -> Maps | None:
    """Return where each pixel of the rectified image lies in the distorted image.

    Returns:
        Columns u and rows v in the distorted image, [H, W] float32 each, in pixels. None if the
        camera has no distortion.
    """
    if not any(camera.distortion):
        return None
    K, coefficients = camera.matrix, np.array(camera.distortion)
    size = (camera.width, camera.height)
    u, v = cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    return u, v


def valid_pixels(camera: Camera) -> np.ndarray | None:
    """Return which pixels of a rectified image lie inside the distorted image.

    Returns:
        Mask [H, W] bool. It is False on the black rim that rectification leaves. None if the camera
        has no distortion, so that all pixels are valid.
    """
    maps = undistortion_maps(camera)
    if maps is None:
        return None
    u, v = maps
    return (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)


def pixels_without_data(frame: RgbdFrame) -> np.ndarray:
    """Return the pixels in regions without color and depth that touch the border of a frame.

    Rectification and the compensation of motion leave a rim of such pixels. The color must be
    exactly black, so the rim of a compressed image is not found. A black object without depth at
    the border is masked too. The mask is one pixel wider, because interpolation darkens the pixels
    next to the rim.

    Returns:
        Mask [H, W] bool.
    """
    empty = (frame.depth_m == 0) & (brightest(frame.color) == 0)
    if not any(side.any() for side in (empty[0], empty[-1], empty[:, 0], empty[:, -1])):
        return np.zeros_like(empty)
    count, parts = cv2.connectedComponents(empty.astype(np.uint8), connectivity=4)
    is_rim = np.zeros(count, bool)
    for side in (parts[0], parts[-1], parts[:, 0], parts[:, -1]):
        is_rim[side] = True
    is_rim[0] = False  # Number 0 are the pixels that have data.
    return cv2.dilate(is_rim[parts].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def rectify(raw: RawFrame, maps: Maps | None) -> RgbdFrame:
    """Remove the lens distortion of a frame and convert its depth to meters.

    The intrinsic matrix does not change. Color is interpolated bilinearly. Depth is taken from the
    nearest pixel, because a mean of depths across an edge lies on no surface. Pixels outside the
    distorted image are black with depth 0. Without distortion, the result shares the color array
    of `raw`.

    Args:
        raw: The frame.
        maps: Result of `undistortion_maps(raw.camera)`; None if there is no distortion.
    """
    color, depth_m = raw.color, raw.depth_m()
    if maps is not None:
        color = cv2.remap(color, *maps, interpolation=cv2.INTER_LINEAR)
        depth_m = cv2.remap(depth_m, *maps, interpolation=cv2.INTER_NEAREST)
    return RgbdFrame(color, depth_m, raw.camera.rectified(), raw.stamp_ns, raw.index)


class Rectifier:
    """Callable that rectifies frames and caches the undistortion maps of the last camera."""

    def __init__(self) -> None:
        self._camera: Camera | None = None
        self._maps: Maps | None = None

    def __call__(self, raw: RawFrame) -> RgbdFrame:
        if raw.camera != self._camera:
            self._camera, self._maps = raw.camera, undistortion_maps(raw.camera)
        return rectify(raw, self._maps)
