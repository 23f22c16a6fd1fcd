"""Recordings of the app Record3D for iPhones and iPads: a file `.r3d`, which is a ZIP archive.

metadata                 JSON object with these keys:
    w, h                          width and height that K refers to
    K                             intrinsic matrix, column by column
    perFrameIntrinsicCoeffs       optional: [fx, fy, cx, cy] of each frame, instead of K
    dw, dh                        width and height of depth
    fps or frameTimestamps        frames per second, or the stamp of each frame in seconds
    poses                         optional: [qx, qy, qz, qw, x, y, z] of each frame, from camera to
                                  world, camera axes of OpenGL
rgbd/0.jpg               color
rgbd/0.depth             float32 meters, [dh, dw], LZFSE; registered to color; NaN where unknown
rgbd/0.conf              optional: uint8, [dh, dw], LZFSE, 0 to 2; see MIN_CONFIDENCE

The poses of the metadata come from ARKit. They are an estimate, not ground truth, so `odometry`
returns them and `truth` returns None.
"""

import json
import re
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, DataError, FrameError, install_command
from ldo_service.geometry import Camera, RawFrame, Trajectory, se3
from ldo_service.geometry.sequence import Sequence

from .files import FRAME_RATE_HZ, LAST_STAMP_NS, from_opengl, number, valid_trajectory
from .images import MAX_PIXELS, decode_color
from .lzfse import decoded_bytes
from .phone_images import PhoneGrid, scaled, without_doubt

MAX_BYTES = 1 << 27  # Maximum size of a file in the archive; the poses of an hour have 30 MB.

UNREADABLE = (
    *(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error),
    *(NotImplementedError, RuntimeError),  # Encrypted or unknown; JSON that is nested too deep.
)


class Record3DSequence(Sequence):
    """Recording of Record3D: frames with both color and depth, in the order of their numbers."""

    def __init__(self, path: Path) -> None:
        """Open the recording of a file."""
        try:
            import liblzfse  # The library is optional.
        except ImportError as error:
            raise ConfigError(
                f"{path} is a recording of Record3D, which needs the extra `phones`. Install it by "
                f"{install_command('phones')}."
            ) from error
        self._lzfse: Any = liblzfse
        self._path = path
        try:
            self._archive = zipfile.ZipFile(path)
            metadata = json.loads(self._bytes("metadata"))
        except UNREADABLE as error:
            raise DataError(
                f"{path} cannot be read as a recording of Record3D, a ZIP archive with a file "
                f"`metadata` ({type(error).__name__}: {error}). Export or copy it again."
            ) from error
        if not isinstance(metadata, dict):
            raise DataError(
                f"{path}: its file `metadata` contains a {type(metadata).__name__}, expected a "
                "JSON object. Export the recording again."
            )
        names = set(self._archive.namelist())
        found = (re.fullmatch(r"rgbd/(\d{1,9})\.depth", name) for name in names)
        numbers = sorted(int(m[1]) for m in found if m and f"rgbd/{m[1]}.jpg" in names)
        if not numbers:
            raise DataError(
                f"{path} has no pair of files rgbd/N.jpg and rgbd/N.depth with an equal number N. "
                "Export the recording again as .r3d, with depth."
            )
        self._numbers, self._has_confidence = numbers, {k for k in numbers if _conf(k) in names}
        self._depth_shape = _size(metadata, "dh", path), _size(metadata, "dw", path)
        self._metadata, self._color_size = metadata, self._first_size()
        self._cameras = [self._camera(k) for k in numbers]
        self._grid = PhoneGrid(self._cameras[0])
        super().__init__(path.stem, self._grid.camera, self._stamps_ns())

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        k = self._numbers[index]
        depth_m = self._image(f"rgbd/{k}.depth", np.float32)
        if k in self._has_confidence:
            confidence = self._image(_conf(k), np.uint8)
            depth_m = without_doubt(depth_m, confidence, f"{self._path}: {_conf(k)}")
        stamp_ns, camera = int(self.stamps_ns[index]), self._cameras[index]
        return self._grid.frame(index, stamp_ns, self._color(k), depth_m, 1.0, camera)

    def truth(self) -> Trajectory | None:
        """Return None; the poses of the phone are an estimate."""
        return None

    def odometry(self) -> Trajectory | None:
        """Return the poses of the phone, or None if the metadata have none."""
        listed = self._metadata.get("poses")
        poses = listed if isinstance(listed, list) else []
        found = [_pose(poses[k]) if k < len(poses) else None for k in self._numbers]
        return valid_trajectory(self.stamps_ns, found)

    def _bytes(self, name: str) -> bytes:
        """Return the content of a file in the archive.

        The method raises one of the exceptions in UNREADABLE if the file cannot be read.
        """
        entry = self._archive.getinfo(name)
        if entry.file_size > MAX_BYTES:
            raise ValueError(f"{name} has {entry.file_size} bytes, expected at most {MAX_BYTES}")
        return self._archive.read(entry)

    def _frame_bytes(self, name: str) -> bytes:
        try:
            return self._bytes(name)
        except UNREADABLE as error:
            raise FrameError(
                f"{self._path}: {name} cannot be read ({type(error).__name__}: {error}). Export or "
                "copy the recording again."
            ) from error

    def _color(self, k: int) -> np.ndarray:
        name = f"rgbd/{k}.jpg"
        return decode_color(self._frame_bytes(name), f"{self._path}: {name}")

    def _first_size(self) -> tuple[int, int]:
        """Return width and height of the first readable color image."""
        for k in self._numbers:
            with suppress(FrameError):  # Reading this frame later raises the error again.
                height, width = self._color(k).shape[:2]
                return width, height
        raise DataError(f"{self._path}: no color image is readable. Export the recording again.")

    def _image(self, name: str, dtype: type) -> np.ndarray:
        """Decompress an image [dh, dw].

        Raises:
            FrameError: The image is damaged, or has another size.
        """
        data, (height, width) = self._frame_bytes(name), self._depth_shape
        size = height * width * np.dtype(dtype).itemsize
        try:  # The headers are checked first, because the decoder has no limit of its own.
            content = self._lzfse.decompress(data) if decoded_bytes(data) == size else b""
        except (self._lzfse.error, MemoryError):
            content = b""
        if len(content) != size:
            raise FrameError(
                f"{self._path}: {name} is damaged, or it is not an image of {width}x{height} "
                f"pixels of type {np.dtype(dtype)}. Export or copy the recording again."
            )
        return np.frombuffer(content, dtype).reshape(height, width)

    def _camera(self, k: int) -> Camera:
        """Return the camera of a frame, for the size of its color image.

        Raises:
            DataError: The intrinsics are missing or implausible.
        """
        fields, path = self._metadata, self._path
        K, by_frame = fields.get("K"), fields.get("perFrameIntrinsicCoeffs")
        if isinstance(by_frame, list) and k < len(by_frame):
            key, values = f"perFrameIntrinsicCoeffs[{k}]", by_frame[k]
        else:
            key = "K"
            values = [K[0], K[4], K[6], K[7]] if isinstance(K, list) and len(K) == 9 else None
        if not isinstance(values, list) or len(values) != 4:
            raise DataError(
                f"{path}: {key} of the metadata is missing or has a wrong length. Export the "
                "recording again."
            )
        listed = {f"{key}[{position}]": value for position, value in enumerate(values)}
        try:
            fx, fy, cx, cy = (number(listed, position, path) for position in listed)
            camera = Camera(_size(fields, "w", path), _size(fields, "h", path), fx, fy, cx, cy)
        except DataError as error:
            raise DataError(f"{path} has invalid intrinsics in its metadata: {error}") from error
        return scaled(camera, *self._color_size, str(path))

    def _stamps_ns(self) -> np.ndarray:
        """Return the stamps of the frames, [N] int64, which ascend.

        Raises:
            DataError: The stamps or the rate are invalid.
        """
        stamps: Any = self._metadata.get("frameTimestamps")
        rate = self._metadata.get("fps", FRAME_RATE_HZ)
        found: list[int] = []
        is_valid = False
        with suppress(TypeError, ValueError, ArithmeticError, LookupError):
            found = [round((stamps[k] if stamps else k / rate) * 1e9) for k in self._numbers]
            is_valid = max(map(abs, found)) <= LAST_STAMP_NS and bool(np.all(np.diff(found) > 0))
        if not is_valid:
            raise DataError(
                f"{self._path}: the metadata need frameTimestamps or fps. frameTimestamps must be "
                "an ascending list with one time in seconds for each frame. fps must be a positive "
                "number. Export the recording again."
            )
        return np.array(found, np.int64)


def _conf(k: int) -> str:
    return f"rgbd/{k}.conf"


def _pose(numbers: Any) -> np.ndarray | None:
    """Return the transform [4, 4] of qx, qy, qz, qw, x, y, z; None if they are not a valid pose."""
    try:
        x, y, z, w, *translation = (float(number) for number in numbers)
        q = np.array([w, x, y, z])
        norm = float(np.linalg.norm(q))
    except (TypeError, ValueError, OverflowError):
        return None
    if len(translation) != 3 or not 0.9 < norm < 1.1:
        return None
    return from_opengl(se3.from_quaternion(np.array(translation), q / norm))


def _size(metadata: dict[str, Any], key: str, path: Path) -> int:
    size = number(metadata, key, path)
    if not 1 <= size <= MAX_PIXELS**0.5 or size != int(size):
        raise DataError(
            f"{path}: {key} of the metadata is {size:g}, expected a whole number of pixels from 1 "
            f"to {MAX_PIXELS**0.5:.0f}. Export the recording again."
        )
    return int(size)
