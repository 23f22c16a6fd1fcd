"""Encoding and decoding of images: raw, JPEG, PNG, and depth compressed with zstd.

The header of a PNG or JPEG is checked before decompression. This limits the memory that a small
message can allocate. A JPEG of one kilobyte may declare 20000x20000 pixels, for which a decoder
allocates 2.3 GB. A PNG of 300 bytes may declare a chunk of 4 GB, and OpenCV 5 allocates this memory
before it reads the chunk. Both sizes were measured.
"""

import struct
from typing import Literal

import cv2
import numpy as np
import zstandard

from ldo_service.errors import FrameError

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # ITU T.81, table B.1

ZSTD_LEVEL = 1  # 0.8 ms for a VGA depth image; 16-bit PNG takes 17 times as long (measured).


def read_image_size(data: memoryview) -> tuple[int, int] | None:
    """Read the size of a PNG or JPEG image from its header.

    Returns:
        Width and height in pixels. None if the data is neither PNG nor JPEG, if the header is
        truncated, or if a PNG chunk is longer than the data.
    """
    if bytes(data[:8]) == PNG and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return (width, height) if _has_whole_chunks(data) else None
    if bytes(data[:2]) == JPEG:
        return _of_jpeg(data)
    return None


def _has_whole_chunks(data: memoryview) -> bool:
    """Return whether all chunks of a PNG up to `IEND` lie within the data.

    A chunk consists of length, name, content and checksum.
    """
    position = len(PNG)
    while position + 12 <= len(data):
        length, name = struct.unpack(">I4s", data[position : position + 8])
        position += 12 + length
        if name == b"IEND":
            return position <= len(data)
    return False


def _of_jpeg(data: memoryview) -> tuple[int, int] | None:
    """Read the size of a JPEG from its start-of-frame segment.

    A segment consists of marker, length and content.
    """
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # Fill byte.
            position += 1
        elif marker in START_OF_FRAME:
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        else:
            position += 2 + struct.unpack(">H", data[position + 2 : position + 4])[0]
    return None


def decode_color(encoding: str, width: int, height: int, data: memoryview) -> np.ndarray:
    """Decode a color image.

    Args:
        encoding: "rgb8", "bgr8", "jpeg" or "png".
        width: Declared width in pixels.
        height: Declared height in pixels.
        data: The encoded image.

    Returns:
        [H, W, 3] uint8 RGB.

    Raises:
        FrameError: The data is not an image of this encoding and size.
    """
    if encoding == "rgb8":
        return _pixels(data, np.uint8, (height, width, 3))
    if encoding == "bgr8":
        return np.ascontiguousarray(_pixels(data, np.uint8, (height, width, 3))[..., ::-1])
    bgr = _decompress(data, cv2.IMREAD_COLOR, encoding, width, height)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def decode_depth(encoding: str, width: int, height: int, data: memoryview) -> np.ndarray:
    """Decode a depth image.

    Args:
        encoding: "png", "z16" or "f32", the last two optionally with "+zstd".
        width: Declared width in pixels.
        height: Declared height in pixels.
        data: The encoded image.

    Returns:
        [H, W] uint16 or float32, in the stored unit.

    Raises:
        FrameError: The data is not an image of this encoding and size.
    """
    if encoding == "png":
        depth = _decompress(data, cv2.IMREAD_UNCHANGED, encoding, width, height)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise FrameError(
                f"depth PNG contains {depth.dtype}{depth.shape}, expected a 16-bit gray image. "
                "Encode depth as 16-bit gray PNG."
            )
        return depth
    dtype = np.uint16 if encoding.startswith("z16") else np.float32
    size = width * height * np.dtype(dtype).itemsize
    raw = _expand(data, size) if encoding.endswith("+zstd") else data
    return _pixels(raw, dtype, (height, width))


def encode_depth(depth: np.ndarray) -> tuple[Literal["z16+zstd", "f32+zstd"], bytes]:
    """Compress a depth image [H, W] uint16 or float32, and return the encoding and the bytes."""
    compressed = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(depth.tobytes())
    return ("z16+zstd" if depth.dtype == np.uint16 else "f32+zstd"), compressed


def encode_jpeg(color: np.ndarray, quality: int = 95) -> bytes:
    """Encode a color image [H, W, 3] uint8 RGB as JPEG."""
    bgr = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, quality))
    return data.tobytes()


def _pixels(data: memoryview | bytes, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
    if len(data) != np.prod(shape) * np.dtype(dtype).itemsize:
        raise FrameError(
            f"image has {len(data)} bytes, expected {np.prod(shape) * np.dtype(dtype).itemsize} "
            f"for {np.dtype(dtype)}{shape}. Check the declared width, height and encoding."
        )
    return np.frombuffer(data, dtype).reshape(shape)


def _expand(data: memoryview, size: int) -> bytes:
    """Decompress at most `size` + 1 bytes, because a small message may expand to gigabytes."""
    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
    except zstandard.ZstdError as error:
        raise FrameError(
            f"depth image of {len(data)} bytes cannot be decompressed: {error}. Compress it with "
            "Zstandard, as its encoding declares."
        ) from error


def _decompress(data: memoryview, flags: int, encoding: str, width: int, height: int) -> np.ndarray:
    """Decode a PNG or JPEG after checking the size in its header."""
    announced = read_image_size(data)
    if announced is None:
        raise _undecodable(data, encoding)
    _require_size(announced, (width, height), encoding)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise _undecodable(data, encoding, f" ({error.err})") from error
    if image is None:
        raise _undecodable(data, encoding)
    _require_size((image.shape[1], image.shape[0]), (width, height), encoding)
    return image


def _undecodable(data: memoryview, encoding: str, reason: str = "") -> FrameError:
    return FrameError(
        f"{len(data)} bytes cannot be decoded as a {encoding} image{reason}. Check the program "
        "that encodes the images."
    )


def _require_size(found: tuple[int, int], declared: tuple[int, int], encoding: str) -> None:
    """Check the width and height of an image.

    Raises:
        FrameError: The image does not have the declared size.
    """
    if found != declared:
        raise FrameError(
            f"{encoding} image is {found[0]}x{found[1]}, declared as {declared[0]}x{declared[1]}. "
            "Declare the size of the encoded image."
        )


def shrunk(crop: np.ndarray, side_px: int) -> np.ndarray:
    """Scale an image down to at most `side_px` pixels on its longer side; never enlarge it."""
    height, width = crop.shape[:2]
    scale = side_px / max(height, width)
    if scale >= 1:
        return np.ascontiguousarray(crop)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
