"""Pinhole camera with lens distortion. Conventions: `ldo_service.geometry`."""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from math import hypot, isfinite
from numbers import Integral
from typing import Any

import cv2
import numpy as np

from ldo_service.errors import DataError

# Minimum and maximum ratio of focal length to image side: fields of view of 175 and 0.6 degrees.
MIN_FOCAL_RATIO, NARROWEST = 0.02, 100.0

# Maximum radius in normalized coordinates: 76 degrees from the axis, beyond any pinhole model.
FARTHEST_RADIUS = 4.0

# Maximum factor by which a lens changes the distance of a point of the image from its center. A
# fisheye lens (equisolid) has a factor of 3.3 at 76 degrees from the axis.
MAX_LENS_FACTOR = 8.0
# Maximum distortion coefficient, so that polynomials fit into a float32. Tangential
# coefficients, which describe a tilted lens, are below 1.
MAX_COEFFICIENT = 1e6


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera: intrinsics in pixels, with pixel centers at integer coordinates.

    `distortion` holds OpenCV's coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6]]); a rectified
    camera has none.

    Raises:
        DataError: A value is implausible for a camera.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        for name, side in (("width", self.width), ("height", self.height)):
            if isinstance(side, bool) or not isinstance(side, Integral):
                raise DataError(f"camera {name}={side!r} must be an integer number of pixels.")
        if self.width < 1 or self.height < 1:
            raise DataError(
                f"the camera has {self.width}x{self.height} pixels, expected at least 1x1. Give "
                "the width and height of its images."
            )
        if not all(isfinite(n) for n in numbers):
            raise DataError(
                f"camera intrinsics {numbers} contain NaN or infinity. Calibrate the camera again."
            )
        for name, focal, side in (("fx", self.fx, self.width), ("fy", self.fy, self.height)):
            if not NARROWEST * side >= focal >= MIN_FOCAL_RATIO * side:
                raise DataError(
                    f"focal length {name}={focal:g} px is implausible for an image side of "
                    f"{side} px: expected {MIN_FOCAL_RATIO * side:g} to {NARROWEST * side:g} px. "
                    "Check that the focal length is in pixels and for this image size."
                )
        if not (-self.width < self.cx < 2 * self.width):
            raise DataError(
                f"cx={self.cx:g} px is far outside the image, which is {self.width} px wide. "
                "Check that the intrinsics are for this image size."
            )
        if not (-self.height < self.cy < 2 * self.height):
            raise DataError(
                f"cy={self.cy:g} px is far outside the image, which is {self.height} px high. "
                "Check that the intrinsics are for this image size."
            )
        if len(self.distortion) not in (0, 4, 5, 8):
            raise DataError(
                f"{len(self.distortion)} distortion coefficients are given, expected 0, 4, 5 or 8 "
                "as in OpenCV's models. Undistort the images if the lens has another model."
            )
        across = max(self.cx, self.width - self.cx) / self.fx
        down = max(self.cy, self.height - self.cy) / self.fy
        if self.distortion and not _is_lens(self.distortion, hypot(across, down)):
            raise DataError(
                f"distortion {self.distortion} fits no real lens: it changes the distance of a "
                f"point from the image center by more than a factor of {MAX_LENS_FACTOR:g}. Check "
                "the order of the coefficients: k1 k2 p1 p2 k3 k4 k5 k6."
            )

    @staticmethod
    def of(values: Mapping[str, Any]) -> "Camera":
        """Create a camera from the values of its fields by name; `distortion` may be a list."""
        return Camera(**{**values, "distortion": tuple(values["distortion"])})

    @property
    def matrix(self) -> np.ndarray:
        """Intrinsic matrix K [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def halved(self) -> "Camera":
        """Return the camera of the half-size image in which each pixel averages a 2x2 block.

        The distortion coefficients do not change, as they act on normalized coordinates.
        """
        # The values are not checked again: rounding of the size may move a plausible value
        # just beyond its limit.
        halved = copy(self)
        for name, value in (
            ("width", self.width // 2),
            ("height", self.height // 2),
            ("fx", self.fx / 2),
            ("fy", self.fy / 2),
            ("cx", (self.cx + 0.5) / 2 - 0.5),
            ("cy", (self.cy + 0.5) / 2 - 0.5),
        ):
            object.__setattr__(halved, name, value)
        return halved

    def rectified(self) -> "Camera":
        """Return the camera without lens distortion."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def rays(self) -> np.ndarray:
        """Return the viewing rays [H, W, 3] of all pixels; see `rays_at`."""
        return self.rays_at(np.arange(self.width), np.arange(self.height)[:, None])

    def rays_at(self, u: np.ndarray | float, v: np.ndarray | float) -> np.ndarray:
        """Return the viewing rays through pixels, ignoring lens distortion.

        Args:
            u: Columns in pixels; broadcast with v to [...].
            v: Rows in pixels; broadcast with u to [...].

        Returns:
            Rays with z = 1 in the camera frame, [..., 3] float64. A ray times the depth of its
            pixel is the 3D point.
        """
        x, y = np.broadcast_arrays((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        return np.stack([x, y, np.ones(x.shape)], axis=-1)

    def points_at(
        self, u: np.ndarray | float, v: np.ndarray | float, depth_m: np.ndarray | float
    ) -> np.ndarray:
        """Return the 3D points of pixels with depth, ignoring lens distortion.

        Args:
            u: Columns in pixels; broadcast with v to [...].
            v: Rows in pixels; broadcast with u to [...].
            depth_m: Depth along the optical axis, [...] meters.

        Returns:
            Points in the camera frame, [..., 3] meters.
        """
        return self.rays_at(u, v) * np.asarray(depth_m)[..., None]

    def backproject(self, depth_m: np.ndarray) -> np.ndarray:
        """Return the 3D points of a depth image, ignoring lens distortion.

        Args:
            depth_m: Depth along the optical axis, [H, W] meters; 0 where not measured.

        Returns:
            Points in the camera frame, [H, W, 3] float32 meters; (0, 0, 0) where the depth is 0.
        """
        return (self.rays() * depth_m[..., None]).astype(np.float32)

    def project(self, points_camera: np.ndarray) -> np.ndarray:
        """Return the pixels (u, v) of points in the camera frame, ignoring lens distortion.

        Args:
            points_camera: Points with z > 0, [..., 3] meters.

        Returns:
            Pixel coordinates, [..., 2].
        """
        z = points_camera[..., 2]
        return np.stack(
            [
                self.fx * points_camera[..., 0] / z + self.cx,
                self.fy * points_camera[..., 1] / z + self.cy,
            ],
            axis=-1,
        )


@lru_cache(maxsize=4)
def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the normalized coordinates of all pixels, with the lens distortion removed.

    Returns:
        x and y, [H, W] float32 each: the viewing ray of a pixel is (x, y, 1). Both are read-only.
    """
    if any(camera.distortion):
        u, v = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
        pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
        xy = cv2.undistortPoints(pixels, camera.matrix, np.array(camera.distortion))
        xy = xy.reshape(camera.height, camera.width, 2)
    else:
        xy = camera.rays()[..., :2]
    x, y = (np.ascontiguousarray(xy[..., axis], np.float32) for axis in (0, 1))
    x.flags.writeable = y.flags.writeable = False
    return x, y


def project(x: np.ndarray, y: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Project normalized coordinates with OpenCV's distortion model.

    Args:
        x: Normalized horizontal coordinates X / Z, [...] float32.
        y: Normalized vertical coordinates Y / Z, [...] float32.
        camera: The camera, with its lens distortion.

    Returns:
        Pixels u, v, [...] float32. Points beyond the radius where the distortion polynomial starts
        to decrease are NaN, because the polynomial would map them back into the image.
    """
    if any(camera.distortion):
        x, y = _distorted(x, y, camera)
    u = np.float32(camera.fx) * x + np.float32(camera.cx)
    v = np.float32(camera.fy) * y + np.float32(camera.cy)
    return u, v


def _distorted(x: np.ndarray, y: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = _coefficients(camera).astype(np.float32)
    far = _turning_r2(camera)
    r2 = x * x + y * y
    r2[r2 > far] = np.nan
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@lru_cache(maxsize=4)
def _turning_r2(camera: Camera) -> float:
    """Return the squared radius where the distorted radius starts to decrease.

    If it increases up to FARTHEST_RADIUS, return the square of FARTHEST_RADIUS.
    """
    r, radial = _radial(camera.distortion)
    turns = np.flatnonzero(np.diff(r * radial) <= 0)
    return float(r[turns[0]] ** 2) if len(turns) else FARTHEST_RADIUS**2


def _radial(distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return radii up to FARTHEST_RADIUS and the radial factor at each, [4001] each."""
    k1, k2, _, _, k3, k4, k5, k6 = _padded(distortion)
    r = np.linspace(0.0, FARTHEST_RADIUS, 4001)
    r2 = r * r
    with np.errstate(all="ignore"):
        above, below = (
            (1 + r2 * (a + r2 * (b + r2 * c))) for a, b, c in ((k1, k2, k3), (k4, k5, k6))
        )
        return r, above / below


@lru_cache(maxsize=16)
def _is_lens(distortion: tuple[float, ...], corner: float) -> bool:
    """Return whether the radial factor is plausible inside the image.

    Args:
        distortion: Coefficients of the lens.
        corner: Distorted radius of the farthest image corner, in normalized coordinates.
    """
    if max(map(abs, distortion)) > MAX_COEFFICIENT or max(map(abs, distortion[2:4])) > 1.0:
        return False
    r, radial = _radial(distortion)
    with np.errstate(all="ignore"):
        bent = r * radial
        is_last = ~(np.diff(bent) > 0) | (bent[1:] > corner)
        used = radial[: 1 + int(np.argmax(is_last))] if is_last.any() else radial
        return bool(((used >= 1 / MAX_LENS_FACTOR) & (used <= MAX_LENS_FACTOR)).all())


def _coefficients(camera: Camera) -> np.ndarray:
    """Return k1 k2 p1 p2 k3 k4 k5 k6 [8]; coefficients that the camera does not have are 0."""
    return _padded(camera.distortion)


def _padded(distortion: tuple[float, ...]) -> np.ndarray:
    return np.r_[distortion, np.zeros(8)][:8]
