"""Encoding and decoding of images; broken images raise FrameError."""

import cv2
import numpy as np
import pytest

from ldo_service.errors import FrameError
from ldo_service.geometry import codecs

RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (6, 9, 3), dtype=np.uint8)
DEPTH = RNG.integers(0, 60000, (6, 9), dtype=np.uint16)


def test_raw_color_is_unchanged() -> None:
    np.testing.assert_array_equal(
        codecs.decode_color("rgb8", 9, 6, memoryview(COLOR.tobytes())), COLOR
    )


def test_bgr_is_converted_to_rgb() -> None:
    bgr = np.ascontiguousarray(COLOR[..., ::-1])
    np.testing.assert_array_equal(
        codecs.decode_color("bgr8", 9, 6, memoryview(bgr.tobytes())), COLOR
    )


def test_png_color_keeps_every_value() -> None:
    _, data = cv2.imencode(".png", np.ascontiguousarray(COLOR[..., ::-1]))
    decoded = codecs.decode_color("png", 9, 6, memoryview(data.tobytes()))
    np.testing.assert_array_equal(decoded, COLOR)


def test_jpeg_color_is_within_four_levels() -> None:
    smooth = np.tile(np.arange(64, dtype=np.uint8)[:, None, None] * 3, (1, 64, 3))
    decoded = codecs.decode_color("jpeg", 64, 64, memoryview(codecs.encode_jpeg(smooth)))
    assert np.abs(decoded.astype(int) - smooth).max() <= 4


@pytest.mark.parametrize("depth", [DEPTH, (DEPTH / 1000).astype(np.float32)])
def test_compressed_depth_keeps_every_bit(depth: np.ndarray) -> None:
    encoding, data = codecs.encode_depth(depth)
    np.testing.assert_array_equal(codecs.decode_depth(encoding, 9, 6, memoryview(data)), depth)


def test_png_depth_keeps_every_value() -> None:
    _, data = cv2.imencode(".png", DEPTH)
    np.testing.assert_array_equal(
        codecs.decode_depth("png", 9, 6, memoryview(data.tobytes())), DEPTH
    )


def test_an_eight_bit_depth_png_is_rejected() -> None:
    _, data = cv2.imencode(".png", COLOR[..., 0])
    with pytest.raises(FrameError, match="16-bit"):
        codecs.decode_depth("png", 9, 6, memoryview(data.tobytes()))


def test_image_of_another_size_than_announced_is_rejected() -> None:
    _, data = cv2.imencode(".png", COLOR)
    with pytest.raises(FrameError, match="declared as 8x6"):
        codecs.decode_color("png", 8, 6, memoryview(data.tobytes()))


def test_a_truncated_image_is_rejected() -> None:
    with pytest.raises(FrameError, match="cannot be decoded as a jpeg"):
        codecs.decode_color("jpeg", 9, 6, memoryview(codecs.encode_jpeg(COLOR)[:20]))


def test_a_small_message_cannot_unpack_to_gigabytes() -> None:
    _, bomb = codecs.encode_depth(np.zeros((4096, 4096), np.uint16))
    with pytest.raises(FrameError):
        codecs.decode_depth("z16+zstd", 9, 6, memoryview(bomb))


def test_broken_compression_is_rejected() -> None:
    with pytest.raises(FrameError, match="decompressed"):
        codecs.decode_depth("z16+zstd", 9, 6, memoryview(b"not zstd at all"))


def test_header_that_announces_gigabytes_is_rejected_before_decoding() -> None:
    _, data = cv2.imencode(".png", COLOR)
    huge = bytearray(data.tobytes())
    huge[16:24] = (60000).to_bytes(4, "big") * 2
    with pytest.raises(FrameError, match="60000x60000, declared as 9x6"):
        codecs.decode_color("png", 9, 6, memoryview(bytes(huge)))
