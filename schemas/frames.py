"""RGB-D frames: as a camera sends them, whole or in halves, and rectified."""

from typing import Literal

import msgspec
import numpy as np

from ldo_service.schemas.array import Array
from ldo_service.schemas.message import Message, require_count, require_finite
from ldo_service.schemas.pose import IDENTITY, Pose

MAX_PIXELS = 1 << 25  # 33 megapixels: no RGB-D camera has more, and a lying header could ask for TB


class CameraModel(msgspec.Struct, frozen=True, kw_only=True):
    """Pinhole intrinsics in pixels, centres at integer coordinates."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # OpenCV: k1 k2 p1 p2 [k3 [k4 k5 k6]]; empty: rectified

    def __post_init__(self) -> None:
        require_finite("camera intrinsics", (self.fx, self.fy, self.cx, self.cy, *self.distortion))
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_PIXELS:
            raise ValueError(f"image size {self.width}x{self.height} is empty or over {MAX_PIXELS}")
        if self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"focal lengths {self.fx:g}, {self.fy:g} px must be positive")
        if len(self.distortion) not in (0, 4, 5, 8):
            raise ValueError(f"{len(self.distortion)} distortion coefficients: must be 4, 5 or 8")


ImageEncoding = Literal[
    "rgb8",  # 3 bytes a pixel
    "bgr8",
    "jpeg",
    "png",  # colour of 8 bits, or depth of 16 bits
    "z16",  # depth, little-endian uint16
    "z16+zstd",  # the same, compressed
    "f32",  # depth, little-endian float32; NaN and infinity mean "not measured", as in ROS
    "f32+zstd",
]
BYTES_PER_PIXEL: dict[str, int] = {"rgb8": 3, "bgr8": 3, "z16": 2, "f32": 4}


class Image(msgspec.Struct, frozen=True, kw_only=True):
    """One image, raw or compressed. A compressed one is checked where it is decompressed."""

    encoding: ImageEncoding
    width: int
    height: int
    data: memoryview

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_PIXELS:
            raise ValueError(f"image size {self.width}x{self.height} is empty or over {MAX_PIXELS}")
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
        """A copy of uncompressed pixels [H, W] or [H, W, 3]."""
        height, width = pixels.shape[:2]
        data = memoryview(np.ascontiguousarray(pixels).tobytes())
        return cls(encoding=encoding, width=width, height=height, data=data)


class CameraRgbd(Message, frozen=True, kw_only=True):
    """camera/rgbd: one exposure as a camera program sends it, depth registered to colour."""

    frame: int  # running number of the camera program; gaps are dropped frames
    camera: CameraModel
    color: Image
    depth: Image
    depth_scale: float  # depth units per metre: 1000 for millimetres, 5000 for TUM, 1 for metres

    def check(self) -> None:
        require_count("frame", self.frame)
        require_color(self.color, self.camera)
        if (self.depth.width, self.depth.height) != (self.color.width, self.color.height):
            raise ValueError("depth and colour differ in size: it must be registered to colour")
        require_depth(self.depth, self.camera, self.depth_scale)


class CameraColor(Message, frozen=True, kw_only=True):
    """camera/color: one colour exposure. Its stamp becomes that of the frame it is paired into."""

    frame: int  # running number of the camera program, and of the frame it is paired into
    camera: CameraModel
    image: Image

    def check(self) -> None:
        require_count("frame", self.frame)
        require_color(self.image, self.camera)


class CameraDepth(Message, frozen=True, kw_only=True):
    """camera/depth: one depth exposure, with a stamp and a camera of its own.

    Depth whose camera is the colour camera and whose T_color_depth is the identity is registered
    already; any other is moved into the colour image.
    """

    frame: int  # running number of the camera program; pairs are made by stamp, not by it
    camera: CameraModel  # of the depth image
    image: Image
    depth_scale: float  # as in camera/rgbd
    T_color_depth: Pose = IDENTITY  # from coordinates of the depth camera to the colour camera's

    def check(self) -> None:
        require_count("frame", self.frame)
        require_depth(self.image, self.camera, self.depth_scale)


class FrameRgbd(Message, frozen=True, kw_only=True):
    """frame/rgbd: one rectified frame, colour and depth on the same pixel grid."""

    frame: int  # as in camera/rgbd
    camera: CameraModel  # without distortion
    color: Array  # u1 [H, W, 3] RGB
    depth_m: Array  # f4 [H, W], z in metres, 0 = not measured

    def check(self) -> None:
        require_count("frame", self.frame)
        require_rgbd(self.camera, self.color, self.depth_m)


def require_color(image: Image, camera: CameraModel) -> None:
    if (image.width, image.height) != (camera.width, camera.height):
        raise ValueError("colour and its camera differ in size")
    if image.encoding not in ("rgb8", "bgr8", "jpeg", "png"):
        raise ValueError(f"colour cannot be encoded as {image.encoding}")


def require_depth(image: Image, camera: CameraModel, depth_scale: float) -> None:
    require_finite("depth_scale", (depth_scale,))
    if depth_scale <= 0:
        raise ValueError(f"depth_scale {depth_scale:g} must be positive")
    if (image.width, image.height) != (camera.width, camera.height):
        raise ValueError("depth and its camera differ in size")
    if image.encoding not in ("png", "z16", "z16+zstd", "f32", "f32+zstd"):
        raise ValueError(f"depth cannot be encoded as {image.encoding}")


def require_rgbd(camera: CameraModel, color: Array, depth_m: Array) -> None:
    if camera.distortion:
        raise ValueError("the camera of a rectified frame has no distortion")
    size = (camera.height, camera.width)
    color.require("color", "u1", (*size, 3))
    depth_m.require("depth_m", "f4", size)
    depth = depth_m.numpy()
    if not (depth.min() >= 0 and depth.max() < float("inf")):  # NaN fails both
        raise ValueError("depth_m must be finite and at least 0, where 0 means not measured")
