"""Image and depth pyramids with one definition of pixel centres: `Camera.halved`.

Colour and depth are halved by averaging 2x2 blocks, so a pixel of the coarse image is centred on
the corner that its four parents share. (`cv2.pyrDown` centres it on one of them; that half pixel
doubles the trajectory's error.)
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


def told(gray: np.ndarray) -> np.ndarray:
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
    image, depth, scaled = told(gray), np.ascontiguousarray(depth_m), camera
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
