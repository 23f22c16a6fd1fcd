"""RGB-D frames: raw frames of a camera, in one or two messages, and rectified frames."""

from typing import Literal

import msgspec
import numpy as np

from ldo_service.schemas.array import Array
from ldo_service.schemas.message import Message, require_count, require_finite
from ldo_service.schemas.pose import IDENTITY, Pose

# 33 megapixels, more than any RGB-D camera has. Without a limit, a corrupt header could demand
# terabytes of memory.
MAX_PIXELS = 1 << 25


# Depth from which on a value means "not measured", meters. Depth cameras measure up to 100 m.
MAX_DEPTH_M = 1000.0


class CameraModel(msgspec.Struct, frozen=True, kw_only=True):
    """Pinhole intrinsics in pixels, with pixel centers at integer coordinates."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # OpenCV: k1 k2 p1 p2 [k3 [k4 k5 k6]]; empty: rectified.

    def __post_init__(self) -> None:
        require_finite("camera intrinsics", (self.fx, self.fy, self.cx, self.cy, *self.distortion))
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_PIXELS:
            raise ValueError(
                f"image size is {self.width}x{self.height}, must be 1 to {MAX_PIXELS} pixels in "
                "total"
            )
        if self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"focal lengths are {self.fx:g}, {self.fy:g} px, must be positive")
        if len(self.distortion) not in (0, 4, 5, 8):
            raise ValueError(
                f"distortion has {len(self.distortion)} coefficients, must have 0, 4, 5 or 8"
            )


# rgb8, bgr8: color, 3 bytes per pixel. jpeg: color. png: color of 8 bits, or depth of 16 bits.
# z16: depth, little-endian uint16. f32: depth, little-endian float32; NaN, infinity, less than 1 mm
# and 1000 m or more mean "not measured". +zstd: the same, compressed.
ImageEncoding = Literal["rgb8", "bgr8", "jpeg", "png", "z16", "z16+zstd", "f32", "f32+zstd"]
BYTES_PER_PIXEL: dict[str, int] = {"rgb8": 3, "bgr8": 3, "z16": 2, "f32": 4}


class Image(msgspec.Struct, frozen=True, kw_only=True):
    """Image, raw or compressed.

    The constructor checks the size of the image. The pixels of a compressed image are checked when
    the image is decompressed.
    """

    encoding: ImageEncoding
    width: int
    height: int
    data: memoryview

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_PIXELS:
            raise ValueError(
                f"image size is {self.width}x{self.height}, must be 1 to {MAX_PIXELS} pixels in "
                "total"
            )
        raw = self.width * self.height * BYTES_PER_PIXEL.get(self.encoding, 0)
        if self.encoding in BYTES_PER_PIXEL and self.data.nbytes != raw:
            raise ValueError(
                f"{self.encoding} image of {self.width}x{self.height} needs {raw} bytes, "
                f"has {self.data.nbytes}"
            )
        if self.data.nbytes == 0:
            raise ValueError(f"{self.encoding} image has no data")

    @classmethod
    def raw(cls, encoding: ImageEncoding, pixels: np.ndarray) -> "Image":
        """Return an image with a copy of uncompressed pixels [H, W] or [H, W, 3]."""
        height, width = pixels.shape[:2]
        data = memoryview(np.ascontiguousarray(pixels).tobytes())
        return cls(encoding=encoding, width=width, height=height, data=data)

    @classmethod
    def raw_depth(cls, pixels: np.ndarray) -> "Image":
        """Return a depth image with a copy of uncompressed pixels [H, W], uint16 or float32."""
        return cls.raw("z16" if pixels.dtype == np.uint16 else "f32", pixels)


class CameraRgbd(Message, frozen=True, kw_only=True):
    """Raw RGB-D frame of a camera program, published on camera/rgbd; depth is registered to color.

    stamp_ns is the time of the exposure of the frame, by the clock of the camera.
    """

    frame: int  # Number of the frame, counted by the camera program; gaps are dropped frames.
    camera: CameraModel
    color: Image
    depth: Image
    depth_scale: float  # Depth units per meter: 1000 for millimeters, 5000 for TUM, 1 for meters.

    def check(self) -> None:
        require_count("frame", self.frame)
        require_color(self.color, self.camera)
        if (self.depth.width, self.depth.height) != (self.color.width, self.color.height):
            raise ValueError(
                f"depth of {self.depth.width}x{self.depth.height} and color of "
                f"{self.color.width}x{self.color.height} pixels differ in size: depth must be "
                "registered to color"
            )
        require_depth(self.depth, self.camera, self.depth_scale)


class CameraColor(Message, frozen=True, kw_only=True):
    """Raw color image of a camera program, published on camera/color.

    The actor frame_source pairs the color image with a depth image. The resulting frame has the
    stamp of the color image.
    """

    # Number of the image, counted by the camera program; the resulting frame has the same number.
    frame: int
    camera: CameraModel
    image: Image

    def check(self) -> None:
        require_count("frame", self.frame)
        require_color(self.image, self.camera)


class CameraDepth(Message, frozen=True, kw_only=True):
    """Raw depth image of a camera program, published on camera/depth.

    stamp_ns is the time of exposure of the depth image. The depth image counts as registered to the
    color image if `camera` equals that of the color image and T_color_depth is the identity.
    Otherwise, the service registers the depth image.
    """

    # Number of the image, counted by the camera program; images are paired by stamp, not by number.
    frame: int
    camera: CameraModel  # Intrinsics of the depth image.
    image: Image
    depth_scale: float  # Depth units per meter, as in camera/rgbd.
    # Transform from depth-camera coordinates to color-camera coordinates.
    T_color_depth: Pose = IDENTITY

    def check(self) -> None:
        require_count("frame", self.frame)
        require_depth(self.image, self.camera, self.depth_scale)


class FrameRgbd(Message, frozen=True, kw_only=True):
    """Rectified frame with color and depth on the same pixel grid, published on frame/rgbd."""

    frame: int  # Frame number, as in camera/rgbd.
    camera: CameraModel  # Intrinsics without distortion.
    color: Array  # RGB, u1 [H, W, 3].
    depth_m: Array  # Depth z in meters, f4 [H, W]; 0 where not measured.

    def check(self) -> None:
        require_count("frame", self.frame)
        require_rgbd(self.camera, self.color, self.depth_m)


def require_color(image: Image, camera: CameraModel) -> None:
    """Raise ValueError unless a color image has its camera's size and an encoding for color."""
    if (image.width, image.height) != (camera.width, camera.height):
        raise ValueError(
            f"color image of {image.width}x{image.height} pixels and its camera model of "
            f"{camera.width}x{camera.height} pixels differ in size; both must be equal"
        )
    if image.encoding not in ("rgb8", "bgr8", "jpeg", "png"):
        raise ValueError(
            f"color cannot be encoded as {image.encoding}; use rgb8, bgr8, jpeg or png"
        )


def require_depth(image: Image, camera: CameraModel, depth_scale: float) -> None:
    """Raise ValueError if the size, encoding or scale of a depth image is invalid.

    The image must have the size of the camera and a depth encoding. The scale must be positive.
    """
    require_finite("depth_scale", (depth_scale,))
    if depth_scale <= 0:
        raise ValueError(f"depth_scale is {depth_scale:g}, must be positive")
    if (image.width, image.height) != (camera.width, camera.height):
        raise ValueError(
            f"depth image of {image.width}x{image.height} pixels and its camera model of "
            f"{camera.width}x{camera.height} pixels differ in size; both must be equal"
        )
    if image.encoding not in ("png", "z16", "z16+zstd", "f32", "f32+zstd"):
        raise ValueError(
            f"depth cannot be encoded as {image.encoding}; use png, z16, z16+zstd, f32 or f32+zstd"
        )


def require_rgbd(camera: CameraModel, color: Array, depth_m: Array) -> None:
    """Raise ValueError unless camera, color [H, W, 3] and depth [H, W] form a rectified frame.

    The camera must have no distortion. Color and depth must have the size of the camera.
    """
    if camera.distortion:
        raise ValueError("camera of a rectified frame has distortion, must have none")
    size = (camera.height, camera.width)
    color.require("color", "u1", (*size, 3))
    depth_m.require("depth_m", "f4", size)
    depth = depth_m.numpy()
    if not (depth.min() >= 0 and depth.max() < MAX_DEPTH_M):  # NaN fails both comparisons.
        raise ValueError(
            f"depth_m is {depth.min():g} to {depth.max():g} m, must be finite, at least 0 and "
            f"below {MAX_DEPTH_M:g}, where 0 means not measured"
        )
