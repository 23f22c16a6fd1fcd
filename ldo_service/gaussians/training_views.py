"""Training views (keyframes that the map is optimized against) and their random choice.

The images of a training view are stored as compressed bytes. If the estimate of the camera's
vignetting or depth bias changes later, the images are converted when they are read.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import msgspec
import numpy as np
import zstandard

from ldo_service.calibration.correction import CameraCorrection, CorrectionChange
from ldo_service.errors import DataError
from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.geometry.frames import pixels_without_data
from ldo_service.kernels import _align

from .exposure import Exposure

ANY_DIFFERENCE = 1e3  # Relative difference of depths in a block that no two depths reach.
_LEVEL = 1  # Compression level of zstd.
# A depth image counts as quantized if its tested rows compress to less than this fraction of their
# size: the sensor measures in steps, so the same bytes repeat. To test all rows would take 2 ms.
_QUANTIZED = 0.25
_TESTED_ROWS = slice(None, None, 8)


@dataclass(frozen=True, eq=False, slots=True)
class TrainingView:
    """A keyframe with everything that the image loss needs.

    Attributes:
        keyframe: Id of the keyframe.
        camera: Intrinsics without distortion.
        color: [3, H, W] uint8.
        depth_m: [H, W] float32, meters; 0 where not measured.
        T_map_camera: Pose, [4, 4].
        exposure: Gain and bias of the image relative to the map.
        mask: [H, W] uint8, 0 where the pixel is ignored; None to use all pixels.
    """

    keyframe: int
    camera: Camera
    color: np.ndarray
    depth_m: np.ndarray
    T_map_camera: np.ndarray
    exposure: Exposure = field(default_factory=Exposure)
    mask: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        frame: RgbdFrame,
        T_map_camera: np.ndarray,
        keyframe: int,
        ignored: np.ndarray | None = None,
    ) -> "TrainingView":
        """Return the training view of a frame, with gain 1 and bias 0.

        Args:
            frame: Color and depth.
            T_map_camera: Pose, [4, 4].
            keyframe: Id of the keyframe.
            ignored: Pixels that are not used, [H, W] bool; None to use all.
        """
        planes = np.ascontiguousarray(frame.color.transpose(2, 0, 1))
        mask = None if ignored is None else (~ignored).astype(np.uint8)
        return cls(keyframe, frame.camera, planes, frame.depth_m, T_map_camera, mask=mask)

    def halved(self) -> "TrainingView":
        """Return the view at half resolution; each pixel averages a block of 2x2 pixels.

        A block has a depth if all of its pixels have one. Depths of different surfaces in a block
        are averaged, as in a rendered depth image. A block is ignored if one of its pixels is.
        """
        camera = self.camera.halved()
        size = (camera.width, camera.height)
        rows, columns = slice(2 * camera.height), slice(2 * camera.width)
        color = np.empty((3, camera.height, camera.width), np.uint8)
        for plane, half in zip(self.color[:, rows, columns], color, strict=True):
            cv2.resize(np.ascontiguousarray(plane), size, half, interpolation=cv2.INTER_AREA)
        mask = self.mask
        if mask is not None:
            upper, lower = mask[rows, columns][::2], mask[rows, columns][1::2]
            both = np.minimum(upper, lower)
            mask = np.minimum(both[:, ::2], both[:, 1::2])
        depth_m = _align.halve(np.ascontiguousarray(self.depth_m), ANY_DIFFERENCE, 4)
        return replace(self, camera=camera, color=color, depth_m=depth_m, mask=mask)


def ignored_pixels(frame: RgbdFrame, dynamic_mask: np.ndarray | None) -> np.ndarray | None:
    """Return which pixels of a keyframe are not mapped, [H, W] bool; None if all are.

    These are the pixels of moving objects, and those for which the camera delivered no data.
    """
    mask = pixels_without_data(frame)
    if dynamic_mask is not None:
        mask |= dynamic_mask
    return mask if mask.any() else None


def sampled_surface(view: TrainingView, *, step_px: int = 32) -> np.ndarray:
    """Return measured 3D points in the map frame, [M, 3], at every `step_px`-th row and column."""
    coarse = slice(step_px // 2, None, step_px)
    z = view.depth_m[coarse, coarse]
    points = view.camera.rays()[coarse, coarse][z > 0] * z[z > 0][:, None]
    return se3.transform(view.T_map_camera, points)


def covisibility_ratio(p_map: np.ndarray, camera: Camera, T_map_camera: np.ndarray) -> float:
    """Return the fraction of points that are in front of a camera and inside its image, 0..1.

    Occlusion is ignored. If there are no points, the result is 0.

    Args:
        p_map: Points in the map frame, [M, 3].
        camera: Intrinsics.
        T_map_camera: Camera pose, [4, 4].
    """
    points = se3.transform(se3.inverse(T_map_camera), p_map)
    points = points[points[:, 2] > 0.05]
    u, v = camera.project(points).T
    inside = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    return float(np.count_nonzero(inside)) / max(len(p_map), 1)


def visible_in_mask(
    pixels: np.ndarray, p_map: np.ndarray, camera: Camera, T_map_camera: np.ndarray
) -> np.ndarray:
    """Return which points project into selected pixels, [M] bool.

    Occlusion is ignored, so points behind the surface count too.

    Args:
        pixels: Selected pixels, [H, W] bool.
        p_map: Points in the map frame, [M, 3].
        camera: Intrinsics.
        T_map_camera: Camera pose, [4, 4].
    """
    p_camera = se3.transform(se3.inverse(T_map_camera), p_map)
    out = p_camera[:, 2] > 0
    u, v = np.rint(camera.project(p_camera[out])).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    inside[inside] = pixels[v[inside].astype(int), u[inside].astype(int)]
    out[out] = inside
    return out


def sample_training_views(
    newest: int,
    covisible: Sequence[int],
    others: Sequence[int],
    iterations: int,
    rng: np.random.Generator,
    *,
    newest_share: float,
    covisible_share: float,
) -> list[int]:
    """Choose the keyframe of each iteration at random.

    An iteration that would draw from an empty list uses the newest keyframe.

    Args:
        newest: The newest keyframe. The first iteration uses it unless `newest_share` is 0.
        covisible: Keyframes covisible with the newest one.
        others: Keyframes for the remaining iterations; they may include `covisible`.
        iterations: Number of iterations.
        rng: Random generator.
        newest_share: Expected fraction of the iterations that use the newest keyframe.
        covisible_share: Expected fraction of the iterations that use one of `covisible`; the rest
            use one of `others`.

    Returns:
        Ids of the keyframes, one per iteration.
    """
    out = []
    draws = rng.random(iterations)
    draws[: newest_share > 0] = 0
    for draw in draws:
        if draw < newest_share:
            choice: Sequence[int] = ()
        elif draw < newest_share + covisible_share:
            choice = covisible
        else:
            choice = others
        out.append(choice[int(rng.integers(len(choice)))] if choice else newest)
    return out


@dataclass(frozen=True, eq=False, slots=True)
class KeyframeImages:
    """Images and camera of a training view.

    Attributes:
        keyframe: Id of the keyframe.
        camera: Intrinsics without distortion.
        color: [3, H, W] uint8.
        depth_m: [H, W] float32, meters; 0 where not measured.
        mask: [H, W] uint8, 0 where the pixel is ignored; None to use all pixels.
        correction: Correction of the camera that was applied to the images. None if unknown, in
            images that an older version of LDO-SLAM stored.

    Raises:
        DataError: The images do not fit the camera.
    """

    keyframe: int
    camera: Camera
    color: np.ndarray
    depth_m: np.ndarray
    mask: np.ndarray | None = None
    correction: CameraCorrection | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        self._require("color", self.color, np.uint8, (3, *size))
        self._require("depth_m", self.depth_m, np.float32, size)
        if self.mask is not None:
            self._require("mask", self.mask, np.uint8, size)

    def _require(self, name: str, image: np.ndarray, dtype: type, shape: tuple[int, ...]) -> None:
        if image.dtype != dtype or image.shape != shape:
            raise DataError(
                f"keyframe {self.keyframe}: {name} is {image.dtype}{image.shape}, expected "
                f"{np.dtype(dtype)}{shape}. Use this type and the camera's image size."
            )

    @classmethod
    def of(cls, view: TrainingView, correction: CameraCorrection | None = None) -> "KeyframeImages":
        """Return the images of a training view, to which a correction was applied."""
        return cls(view.keyframe, view.camera, view.color, view.depth_m, view.mask, correction)

    def recorrected(self, correction: CameraCorrection) -> "KeyframeImages":
        """Convert the images to another correction; images of unknown correction stay unchanged."""
        if self.correction is None or self.correction == correction:
            return self
        change = CorrectionChange(self.correction, correction)
        color = change.color(self.color, self.camera)
        depth_m = change.depth_m(self.depth_m, self.camera)
        color.flags.writeable = depth_m.flags.writeable = False
        return replace(self, color=color, depth_m=depth_m, correction=correction)

    def view(self, T_map_camera: np.ndarray, exposure: Exposure | None = None) -> TrainingView:
        """Return these images as a training view with a pose [4, 4] and an exposure.

        If `exposure` is None, the gain is 1 and the bias is 0.
        """
        return TrainingView(
            self.keyframe,
            self.camera,
            self.color,
            self.depth_m,
            T_map_camera,
            exposure or Exposure(),
            self.mask,
        )

    @property
    def nbytes(self) -> int:
        """Size of the images in bytes."""
        images = (self.color, self.depth_m, self.mask)
        return sum(image.nbytes for image in images if image is not None)

    def owned(self) -> "KeyframeImages":
        """Return read-only copies of the images.

        The originals may share the memory of a received message, and would keep it allocated.
        """
        mask = None if self.mask is None else _own(self.mask)
        return replace(self, color=_own(self.color), depth_m=_own(self.depth_m), mask=mask)


def _own(image: np.ndarray) -> np.ndarray:
    out = image.copy()
    out.flags.writeable = False
    return out


# --- bytes ------------------------------------------------------------------------------------
class _Stored(msgspec.Struct, frozen=True):
    keyframe: int
    camera: Camera
    color: bytes  # This and the other bytes are compressed with zstd.
    depth: bytes
    is_depth_differences: bool
    mask: bytes | None
    correction: CameraCorrection | None = None


def pack(images: KeyframeImages) -> bytes:
    """Compress images without loss to about a quarter of their size."""
    depth, is_differences = _packed_depth(images.depth_m)
    stored = _Stored(
        images.keyframe,
        images.camera,
        _compressed(_color_differences(images.color)),
        depth,
        is_differences,
        None if images.mask is None else _compressed(images.mask),
        images.correction,
    )
    return msgspec.msgpack.encode(stored)


def unpack(body: bytes | memoryview) -> KeyframeImages:
    """Return the images from their packed form.

    Raises:
        DataError: The bytes are not packed images.
    """
    try:
        stored = msgspec.msgpack.decode(body, type=_Stored)
        camera = stored.camera
        size = (camera.height, camera.width)
        color = _color_of(_expanded(stored.color, np.uint8, (3, *size)))
        depth_m = _depth_of(stored.depth, stored.is_depth_differences, size)
        mask = None if stored.mask is None else _expanded(stored.mask, np.uint8, size)
    except (zstandard.ZstdError, ValueError, RecursionError) as error:
        raise DataError(
            f"data of {len(body)} bytes cannot be decoded as the images of a keyframe: {error}"
        ) from error
    for image in (color, depth_m, mask):
        if image is not None:
            image.flags.writeable = False
    return KeyframeImages(stored.keyframe, camera, color, depth_m, mask, stored.correction)


def _color_differences(color: np.ndarray) -> np.ndarray:
    """Return color as small differences, which compress better.

    Green is subtracted from red and blue. Then the row above is subtracted from each row. All
    differences are modulo 256.
    """
    out = color.copy()
    out[0::2] -= color[1]
    out[:, 1:] = np.subtract(out[:, 1:], out[:, :-1])
    return out


def _color_of(differences: np.ndarray) -> np.ndarray:
    """Invert `_color_differences` in place, which is faster than allocating a new array."""
    for plane in differences:
        np.add.accumulate(plane, axis=0, dtype=np.uint8, out=plane)
    differences[0::2] += differences[1]
    return differences


def _packed_depth(depth_m: np.ndarray) -> tuple[bytes, bool]:
    """Compress depth [H, W].

    Quantized depth is stored unchanged. Other depth is stored as differences between rows, with the
    first bytes of all values first, then the second bytes and so on. This halves the size.

    Returns:
        The bytes, and whether they contain differences.
    """
    tested = depth_m[_TESTED_ROWS]
    if len(_compressed(tested)) < _QUANTIZED * tested.nbytes:
        return _compressed(depth_m), False
    bits = depth_m.view(np.uint32)
    differences = bits.copy()
    differences[1:] -= bits[:-1]
    return _compressed(differences.reshape(-1, 1).view(np.uint8).T), True


def _depth_of(data: bytes, is_differences: bool, size: tuple[int, int]) -> np.ndarray:
    if not is_differences:
        return _expanded(data, np.float32, size)
    planes = _expanded(data, np.uint8, (4, size[0] * size[1]))
    differences = np.ascontiguousarray(planes.T).view(np.uint32).reshape(size)
    np.add.accumulate(differences, axis=0, dtype=np.uint32, out=differences)
    return differences.view(np.float32)


def _compressed(array: np.ndarray) -> bytes:
    return zstandard.ZstdCompressor(level=_LEVEL).compress(np.ascontiguousarray(array).data)


def _expanded(data: bytes, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
    out = np.empty(shape, dtype)
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        filled = stream.readinto(out.reshape(-1).view(np.uint8).data)
        if filled < out.nbytes or stream.read(1):
            size = f"only {filled}" if filled < out.nbytes else "more"
            raise ValueError(
                f"an image of shape {shape} needs {out.nbytes} bytes, but the data contains {size}"
            )
    return out
