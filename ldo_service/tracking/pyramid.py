"""Frames made ready for alignment: image pyramids, reference points, and the noise of their depth.

Pixel centers have one definition, `Camera.halved`: color and depth are halved by averaging 2x2
blocks, so a pixel of the coarse image is centered on the corner that its four parents share.
(`cv2.pyrDown` centers it on one of them; that half pixel doubles the trajectory's error.) What a
frame is aligned to are the surface points of a keyframe. Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, RgbdFrame
from ldo_service.kernels import _align

CLIPPED = 250  # grey levels: above, one of the colours is at its end and the others are near it
ANY_DIFFERENCE = 1e3  # relative


Intrinsics = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class PyramidConfig:
    working_width_px: int = 320  # finest level: halved until below 1.5 times this
    levels: int = 4  # 320, 160, 80, 40 pixels wide
    smallest_side_px: int = 12  # coarser images hold too few pixels to align
    depth_tolerance: float = 0.03  # relative; blocks across an edge keep the nearer surface
    max_depth_m: float = 30.0  # no depth camera measures beyond; a stray 65 m must not count

    def __post_init__(self) -> None:
        if min(self.working_width_px, self.levels, self.smallest_side_px) < 1:
            raise ConfigError("working_width_px, levels and smallest_side_px must be at least 1.")
        if not self.max_depth_m > 0:
            raise ConfigError(f"max_depth_m={self.max_depth_m:g} must be positive.")
        if not 0 < self.depth_tolerance < 1:
            raise ConfigError(f"depth_tolerance={self.depth_tolerance:g} must be within 0..1.")


@dataclass(frozen=True, slots=True)
class Level:
    """texels [H, W, 4] float32: grey level, its gradients along u and v per pixel, depth in m."""

    texels: np.ndarray
    camera: Camera

    @property
    def depth_m(self) -> np.ndarray:
        return self.texels[..., 3]

    @property
    def intrinsics(self) -> Intrinsics:
        return intrinsics(self.camera)


@dataclass(frozen=True, slots=True)
class Pyramid:
    """A frame ready for alignment: its grey image and depth, and `levels`, the finest first.

    gray [H, W] uint8; depth_m [H, W] float32.
    """

    gray: np.ndarray
    depth_m: np.ndarray
    camera: Camera
    levels: tuple[Level, ...]


def intrinsics(camera: Camera) -> Intrinsics:
    return camera.fx, camera.fy, camera.cx, camera.cy


def mask_clipped(gray: np.ndarray) -> np.ndarray:
    """Grey levels [H, W] float32 of an image uint8, 0 where it is clipped, black or white.

    The brightness of a clipped pixel does not follow that of its surface: after a jump of the
    exposure such pixels would speak against the right pose.
    """
    return np.where(gray < CLIPPED, gray, 0).astype(np.float32)


def halved_image(image: np.ndarray, least: int = 1) -> np.ndarray:
    """Means [H//2, W//2] float32 of what 2x2 blocks of an image [H, W] float32 tell.

    A block in which fewer than `least` pixels tell says nothing.
    """
    return _align.halve(image, ANY_DIFFERENCE, least)


def halved_depth(depth_m: np.ndarray, tolerance: float) -> np.ndarray:
    """Means [H//2, W//2] of 2x2 blocks, over the pixels within `tolerance` of the nearest one."""
    return _align.halve(depth_m, tolerance)


def build_pyramid(
    gray: np.ndarray, depth_m: np.ndarray, camera: Camera, config: PyramidConfig
) -> Pyramid:
    """The pyramid of an image [H, W] uint8 and its depth [H, W] float32."""
    image, depth, scaled = mask_clipped(gray), np.ascontiguousarray(depth_m), camera
    levels: list[Level] = []
    while True:
        if scaled.width < 1.5 * config.working_width_px:
            levels.append(Level(_align.pack(image, depth, config.max_depth_m), scaled))
        smallest = min(scaled.width, scaled.height) // 2
        if len(levels) == config.levels or smallest < config.smallest_side_px:
            break
        # At an edge of what is clipped, the rest of a block is darker than the whole: it has no
        # part in the finest level. Coarser ones lead there, and would be left with too little.
        image = halved_image(image, least=1 if levels else 4)
        depth, scaled = halved_depth(depth, config.depth_tolerance), scaled.halved()
    if not levels:  # a strip: wide, and too low to be halved
        levels.append(Level(_align.pack(image, depth, config.max_depth_m), scaled))
    return Pyramid(gray, depth_m, camera, tuple(levels))


def pyramid_of(frame: RgbdFrame, config: PyramidConfig) -> Pyramid:
    """The pyramid of a frame's luminance and depth."""
    return build_pyramid(
        cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), frame.depth_m, frame.camera, config
    )


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Axial noise sigma(z) = floor + growth (z - nearest)^2 of a depth camera.

    The defaults are the Kinect's (Nguyen, Izadi and Lovell 2012, equation 5). Only the shape of
    the curve matters much: alignment estimates a factor on it from every frame's residuals.
    """

    floor_m: float = 0.0012
    growth_per_m: float = 0.0019
    nearest_m: float = 0.4

    def __post_init__(self) -> None:
        if not (self.floor_m > 0 and self.growth_per_m >= 0):
            raise ConfigError(
                f"depth noise floor_m={self.floor_m:g} must be positive and "
                f"growth_per_m={self.growth_per_m:g} must not be negative."
            )

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """(floor_m, growth_per_m, nearest_m)."""
        return self.floor_m, self.growth_per_m, self.nearest_m

    def sigma_m(self, depth_m: np.ndarray) -> np.ndarray:
        """Standard deviation [...] of depth [...]."""
        return self.floor_m + self.growth_per_m * (depth_m - self.nearest_m) ** 2


@dataclass(frozen=True, slots=True)
class ReferencePoints:
    """Points [7, N] float32 of each level, the finest first.

    Rows: x y z in m in the reference camera, grey level, and a normal (0 0 0 where none).
    `median_depth_m` is the scale of the scene, 1 where nothing was measured.
    """

    points: tuple[np.ndarray, ...]
    median_depth_m: float


def build_reference(pyramid: Pyramid, left_out: np.ndarray | None = None) -> ReferencePoints:
    """Of the pixels with depth, but for those `left_out` [H, W] bool at working resolution."""
    levels = (_without(level, left_out) for level in pyramid.levels)
    points = tuple(_level_points(level, i) for i, level in enumerate(levels))
    depth_m = points[0][2]
    return ReferencePoints(points, float(np.median(depth_m)) if depth_m.size else 1.0)


def _without(level: Level, left_out: np.ndarray | None) -> Level:
    if left_out is None or not left_out.any():
        return level
    size = level.camera.width, level.camera.height
    share = cv2.resize(left_out.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    texels = level.texels.copy()
    texels[..., 3][share > 0] = 0
    return Level(texels, level.camera)


def _level_points(level: Level, index: int) -> np.ndarray:
    smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(level.depth_m), 3), np.float32)
    radius_px = max(1, 3 - index)  # about the same angle on every level
    normals = _align.normals(smooth, level.intrinsics, radius_px)
    return _align.points(level.texels, normals, level.intrinsics)
