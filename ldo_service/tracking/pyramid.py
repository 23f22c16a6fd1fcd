"""Image pyramids, reference points and depth noise for direct alignment.

Gray images and depth are halved by averaging 2x2 blocks, as `Camera.halved` expects. The center of
a coarse pixel is the corner between the four fine pixels of its block. `cv2.pyrDown` would center
the coarse pixel on one of these four; this offset of half a pixel doubles the trajectory error. The
reference points are the surface points of a keyframe, to which frames are aligned.
Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from ldo_service.calibration.shutter import FrameMotion
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, RgbdFrame
from ldo_service.kernels import _align

# Gray level from which a pixel counts as overexposed: at least one color channel is saturated, and
# the others nearly are.
CLIPPED = 250
CELLS = 8, 6  # Columns and rows of the cells of an image.
ANY_DIFFERENCE = 1e3  # Relative tolerance that excludes no value.


Intrinsics = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class PyramidConfig:
    """Settings of the image pyramid."""

    # Width of the finest level: the image is halved until it is narrower than 1.5 times this width.
    working_width_px: int = 320
    levels: int = 4  # Maximum number of levels: 320, 160, 80, 40 pixels wide.
    min_side_px: int = 12  # Minimum side of a level; smaller images have too few pixels.
    # Maximum depth difference within a 2x2 block that is averaged, as a fraction of the nearest
    # depth. In a block across an edge, only the nearer surface is averaged.
    depth_tolerance: float = 0.03
    # Larger depths are dropped, because no depth camera measures farther. Values such as 65 m are
    # errors of the camera.
    max_depth_m: float = 30.0

    def __post_init__(self) -> None:
        if min(self.working_width_px, self.levels, self.min_side_px) < 1:
            raise ConfigError(
                f"PyramidConfig.working_width_px={self.working_width_px}, levels={self.levels} and "
                f"min_side_px={self.min_side_px} must be at least 1."
            )
        if not self.max_depth_m > 0:
            raise ConfigError(f"PyramidConfig.max_depth_m={self.max_depth_m:g} must be positive.")
        if not 0 < self.depth_tolerance < 1:
            raise ConfigError(
                f"PyramidConfig.depth_tolerance={self.depth_tolerance:g} must be above 0 and below "
                "1."
            )


@dataclass(frozen=True, slots=True)
class Level:
    """One level of an image pyramid."""

    # [H, W, 4] float32: gray level, gradients of the gray level along u and v per pixel, depth in
    # meters.
    texels: np.ndarray
    camera: Camera

    @property
    def depth_m(self) -> np.ndarray:
        """Depth [H, W] float32 in meters; 0 where unknown."""
        return self.texels[..., 3]

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics (fx, fy, cx, cy) of the level in pixels."""
        return intrinsics(self.camera)


@dataclass(frozen=True, slots=True)
class Pyramid:
    """Image pyramid of a frame, with the full-resolution gray image and depth."""

    gray: np.ndarray  # [H, W] uint8.
    depth_m: np.ndarray  # [H, W] float32 meters; 0 where unknown.
    camera: Camera  # Intrinsics of the full-resolution image.
    levels: tuple[Level, ...]  # The finest first.
    # Features of the image that are known already, by their settings; see `features.detect`.
    features: dict[Any, Any] = field(default_factory=dict, repr=False, compare=False)


def intrinsics(camera: Camera) -> Intrinsics:
    """Return (fx, fy, cx, cy) of a camera in pixels."""
    return camera.fx, camera.fy, camera.cx, camera.cy


def mask_clipped(gray: np.ndarray) -> np.ndarray:
    """Set overexposed pixels of a gray image to 0, the value of invalid pixels.

    A clipped pixel has the same gray level for surfaces of different brightness. After a change of
    the exposure, such pixels would increase the residuals even at the right pose.

    Args:
        gray: Image, [H, W] uint8.

    Returns:
        Gray levels, [H, W] float32; 0 where overexposed or already 0 (black).
    """
    _, exposed = cv2.threshold(gray, CLIPPED - 1, 0, cv2.THRESH_TOZERO_INV)
    return exposed.astype(np.float32)


def halved_image(image: np.ndarray, least: int = 1) -> np.ndarray:
    """Halve an image by averaging the valid pixels of 2x2 blocks.

    Args:
        image: Gray levels, [H, W] float32, 0 where invalid; or a gray image, [H, W] uint8, whose
            overexposed and black pixels are invalid.
        least: Minimum number of valid pixels in a block. A block with fewer becomes 0.

    Returns:
        [H//2, W//2] float32.
    """
    if image.dtype == np.uint8:
        return _align.halve_gray(np.ascontiguousarray(image), CLIPPED, least)
    return _align.halve(image, ANY_DIFFERENCE, least)


def halved_depth(depth_m: np.ndarray, tolerance: float) -> np.ndarray:
    """Halve a depth image by averaging 2x2 blocks.

    Args:
        depth_m: Depth, [H, W] float32 meters; 0 where unknown.
        tolerance: Maximum depth difference to the nearest pixel of the block, as a fraction of the
            nearest depth. Pixels farther away are excluded from the average.

    Returns:
        [H//2, W//2] float32 meters.
    """
    return _align.halve(depth_m, tolerance)


def build_pyramid(
    gray: np.ndarray, depth_m: np.ndarray, camera: Camera, config: PyramidConfig
) -> Pyramid:
    """Build the pyramid of an image [H, W] uint8 and its depth [H, W] float32 in meters."""
    image, depth, scaled = gray, np.ascontiguousarray(depth_m), camera
    levels: list[Level] = []
    while True:
        if scaled.width < 1.5 * config.working_width_px:
            image = _masked(image)
            levels.append(Level(_align.pack(image, depth, config.max_depth_m), scaled))
        smallest = min(scaled.width, scaled.height) // 2
        if len(levels) == config.levels or smallest < config.min_side_px:
            break
        # The valid pixels of a partly overexposed block are darker than the whole block. Such
        # blocks are excluded until the finest level is reached. The coarser levels keep them, since
        # too few pixels would remain, and since these levels only yield the initial guess of finer
        # levels.
        image = halved_image(image, least=1 if levels else 4)
        depth, scaled = halved_depth(depth, config.depth_tolerance), scaled.halved()
    if not levels:  # The image is wide and too low to be halved.
        levels.append(Level(_align.pack(_masked(image), depth, config.max_depth_m), scaled))
    return Pyramid(gray, depth_m, camera, tuple(levels))


def _masked(image: np.ndarray) -> np.ndarray:
    """Return gray levels [H, W] float32 of an image that may not have been halved yet."""
    return mask_clipped(image) if image.dtype == np.uint8 else image


def pyramid_of(
    frame: RgbdFrame, config: PyramidConfig, motion: FrameMotion | None = None
) -> Pyramid:
    """Build the pyramid of a frame from its luminance and depth.

    Args:
        frame: The frame.
        config: Settings.
        motion: Motion of the camera during the frame, to be compensated; None for no compensation.
    """
    return compensated_pyramid(luminance(frame), frame, config, motion)


def luminance(frame: RgbdFrame) -> np.ndarray:
    """Return the gray image of a frame, [H, W] uint8."""
    return cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)


def compensated_pyramid(
    gray: np.ndarray, frame: RgbdFrame, config: PyramidConfig, motion: FrameMotion | None
) -> Pyramid:
    """Build the pyramid of a frame whose luminance [H, W] uint8 is known; see `pyramid_of`."""
    depth_m = frame.depth_m
    if motion is not None and motion.timing:
        gray, depth_m = motion.warped(gray, depth_m, frame.camera)
    return build_pyramid(gray, depth_m, frame.camera, config)


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Noise of a depth camera along the optical axis: sigma(z) = floor + growth (z - nearest)^2.

    The defaults are those of the Kinect (Nguyen, Izadi and Lovell 2012, equation 5). The shape of
    the curve matters more than its scale: alignment estimates a factor on the curve for each frame.
    """

    floor_m: float = 0.0012
    growth_per_m: float = 0.0019
    nearest_m: float = 0.4

    def __post_init__(self) -> None:
        if not (self.floor_m > 0 and self.growth_per_m >= 0):
            raise ConfigError(
                f"DepthNoise.floor_m={self.floor_m:g} must be positive and "
                f"growth_per_m={self.growth_per_m:g} must not be negative."
            )

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """Coefficients (floor_m, growth_per_m, nearest_m) of the noise curve."""
        return self.floor_m, self.growth_per_m, self.nearest_m

    def sigma_m(self, depth_m: np.ndarray) -> np.ndarray:
        """Return the standard deviation [...] of measured depths [...], both in meters."""
        return self.floor_m + self.growth_per_m * (depth_m - self.nearest_m) ** 2


@dataclass(frozen=True, slots=True)
class ReferencePoints:
    """Surface points of a keyframe that frames are aligned to."""

    # Points of each level, the finest first, [7, N] float32. Rows: x y z in meters in the reference
    # camera, gray level, and a normal (0 0 0 if unknown).
    points: tuple[np.ndarray, ...]
    median_depth_m: float  # Scale of the scene; 1 without any measured depth.
    # Cell of the image in which each point of the finest level lies, [N] uint8: number in a grid of
    # `CELLS`, by rows. Points of one cell have correlated errors.
    cells: np.ndarray


def build_reference(pyramid: Pyramid, ignore_mask: np.ndarray | None = None) -> ReferencePoints:
    """Build reference points from the pixels with depth.

    Args:
        pyramid: Pyramid of the keyframe.
        ignore_mask: Pixels to ignore, [H, W] bool at the finest pyramid level.
    """
    levels = (_without(level, ignore_mask) for level in pyramid.levels)
    points = tuple(_level_points(level, i) for i, level in enumerate(levels))
    depth_m = points[0][2]
    median_depth_m = float(np.median(depth_m)) if depth_m.size else 1.0
    return ReferencePoints(points, median_depth_m, _cells_of(points[0], pyramid.levels[0].camera))


def _cells_of(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the cell of the image in which each point [7, N] lies, [N] uint8."""
    columns, rows = CELLS

    def place(axis: int, focal: float, center: float, scale: float, count: int) -> np.ndarray:
        pixels = focal * points[axis]
        pixels /= points[2]
        pixels += center
        pixels *= scale
        return pixels.clip(0, count - 1, out=pixels).astype(np.uint8)

    column = place(0, camera.fx, camera.cx, columns / camera.width, columns)
    row = place(1, camera.fy, camera.cy, rows / camera.height, rows)
    return columns * row + column


def _without(level: Level, ignore_mask: np.ndarray | None) -> Level:
    if ignore_mask is None or not ignore_mask.any():
        return level
    size = level.camera.width, level.camera.height
    share = cv2.resize(ignore_mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    texels = level.texels.copy()
    texels[..., 3][share > 0] = 0
    return Level(texels, level.camera)


def _level_points(level: Level, index: int) -> np.ndarray:
    smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(level.depth_m), 3), np.float32)
    radius_px = max(1, 3 - index)  # The radius spans about the same angle on each level.
    normals = _align.normals(smooth, level.intrinsics, radius_px)
    return _align.points(level.texels, normals, level.intrinsics)
