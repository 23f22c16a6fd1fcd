"""Image files, read so that a damaged one is an error and never a half-grey picture."""

from pathlib import Path

import cv2
import numpy as np

from ldo_service.errors import FrameError
from ldo_service.geometry.codecs import read_image_size

# The last bytes of a complete file. OpenCV decodes what is there of a cut one without complaint.
_ENDS = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8\xff": b"\xff\xd9"}
MAX_PIXELS = 1 << 25  # as of images in messages
_TRAILING_BYTES = 64  # some writers pad their files


def read_color(path: Path) -> np.ndarray:
    """Colour image [H, W, 3] uint8 RGB. Raises FrameError with the path."""
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_depth(path: Path) -> np.ndarray:
    """Depth image [H, W] uint16 as stored. Raises FrameError with the path."""
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise FrameError(
            f"{path} is {image.dtype}{image.shape}: a depth image has one channel of 16 bits. "
            "Export the depth again as 16-bit grey PNG."
        )
    return image


def read_labels(path: Path, dtype: type[np.unsignedinteger]) -> np.ndarray:
    """Numbers [H, W] of `dtype`, as stored. Raises FrameError with the path."""
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != dtype or image.ndim != 2:
        raise FrameError(
            f"{path} is {image.dtype}{image.shape}: expected one number a pixel, "
            f"{np.dtype(dtype).itemsize * 8} bits. Export the labels again as grey PNG."
        )
    return image


def first_size(paths: list[Path]) -> tuple[int, int]:
    """Width and height of the first image that can be read. Raises the last one's FrameError."""
    for path in paths[:-1]:
        try:
            return _size(path)
        except FrameError:  # reading it later will say so
            continue
    return _size(paths[-1])


def _size(path: Path) -> tuple[int, int]:
    height, width = _decode(path, cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def _decode(path: Path, flags: int) -> np.ndarray:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(
            f"{path} cannot be read ({error.strerror}): restore the file or drop its line."
        ) from error
    if not _is_complete(data):
        raise FrameError(f"{path} is cut short at {len(data)} bytes: copy or download it again.")
    _require_size(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f"{path} is not a readable image: copy or download it again.")
    return image


def _require_size(path: Path, data: bytes) -> None:
    """Before memory is taken for it."""
    size = read_image_size(memoryview(data))
    if size is None:
        raise FrameError(f"{path} is not a readable image, PNG or JPEG: copy or download it again.")
    if size[0] * size[1] > MAX_PIXELS:
        raise FrameError(f"{path} says that it has {size[0]}x{size[1]} pixels: no camera has that.")


def _is_complete(data: bytes) -> bool:
    """Whether a PNG or JPEG has its end."""
    if len(data) < 16:
        return False
    for start, end in _ENDS.items():
        if data.startswith(start):
            return end in data[-_TRAILING_BYTES:]
    return True
