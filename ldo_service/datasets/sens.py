"""Sequences in ScanNet's binary format .sens, version 4 (Dai et al., CVPR 2017).

All numbers are little-endian, and matrices are 4x4 float32 by rows:

    uint32 version, uint64 length of the name, name of the sensor
    intrinsics of color, extrinsics of color, intrinsics of depth, extrinsics of depth
    int32 color compression, int32 depth compression
    uint32 width and height of color, width and height of depth
    float32 units of depth per meter, uint64 number of frames
    frames: pose camera to world, -inf where unknown; uint64 stamp of color, stamp of depth, both in
    microseconds; uint64 bytes of color, bytes of depth; color; depth

Color is raw RGB, PNG or JPEG; depth is uint16, raw or compressed by zlib. Data after the frames,
such as inertial measurements, are not read. The docstring of `RigSequence` explains cameras,
registration and poses.
"""

import logging
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, Trajectory, se3

from .files import FRAME_RATE_HZ, LAST_STAMP_NS, Calibration, is_rigid, valid_trajectory
from .images import MAX_PIXELS, decode_color
from .rig import Rig, RigSequence, SequenceOptions

log = logging.getLogger(__name__)

VERSION = 4
MAX_NAME_BYTES = 4096
RAW_COLOR, PNG, JPEG = 0, 1, 2  # Compressions of color.
RAW_DEPTH, ZLIB = 0, 1  # Compressions of depth.
MATRICES = struct.Struct("<64f")
FORMAT = struct.Struct("<2i4IfQ")
FRAME = struct.Struct("<16f4Q")


@dataclass(frozen=True, slots=True, eq=False)
class _Header:
    """Header of a file."""

    rig: Rig
    depth_scale: float  # Units of depth per meter.
    color_compression: int
    depth_compression: int
    frames: int


@dataclass(frozen=True, slots=True, eq=False)
class _Index:
    """Positions of the frames in the file, and the pose, stamp and sizes of each frame."""

    T_world_camera: np.ndarray  # [N, 4, 4] float64; not finite where unknown.
    stamps_us: np.ndarray  # [N] uint64, of color.
    offsets: np.ndarray  # [N] int64, of the color image.
    sizes: np.ndarray  # [N, 2] int64, bytes of color and depth.


class SensSequence(RigSequence):
    """Sequence of a .sens file; the images of a frame are read when `read` is called."""

    def __init__(self, path: Path, options: SequenceOptions) -> None:
        """Open the sequence of a file, and index its frames."""
        self._path = path
        try:
            with path.open("rb") as file:
                self._header = _header(file, path)
                self._index = _index(file, path, self._header.frames)
        except OSError as error:
            raise DataError(f"{path} cannot be read: {error.strerror}. Copy it again.") from error
        stamps_ns = _stamps_ns(self._index.stamps_us, path)
        super().__init__(path.stem, self._header.rig, stamps_ns, options)

    def read_images(self, index: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return color, depth, and the units of depth per meter; see `RigSequence.read_images`."""
        source = f"{self._path}, frame {index}"
        color_size, depth_size = map(int, self._index.sizes[index])
        try:
            with self._path.open("rb") as file:
                file.seek(int(self._index.offsets[index]))
                color, depth = file.read(color_size), file.read(depth_size)
        except OSError as error:
            raise FrameError(
                f"{source} cannot be read: {error.strerror}. Copy the file again."
            ) from error
        return self._color(color, source), self._depth(depth, source), self._header.depth_scale

    def read_depth_poses(self) -> Trajectory | None:
        """Return the poses of the depth camera; see `RigSequence.read_depth_poses`."""
        return valid_trajectory(self.stamps_ns, list(self._index.T_world_camera))

    def _color(self, data: bytes, source: str) -> np.ndarray:
        """Return the color image [Hc, Wc, 3] uint8 RGB."""
        if self._header.color_compression != RAW_COLOR:
            return decode_color(data, f"{source}, color")
        camera = self._header.rig.color_camera
        _require_bytes(data, camera.width * camera.height * 3, f"{source}, color")
        return np.frombuffer(data, np.uint8).reshape(camera.height, camera.width, 3)

    def _depth(self, data: bytes, source: str) -> np.ndarray:
        """Return the depth image [Hd, Wd] uint16."""
        camera = self._header.rig.depth_camera
        size = camera.width * camera.height * 2
        if self._header.depth_compression == ZLIB:
            try:  # The limit is needed, because few bytes may expand to gigabytes.
                data = zlib.decompressobj().decompress(data, size + 1)
            except zlib.error as error:
                raise FrameError(
                    f"{source}, depth cannot be decompressed: {error}. Download the file again."
                ) from error
        _require_bytes(data, size, f"{source}, depth")
        return np.frombuffer(data, "<u2").astype(np.uint16).reshape(camera.height, camera.width)


def _require_bytes(data: bytes, size: int, source: str) -> None:
    if len(data) != size:
        raise FrameError(
            f"{source} does not have the {size} bytes that the width and height in the header of "
            "the file require. Download the file again."
        )


def _exactly(file: BinaryIO, size: int, path: Path, place: str) -> bytes:
    """Read a number of bytes.

    Raises:
        DataError: The file ends before this number of bytes.
    """
    data = file.read(size)
    if len(data) < size:
        raise DataError(f"{path} is truncated in {place}. Copy or download it again.")
    return data


def _header(file: BinaryIO, path: Path) -> _Header:
    """Read the header.

    Raises:
        DataError: The header is truncated, or a value is invalid or not supported.
    """
    version, name_bytes = struct.unpack("<IQ", _exactly(file, 12, path, "its header"))
    if version != VERSION or name_bytes > MAX_NAME_BYTES:
        raise DataError(
            f"{path} is not a .sens file of version {VERSION}: its version is {version}, and "
            f"its sensor name has {name_bytes} bytes, expected at most {MAX_NAME_BYTES}. Convert "
            "the file with ScanNet's tools."
        )
    _exactly(file, name_bytes, path, "its header")
    matrices = MATRICES.unpack(_exactly(file, MATRICES.size, path, "its header"))
    K_color, T_color, K_depth, T_depth = np.array(matrices, float).reshape(4, 4, 4)
    color, depth, *sizes, depth_scale, frames = FORMAT.unpack(
        _exactly(file, FORMAT.size, path, "its header")
    )
    if color not in (RAW_COLOR, PNG, JPEG) or depth not in (RAW_DEPTH, ZLIB):
        raise DataError(
            f"{path} has color of compression {color} and depth of compression {depth}. Expected: "
            "color raw (0), PNG (1) or JPEG (2), and depth raw (0) or zlib (1). Export the file to "
            "a folder of images by SensReader."
        )
    if not (is_rigid(T_color) and is_rigid(T_depth)):
        raise DataError(
            f"{path}: the extrinsics of color {T_color.tolist()} and depth {T_depth.tolist()} must "
            "be rigid transforms. Copy or download the file again."
        )
    try:
        cameras = (_camera(K_color, *sizes[:2]), _camera(K_depth, *sizes[2:]))
        scale = Calibration(cameras[1], depth_scale).depth_scale
    except DataError as error:
        raise DataError(f"{path} has an invalid header: {error}") from error
    T_color_depth = se3.inverse(se3.orthonormalize(T_color)) @ se3.orthonormalize(T_depth)
    return _Header(Rig(*cameras, T_color_depth), scale, color, depth, frames)


def _camera(K: np.ndarray, width: int, height: int) -> Camera:
    if width * height > MAX_PIXELS:
        raise DataError(
            f"an image of {width}x{height} pixels has more than the maximum of {MAX_PIXELS} "
            "pixels. Copy or download the file again."
        )
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return Camera(width, height, fx, fy, cx, cy)


def _index(file: BinaryIO, path: Path, frames: int) -> _Index:
    """Read the headers of all frames.

    Raises:
        DataError: The file has no frames, or is truncated.
    """
    end = path.stat().st_size
    if not 0 < frames <= end // FRAME.size:
        raise DataError(
            f"{path}: the header announces {frames} frames, but a file of {end} bytes can have "
            f"1 to {end // FRAME.size} frames. Copy or download the file again."
        )
    poses, stamps_us, offsets, sizes = [], [], [], []
    for k in range(frames):
        place = f"frame {k} of {frames}"
        *pose, stamp_us, _, color, depth = FRAME.unpack(_exactly(file, FRAME.size, path, place))
        poses.append(pose)
        stamps_us.append(stamp_us)
        offsets.append(file.tell())
        sizes.append((color, depth))
        if offsets[-1] + color + depth > end:
            raise DataError(f"{path} is truncated in {place}. Copy or download it again.")
        file.seek(color + depth, 1)
    return _Index(
        np.array(poses, float).reshape(-1, 4, 4),
        np.array(stamps_us, np.uint64),
        np.array(offsets, np.int64),
        np.array(sizes, np.int64),
    )


def _stamps_ns(stamps_us: np.ndarray, path: Path) -> np.ndarray:
    """Return ascending stamps, [N] int64.

    They are the stamps of the file. If these do not ascend, frame k gets the stamp k / 30 s.
    """
    if np.all(stamps_us[1:] > stamps_us[:-1]) and stamps_us[-1] <= LAST_STAMP_NS // 1000:
        return stamps_us.astype(np.int64) * 1000
    log.info("%s: the stamps do not ascend; its frames count as %d Hz.", path, FRAME_RATE_HZ)
    return np.arange(len(stamps_us), dtype=np.int64) * 10**9 // FRAME_RATE_HZ
