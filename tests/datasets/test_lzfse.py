"""Streams of liblzfse are measured before they are decompressed, and crafted ones are refused."""

import struct

import liblzfse
import numpy as np
import pytest

from ldo_service.datasets.lzfse import END, decoded_bytes

RANDOM = np.random.default_rng(0)
DEPTH_M = RANDOM.integers(500, 3000, (192, 256)) / np.float32(1000)


@pytest.mark.parametrize(
    "content",
    [
        b"a",
        b"abcd" * 25,
        bytes(10_000_000),
        RANDOM.bytes(100_000),
        DEPTH_M.astype(np.float32).tobytes(),
        np.linspace(1, 2, 300_000).astype(np.float32).tobytes(),
        RANDOM.integers(0, 3, 49152, np.uint8).tobytes(),
    ],
    ids=lambda content: str(len(content)),
)
def test_size_is_that_of_the_decompressed_stream(content: bytes) -> None:
    assert decoded_bytes(liblzfse.compress(content)) == len(content)


def test_block_that_declares_fewer_bytes_than_its_matches_yield_is_refused() -> None:
    """The decoder would ignore the declared size, and yield 10 MB from each copy of the blocks."""
    block = bytearray(liblzfse.compress(bytes(10_000_000)).removesuffix(END))
    struct.pack_into("<I", block, 4, 100)
    assert len(liblzfse.decompress(bytes(block) + END)) == 10_000_000
    assert decoded_bytes(bytes(block) + END) is None


@pytest.mark.parametrize("length", range(0, 40, 3))
def test_truncated_stream_is_refused(length: int) -> None:
    assert decoded_bytes(liblzfse.compress(bytes(10_000))[:length]) is None


def test_stream_of_another_format_is_refused() -> None:
    assert decoded_bytes(b"\x1f\x8b" + bytes(100)) is None
    assert decoded_bytes(b"bvx1" + bytes(100)) is None
