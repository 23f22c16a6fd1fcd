"""Views of a region: their quality, and the crop for the labeller."""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, codecs
from ldo_service.geometry.codecs import shrunk
from ldo_service.kernels import _facing

from .foreground import Foreground, pixels_of


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """Settings of the views of a region: the crops for the labeller, and their quality."""

    context: float = 0.15  # Margin around the box as a fraction of its sides.
    side_px: int = 336  # Maximum side of the crop; a larger one is scaled down.
    # Side of a region (square root of the box area) from which the size factor is 1.
    good_side_px: float = 128.0
    # Variance of the Laplacian (gray levels squared) at which the sharpness factor is 0.5.
    sharp: float = 100.0
    # Factor on the quality of a view whose region touches the border of the image or is seen
    # edge on.
    min_factor: float = 0.25

    def __post_init__(self) -> None:
        if not (self.context >= 0 and min(self.good_side_px, self.sharp) > 0 and self.side_px > 0):
            raise ConfigError(
                named(self, "context", "side_px", "good_side_px", "sharp")
                + ": context must be at least 0, and the other settings must be positive."
            )
        if not 0 <= self.min_factor <= 1:
            raise ConfigError(named(self, "min_factor") + ": the factor must be in [0, 1].")


@dataclass(frozen=True, eq=False, slots=True)
class RegionView:
    """View of a region: a crop of the color image of a keyframe around the region's box.

    Attributes:
        keyframe: Keyframe of the view.
        box_px: Box of the region in that keyframe, x0 y0 x1 y1, pixels.
        quality: Quality of the view, 0..1.
        width: Width of the crop, pixels.
        height: Height of the crop, pixels.
        jpeg: Crop as JPEG.
    """

    keyframe: int
    box_px: tuple[float, float, float, float]
    quality: float
    width: int
    height: int
    jpeg: bytes


def region_view(
    keyframe: int,
    color: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    box_px: np.ndarray,
    part: Foreground,
    config: ViewConfig,
    min_quality: float = 0.0,
) -> RegionView | None:
    """Crop the view of a region from a keyframe, and rate the quality of the view.

    The quality is the product of the size, border, sharpness and facing factors. No factor exceeds
    1. The function therefore stops as soon as the product of the known factors is below
    `min_quality`.

    Args:
        keyframe: Id of the keyframe.
        color: Color image, [H, W, 3] uint8 RGB.
        depth_m: Depth, [H, W], meters; 0 where unknown.
        camera: Intrinsics of both images.
        box_px: Box of the region, [4], x0 y0 x1 y1, pixels.
        part: Mask of the region.
        config: Settings.
        min_quality: Minimum quality of the view, 0..1.

    Returns:
        The view; None if its quality is below `min_quality`.
    """
    quality = size_factor(box_px, config) * border_factor(box_px, depth_m.shape, config)
    if quality < min_quality:
        return None
    x0, y0, x1, y1 = (float(v) for v in box_px)
    margin = config.context * np.array([x1 - x0, y1 - y0])
    grown = np.array([*(box_px[:2] - margin), *(box_px[2:] + margin)])
    crop = shrunk(color[pixels_of(grown, depth_m.shape)], config.side_px)
    quality *= sharpness_factor(crop, config)
    if quality < min_quality:
        return None
    quality *= facing_factor(depth_m, camera, part, config)
    if quality < min_quality:
        return None
    height, width = crop.shape[:2]
    jpeg = codecs.encode_jpeg(crop)
    return RegionView(keyframe, (x0, y0, x1, y1), float(quality), width, height, jpeg)


def size_factor(box_px: np.ndarray, config: ViewConfig) -> float:
    """Return the quality factor for the size of a box [4], x0 y0 x1 y1.

    The factor is the square root of the box area, divided by `good_side_px`, and at most 1.

    >>> size_factor(np.array([0, 0, 64, 64]), ViewConfig())
    0.5
    """
    side = float(np.sqrt(np.prod(box_px[2:] - box_px[:2])))
    return min(1.0, side / config.good_side_px)


def border_factor(box_px: np.ndarray, shape: tuple[int, ...], config: ViewConfig) -> float:
    """Return the quality factor for the distance of a box from the border of the image.

    The factor is `min_factor` at the border and rises linearly to 1 at a distance of a tenth of the
    box's longer side.

    Args:
        box_px: Box, [4], x0 y0 x1 y1, pixels.
        shape: Height and width of the image.
        config: Settings.
    """
    height, width = shape[:2]
    gaps = *(box_px[:2] + 0.5), width - 0.5 - box_px[2], height - 0.5 - box_px[3]
    wanted = 0.1 * float((box_px[2:] - box_px[:2]).max())
    reached = min(1.0, max(0.0, float(min(gaps))) / wanted)
    return config.min_factor + (1 - config.min_factor) * reached


def sharpness_factor(crop: np.ndarray, config: ViewConfig) -> float:
    """Return the quality factor for the sharpness of a crop [h, w, 3] uint8 RGB.

    The factor is v / (v + sharp), where v is the variance of the Laplacian of the gray image
    (Pech-Pacheco et al., ICPR 2000).
    """
    gray = cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY)
    variance = float(cv2.Laplacian(gray, cv2.CV_64F).var())
    return variance / (variance + config.sharp)


def facing_factor(
    depth_m: np.ndarray, camera: Camera, part: Foreground, config: ViewConfig
) -> float:
    """Return the quality factor for how directly the camera faces the surface of a region.

    The factor is `min_factor + (1 - min_factor) c`, where c is the mean cosine between the normals
    of the region and the viewing rays. If no normal is known, the factor is `min_factor`. The
    kernel is `kernels/facing.cpp`; its NumPy reference implementation is
    `tests/reference/facing.py`.

    Args:
        depth_m: Depth, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the depth.
        part: Mask of the region.
        config: Settings.
    """
    height, width = part.mask.shape
    if min(height, width) < 3 or not part.mask.any():
        return config.min_factor
    rows, columns = part.row + np.arange(height), part.column + np.arange(width)
    z = depth_m[rows[0] : rows[0] + height, columns[0] : columns[0] + width]
    cosines = np.empty(height * width)
    count = _facing.facing_cosines(
        np.ascontiguousarray(z, np.float32),
        np.ascontiguousarray(camera.rays_at(columns, 0.0)[:, 0]),
        np.ascontiguousarray(camera.rays_at(0.0, rows)[:, 1]),
        np.ascontiguousarray(part.mask).view(np.uint8),
        cosines,
    )
    if count == 0:
        return config.min_factor
    mean = float(cosines[:count].mean())
    return config.min_factor + (1 - config.min_factor) * mean
