"""Images of phones on one pixel grid: large color images, small depth images, and confidence.

A phone registers its depth to the color image: both have the same field of view. Color has up to
1920x1440 pixels, depth 256x192. Both are resampled to a grid whose longer side has about 640
pixels. Color is averaged over blocks. Depth is interpolated only where the four neighboring depth
pixels lie on one surface.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, RawFrame
from ldo_service.geometry.camera import project, rays
from ldo_service.geometry.registration import SAME_SURFACE

# Minimum length of the longer side of the grid in pixels. It is the size of the data
# sets with which tracking and mapping are measured, and twice the width at which the
# tracker aligns.
MIN_LONGER_SIDE = 640

# Minimum confidence of ARKit, 0 to 2. Lower values mark edges of depth, and surfaces that are dark,
# shiny or far, where the phone fills in depth from the color image.
MIN_CONFIDENCE = 2


@dataclass(frozen=True, slots=True)
class PhoneGrid:
    """Pixel grid to which all frames of a phone recording are resampled.

    Attributes:
        color_camera: Camera of the color images of the sequence, at their full size.
    """

    color_camera: Camera

    @property
    def block(self) -> int:
        """Side, in color pixels, of the square block that becomes one pixel of the grid."""
        longer = max(self.color_camera.width, self.color_camera.height)
        return max(1, longer // MIN_LONGER_SIDE)

    @property
    def camera(self) -> Camera:
        """Intrinsics of the resampled images: those of the color camera, scaled to the grid."""
        full, n = self.color_camera, self.block
        return Camera(
            full.width // n,
            full.height // n,
            full.fx / n,
            full.fy / n,
            (full.cx + 0.5) / n - 0.5,
            (full.cy + 0.5) / n - 0.5,
            full.distortion,
        )

    def frame(
        self,
        index: int,
        stamp_ns: int,
        color: np.ndarray,
        depth: np.ndarray,
        depth_scale: float,
        camera: Camera | None = None,
    ) -> RawFrame:
        """Resample the images of a frame to the grid.

        Args:
            index: Number of the frame.
            stamp_ns: Stamp of the frame.
            color: Color, [H, W, 3] uint8 RGB, of the size of `color_camera`.
            depth: Depth, [Hd, Wd], registered to color; 0 or NaN where not measured.
            depth_scale: Units of depth per meter.
            camera: Camera of this frame at the size of `color_camera`, because an autofocus changes
                the focal length from frame to frame. None uses `color_camera`.

        Raises:
            FrameError: An image has a wrong size or type.
        """
        full, n = self.color_camera, self.block
        if color.shape != (full.height, full.width, 3):
            raise FrameError(
                f"frame {index}: color is {color.shape[1]}x{color.shape[0]} pixels, but its "
                f"intrinsics are for {full.width}x{full.height}. Check intrinsics and image."
            )
        if depth.ndim != 2 or abs(depth.shape[1] * full.height / full.width - depth.shape[0]) > 1:
            raise FrameError(
                f"frame {index}: depth has the shape {depth.shape}, and color has "
                f"{full.width}x{full.height} pixels. Depth must have one channel and the aspect "
                "ratio of color. Export the recording again."
            )
        grid = self.camera
        if n > 1:
            color = color[: grid.height * n, : grid.width * n]
            color = cv2.resize(color, (grid.width, grid.height), interpolation=cv2.INTER_AREA)
        depth = enlarge_depth(depth, (grid.height, grid.width), (full.height / n, full.width / n))
        if camera is not None and camera != full:
            color, depth = _moved(color, depth, PhoneGrid(camera).camera, grid)
        return RawFrame(index, stamp_ns, color, depth, depth_scale, grid)


def without_doubt(depth: np.ndarray, confidence: np.ndarray, source: str) -> np.ndarray:
    """Return a depth image with 0 where the confidence is below MIN_CONFIDENCE.

    Args:
        depth: Depth, [Hd, Wd].
        confidence: Confidence of ARKit, [Hd, Wd] uint8, 0 to 2.
        source: Name of the confidence image, for the error.

    Raises:
        FrameError: The images differ in size.
    """
    if confidence.shape != depth.shape:
        raise FrameError(
            f"{source} has the shape {confidence.shape} and its depth image {depth.shape}, "
            "expected equal shapes. Export the recording again."
        )
    return np.where(confidence >= MIN_CONFIDENCE, depth, depth.dtype.type(0))


def enlarge_depth(
    depth: np.ndarray, size: tuple[int, int], view: tuple[float, float]
) -> np.ndarray:
    """Resample a depth image to a pixel grid.

    The inverse of depth is interpolated bilinearly, because it is linear on a plane. A pixel whose
    four neighbors are not all measured, or do not lie on one surface, is 0. The depth between two
    surfaces would lie on neither.

    Args:
        depth: Depth, [Hd, Wd], in any unit; 0 or NaN where not measured.
        size: Height and width of the grid, pixels.
        view: Height and width of the depth image's field of view, in pixels of the grid. `size`
            is `view` rounded down.

    Returns:
        [H, W]. It is `depth` itself if the sizes are equal, else float32 in the same unit.
    """
    if depth.ndim != 2 or depth.shape == size:
        return depth
    (top, bottom, v), (left, right, u) = map(_cells, size, depth.shape, view)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = 1.0 / depth.astype(np.float32)
    inverse[~((inverse > 0) & (inverse < np.inf))] = 0.0
    corners = [inverse[np.ix_(row, column)] for row in (top, bottom) for column in (left, right)]
    a, b, c, d = corners
    v = v[:, None]
    mean = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    least, most = np.minimum.reduce(corners), np.maximum.reduce(corners)
    is_surface = (least > 0) & (most - least < SAME_SURFACE * least)
    out = np.zeros(size, np.float32)
    return np.divide(1.0, mean, out=out, where=is_surface)


def scaled(camera: Camera, width: int, height: int, source: str) -> Camera:
    """Return a camera for images of another size and the same field of view.

    Raises:
        DataError: The two sizes have different aspect ratios, with a tolerance of one pixel.
    """
    x, y = width / camera.width, height / camera.height
    if abs(camera.height * x - height) > 1 and abs(camera.width * y - width) > 1:
        raise DataError(
            f"{source}: the images have {width}x{height} pixels, but the intrinsics are for "
            f"{camera.width}x{camera.height}. Export the recording again."
        )
    return Camera(
        width,
        height,
        camera.fx * x,
        camera.fy * y,
        (camera.cx + 0.5) * x - 0.5,
        (camera.cy + 0.5) * y - 0.5,
        camera.distortion,
    )


def _cells(count: int, whole: int, view: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the two depth pixels around each pixel of the grid, along an axis.

    Args:
        count: Number of pixels of the grid.
        whole: Number of pixels of the depth image.
        view: Length of the depth image, in pixels of the grid.

    Returns:
        The first and the second depth pixel, [count] each, and the weight of the second, [count].
    """
    position = np.clip((np.arange(count) + 0.5) * (whole / view) - 0.5, 0, whole - 1)
    first = np.floor(position).astype(np.intp)
    return first, np.minimum(first + 1, whole - 1), (position - first).astype(np.float32)


def _moved(
    color: np.ndarray, depth: np.ndarray, camera: Camera, grid: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Resample images of one camera to those of another at the same place and size."""
    u, v = _maps(camera, grid)
    color = cv2.remap(color, u, v, cv2.INTER_LINEAR)
    return color, cv2.remap(depth, u, v, cv2.INTER_NEAREST)


@lru_cache(maxsize=4)
def _maps(camera: Camera, grid: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return where each pixel of the grid lies in the images of a camera, u and v [H, W]."""
    return project(*rays(grid), camera)
