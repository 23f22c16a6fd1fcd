"""Correction of vignetting and depth bias in frames."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, RgbdFrame
from ldo_service.geometry.frames import brightest

from .shutter import ShutterTiming

BIAS_TERMS = 3  # x^2, x y, y^2.
VIGNETTING_TERMS = 3  # r^2, r^4, r^6.
# Names of the entries of the covariance of the depth bias among the metrics.
BIAS_COVARIANCE = {
    f"depth_bias_covariance_{i + 1}{j + 1}": (i, j) for i in range(BIAS_TERMS) for j in range(i + 1)
}
# Gray level from which a pixel may be clipped. The true brightness of such a pixel is unknown.
CLIPPED_GRAY = 250
MIN_INVERSE_DEPTH = 0.02  # 1/m. A bias cannot move a surface beyond 50 m.
MIN_TRANSMISSION = 0.3  # Darker corners would be amplified together with their noise.


@dataclass(frozen=True, slots=True)
class CameraCorrection:
    """Vignetting and depth bias of a camera, in its rectified image.

    A pixel (u, v) has the coordinates x = (u - cu) / (w/2) and y = (v - cv) / (w/2) around the
    center (cu, cv) of an image of width w. Its distance r from the center is scaled to 1 in the
    corners. The errors of the camera are:

        1 / z_true = 1 / z_measured + b1 x^2 + b2 x y + b3 y^2
        color_measured = V(r) color_true,  log V = a1 r^2 + a2 r^4 + a3 r^6 per channel

    The bias has no constant term and no linear terms. Such terms would scale and tilt the depth.
    They could hardly be estimated, because changed poses have nearly the same effect on the
    measurements.
    """

    depth_bias: tuple[float, ...] = (0.0,) * BIAS_TERMS  # b1, b2, b3 in 1/m.
    # a1, a2, a3 of red, green and blue.
    vignetting: tuple[tuple[float, ...], ...] = ((0.0,) * VIGNETTING_TERMS,) * 3
    # Times of the shutter. `applied` does not use them, because they need the motion of a frame:
    # see `FrameMotion.compensated`.
    timing: ShutterTiming = field(default_factory=ShutterTiming)

    @staticmethod
    def of(values: Mapping[str, Any]) -> "CameraCorrection":
        """Restore a correction from a mapping of names to values, as `pack` returns it.

        The values may be lists or tuples of numbers.
        """
        return CameraCorrection(
            tuple(values["depth_bias"]),
            tuple(tuple(a) for a in values["vignetting"]),
            ShutterTiming.of(values),
        )

    def pack(self) -> dict[str, Any]:
        """Return a dictionary from the name of each value to a number or a list of numbers."""
        return {
            "depth_bias": list(self.depth_bias),
            "vignetting": [list(channel) for channel in self.vignetting],
            **self.timing.pack(),
        }

    @property
    def of_images(self) -> "CameraCorrection":
        """Correction of images alone, without the times of the shutter."""
        return replace(self, timing=ShutterTiming())

    @property
    def has_depth_bias(self) -> bool:
        return any(self.depth_bias)

    @property
    def has_vignetting(self) -> bool:
        return any(any(channel) for channel in self.vignetting)

    def applied(self, frame: RgbdFrame, *, keeps_clipped: bool = True) -> RgbdFrame:
        """Return the frame that a camera without vignetting and depth bias would have delivered.

        If this correction changes nothing, the frame itself is returned.

        All colors are darkened to the level of the strongest vignetting. If they were brightened to
        the level of the center instead, bright pixels would be clipped.

        Args:
            frame: Rectified frame, which is not changed.
            keeps_clipped: True to leave the colors of pixels that may be clipped unchanged, so that
                the tracker still recognizes these pixels as clipped. False to correct them too, so
                that they match their surroundings in the map.
        """
        color, depth_m = frame.color, self.corrected_depth(frame.depth_m, frame.camera)
        if self.has_vignetting:
            even = (color * self.gain(frame.camera) + np.float32(0.5)).astype(np.uint8)
            if keeps_clipped:
                even = np.where(brightest(color)[..., None] >= CLIPPED_GRAY, color, even)
            color = even
        if color is frame.color and depth_m is frame.depth_m:
            return frame
        return replace(frame, color=color, depth_m=depth_m)

    def corrected_depth(self, depth_m: np.ndarray, camera: Camera) -> np.ndarray:
        """Remove the bias from measured depth [H, W] in meters; 0 stays 0."""
        return unbiased_depth(depth_m, self.bias(camera)) if self.has_depth_bias else depth_m

    def gain(self, camera: Camera) -> np.ndarray:
        """Return the factors [H, W, 3] float32 by which `applied` multiplies the colors."""
        return _gain_image(self.vignetting, camera)

    def bias(self, camera: Camera) -> np.ndarray:
        """Return the bias that is added to the inverse depth, [H, W] float32, in 1/m."""
        return _bias_image(self.depth_bias, camera)


def read_correction(folder: Path) -> CameraCorrection:
    """Return the camera correction with which the last keyframe of a finished run was made.

    The map converts the images of earlier keyframes to its vignetting and depth bias. The result
    changes nothing if there is no keyframe, or if the version of LDO-SLAM that wrote the run did
    not save corrections.

    Raises:
        DataError: keyframes.json of the folder cannot be read, or its content is invalid.
    """
    path = folder / "keyframes.json"
    try:
        keyframes = json.loads(path.read_text())
        last = max(keyframes, key=lambda keyframe: int(keyframe["stamp_ns"]), default={})
        return CameraCorrection.of(last.get("camera_correction", NO_CORRECTION))
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}. Give the folder of a finished `ldo run`."
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{path} does not have the format that `ldo run` writes ({error!r}). Give the folder "
            "of a finished `ldo run`."
        ) from error


NO_CORRECTION = CameraCorrection().pack()


@dataclass(frozen=True, slots=True)
class CorrectionChange:
    """Replacement of an old correction by a new one, for images corrected by the old one."""

    old: CameraCorrection
    new: CameraCorrection

    @staticmethod
    def of(values: Mapping[str, Any]) -> "CorrectionChange":
        """Restore a change from a mapping of names to values, as `pack` returns it."""
        return CorrectionChange(
            CameraCorrection.of(values["old"]), CameraCorrection.of(values["new"])
        )

    def pack(self) -> dict[str, Any]:
        """Return both corrections by name, each as `CameraCorrection.pack` returns it."""
        return {"old": self.old.pack(), "new": self.new.pack()}

    def after(self, earlier: "CorrectionChange | None") -> "CorrectionChange":
        """Combine an earlier change, if there is one, and this change into a single change."""
        return self if earlier is None else replace(self, old=earlier.old)

    def depth_m(self, depth_m: np.ndarray, camera: Camera) -> np.ndarray:
        """Convert depth [H, W] in meters from the old correction to the new one."""
        if self.old.depth_bias == self.new.depth_bias:
            return depth_m
        return unbiased_depth(depth_m, self.new.bias(camera) - self.old.bias(camera))

    def color(self, planes: np.ndarray, camera: Camera) -> np.ndarray:
        """Convert color [3, H, W] uint8 from the old correction to the new one."""
        if self.old.vignetting == self.new.vignetting:
            return planes
        gain = (self.new.gain(camera) / self.old.gain(camera)).transpose(2, 0, 1)
        return np.clip(planes * gain + np.float32(0.5), 0, 255).astype(np.uint8)

    def brightness(self, camera: Camera) -> np.ndarray:
        """Return the factor, [3] float32, by which the colors at the center of the image change.

        `CameraCorrection.applied` darkens the center to the level of the strongest vignetting. The
        exposure of a converted image changes by this factor.
        """
        at = camera.height // 2, camera.width // 2
        return self.new.gain(camera)[at] / self.old.gain(camera)[at]

    def gray(self, gray: np.ndarray, camera: Camera) -> np.ndarray:
        """Convert a gray image [H, W] uint8 from the old correction to the new one.

        Two kinds of pixels do not change: pixels that may be clipped, and black pixels, which are
        invalid.
        """
        if self.old.vignetting == self.new.vignetting:
            return gray
        gain = _gray_gain(self.old.vignetting, self.new.vignetting, camera)
        changed = np.clip(gray * gain + np.float32(0.5), 1, CLIPPED_GRAY - 1).astype(np.uint8)
        return np.where((gray >= CLIPPED_GRAY) | (gray == 0), gray, changed)

    def points(self, points_camera: np.ndarray, camera: Camera) -> np.ndarray:
        """Convert measured points [N, 3] from the old correction to the new one.

        Points are in meters in the camera frame. Each one stays on the viewing ray of its pixel.
        """
        u, v = camera.project(points_camera).T
        bias = np.subtract(self.new.depth_bias, self.old.depth_bias)
        z = points_camera[:, 2]
        ratio = unbiased_depth(z, bias_basis(u, v, camera) @ bias) / z
        return points_camera * ratio[:, None]


def unbiased_depth(depth_m: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Correct depth by adding a value to its inverse.

    Args:
        depth_m: Depth in meters, [...]; 0 where unknown, which stays 0.
        bias: Value to add to the inverse depth in 1/m, [...].

    Returns:
        Depth in meters, [...] in the type of `depth_m`.
    """
    is_known = depth_m > 0
    inverse = 1.0 / np.where(is_known, depth_m, 1.0) + bias
    np.maximum(inverse, MIN_INVERSE_DEPTH, out=inverse)
    corrected = np.divide(1.0, inverse, out=inverse)
    corrected *= is_known
    return corrected.astype(depth_m.dtype, copy=False)


def bias_basis(u: np.ndarray, v: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the basis functions x^2, x y, y^2 of the depth bias at pixels (u, v), [..., 3]."""
    x, y = _centered(u, v, camera)
    return np.stack([x * x, x * y, y * y], axis=-1)


def vignetting_basis(u: np.ndarray, v: np.ndarray, camera: Camera) -> np.ndarray:
    """Return r^2, r^4, r^6 at pixels (u, v), [..., 3]: the basis functions of log vignetting."""
    x, y = _centered(u, v, camera)
    r2 = (x * x + y * y) / (1.0 + (camera.height / camera.width) ** 2)
    return np.stack([r2, r2**2, r2**3], axis=-1)


def _centered(u: np.ndarray, v: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    half = camera.width / 2.0
    x, y = (u - (camera.width - 1) / 2.0) / half, (v - (camera.height - 1) / 2.0) / half
    return np.broadcast_arrays(x, y)  # type: ignore[return-value]


@lru_cache(maxsize=8)
def _bias_image(coefficients: tuple[float, ...], camera: Camera) -> np.ndarray:
    x, y = _image_axes(camera)
    b1, b2, b3 = (np.float32(b) for b in coefficients)
    return b1 * x * x + (b2 * x + b3 * y) * y


@lru_cache(maxsize=8)
def _gain_image(coefficients: tuple[tuple[float, ...], ...], camera: Camera) -> np.ndarray:
    x, y = _image_axes(camera)
    r2 = (x * x + y * y) / np.float32(1.0 + (camera.height / camera.width) ** 2)
    gains = []
    for a1, a2, a3 in coefficients:
        log_V = ((np.float32(a3) * r2 + np.float32(a2)) * r2 + np.float32(a1)) * r2
        gains.append(np.maximum(np.exp(log_V), np.float32(MIN_TRANSMISSION)))
        np.divide(gains[-1].min(), gains[-1], out=gains[-1])
    return np.asarray(cv2.merge(gains))


@lru_cache(maxsize=4)
def _gray_gain(
    old: tuple[tuple[float, ...], ...], new: tuple[tuple[float, ...], ...], camera: Camera
) -> np.ndarray:
    """Return the factors [H, W] that convert a gray image from the old vignetting to the new."""
    old_sum, new_sum = (sum(cv2.split(_gain_image(each, camera))) for each in (old, new))
    return np.asarray(new_sum / old_sum)


def _image_axes(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the centered coordinates x [1, W] and y [H, 1] of all pixels, float32."""
    half = camera.width / 2.0
    x, y = ((np.arange(n) - (n - 1) / 2.0) / half for n in (camera.width, camera.height))
    return x.astype(np.float32)[None, :], y.astype(np.float32)[:, None]
