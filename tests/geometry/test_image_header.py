"""Image sizes from the header; images of another size are never decompressed."""

import struct

import cv2
import numpy as np
import pytest

from ldo_service.errors import FrameError
from ldo_service.geometry.codecs import decode_color, decode_depth, encode_jpeg, read_image_size

COLOR = np.random.default_rng(0).integers(0, 255, (37, 53, 3)).astype(np.uint8)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def jpeg(*options: int) -> bytes:
    return cv2.imencode(".jpg", COLOR, options)[1].tobytes()


def bomb(width: int, height: int) -> bytes:
    """Return a small JPEG that announces a large image."""
    data = bytearray(encode_jpeg(COLOR))
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize(
    "data",
    [
        png(COLOR),
        png(COLOR[..., 0].astype(np.uint16)),
        jpeg(),
        jpeg(cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        jpeg(cv2.IMWRITE_JPEG_RST_INTERVAL, 4),
        jpeg()[:2] + b"\xff\xff" + jpeg()[2:],  # Fill bytes before a marker.
        jpeg()[:2] + b"\xff\xe1\x00\x06\xff\xc0\x00\x00" + jpeg()[2:],  # A marker in a segment.
    ],
)
def test_the_size_is_that_of_the_decoded_image(data: bytes) -> None:
    assert read_image_size(memoryview(data)) == (53, 37)


def test_a_png_with_a_chunk_beyond_its_end_has_no_size() -> None:
    """OpenCV would allocate memory for the whole chunk."""
    data = bytearray(png(COLOR))
    data[33:37] = struct.pack(">I", 4_000_000_000)
    assert data[37:41] == b"IDAT"
    assert read_image_size(memoryview(bytes(data))) is None


def test_every_prefix_of_a_header_is_read_without_an_error() -> None:
    for data in (png(COLOR), jpeg()):
        for length in range(700):
            assert read_image_size(memoryview(data[:length])) in (None, (53, 37))


@pytest.mark.parametrize("data", [b"", b"GIF89a" + bytes(50), b"BM" + bytes(80), b"\xff\xd8"])
def test_other_formats_have_no_size_and_are_rejected(data: bytes) -> None:
    assert read_image_size(memoryview(data)) is None
    with pytest.raises(FrameError, match="cannot be decoded as a"):
        decode_color("jpeg", 53, 37, memoryview(data))


@pytest.mark.parametrize("size", [(20_000, 20_000), (65_500, 65_500), (53, 38)])
def test_an_image_that_announces_another_size_is_rejected(size: tuple[int, int]) -> None:
    with pytest.raises(FrameError, match=f"is {size[0]}x{size[1]}, declared as 53x37"):
        decode_color("jpeg", 53, 37, memoryview(bomb(*size)))


def test_truncated_depth_image_is_rejected() -> None:
    data = png(COLOR[..., 0].astype(np.uint16))
    with pytest.raises(FrameError):
        decode_depth("png", 53, 37, memoryview(data[:60]))
