"""Reading of image files; a truncated file raises an error instead of yielding gray pixels."""

from pathlib import Path

import cv2
import numpy as np

from ldo_service.errors import FrameError
from ldo_service.geometry.codecs import read_image_size

# Last bytes of a complete image file, by the first bytes of the file. They are checked because
# OpenCV decodes a truncated file without an error.
_ENDS = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8\xff": b"\xff\xd9"}
MAX_PIXELS = 1 << 25  # Maximum number of pixels of an image, as in messages.
_TRAILING_BYTES = 64  # Maximum padding at the end of a file, as some programs write it.


def read_color(path: Path) -> np.ndarray:
    """Read a color image [H, W, 3] uint8 RGB.

    Raises:
        FrameError: The file cannot be read or decoded.
    """
    return decode_color(_read(path), str(path))


def decode_color(data: bytes, source: str) -> np.ndarray:
    """Decode a color image [H, W, 3] uint8 RGB from the bytes of a PNG or JPEG.

    Args:
        data: The bytes.
        source: Name of the image, for errors.

    Raises:
        FrameError: The bytes cannot be decoded.
    """
    image = _decode(data, source, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_depth(path: Path) -> np.ndarray:
    """Read a depth image [H, W] uint16 in the stored unit.

    Raises:
        FrameError: The file cannot be read or decoded, or is not a 16-bit gray image.
    """
    image = _decode(_read(path), str(path), cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise FrameError(
            f"{path} is {image.dtype}{image.shape}, expected one channel of 16 bits. "
            "Export the depth again as 16-bit gray PNG."
        )
    return image


def read_labels(path: Path, *dtypes: type[np.unsignedinteger]) -> np.ndarray:
    """Read a label image [H, W] of one of the given types.

    Raises:
        FrameError: The file cannot be read or decoded, or its pixels are of another type.
    """
    image = _decode(_read(path), str(path), cv2.IMREAD_UNCHANGED)
    if image.dtype not in dtypes or image.ndim != 2:
        bits = " or ".join(str(np.dtype(dtype).itemsize * 8) for dtype in dtypes)
        raise FrameError(
            f"{path} is {image.dtype}{image.shape}, expected one channel of {bits} bits. Export "
            "the labels again as gray PNG."
        )
    return image


def first_size(paths: list[Path]) -> tuple[int, int]:
    """Return width and height of the first readable image.

    Raises:
        FrameError: No image can be read.
    """
    first: FrameError | None = None
    for path in paths:
        try:
            return _size(path)
        except FrameError as error:  # Reading this frame later raises the error again.
            first = first or error
    raise FrameError(
        f"none of {len(paths)} images can be read. The error of the first: {first}"
    ) from first


def _size(path: Path) -> tuple[int, int]:
    height, width = _decode(_read(path), str(path), cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FrameError(
            f"{path} cannot be read ({error.strerror}). Restore it, or remove it from the sequence."
        ) from error


def _decode(data: bytes, source: str, flags: int) -> np.ndarray:
    if not _is_complete(data):
        raise FrameError(f"{source} is truncated at {len(data)} bytes. Copy or download it again.")
    _require_size(data, source)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f"{source} is not a readable image. Copy or download it again.")
    return image


def _require_size(data: bytes, source: str) -> None:
    """Check the size in the header, before a decoder allocates memory."""
    size = read_image_size(memoryview(data))
    if size is None:
        raise FrameError(
            f"{source} is not a readable image (PNG or JPEG). Copy or download it again."
        )
    if size[0] * size[1] > MAX_PIXELS:
        raise FrameError(
            f"{source} has {size[0]}x{size[1]} pixels by its header, expected at most {MAX_PIXELS} "
            "in total. Copy or download it again."
        )


def _is_complete(data: bytes) -> bool:
    """Return whether a PNG or JPEG has its end marker; files of other types count as complete."""
    if len(data) < 16:
        return False
    for start, end in _ENDS.items():
        if data.startswith(start):
            return end in data[-_TRAILING_BYTES:]
    return True
