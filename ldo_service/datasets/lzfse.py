"""Check of LZFSE streams before they are decompressed, so that a crafted stream cannot fill memory.

A stream is a sequence of blocks. The header of each block declares its decompressed size, but the
decoder does not enforce this size for blocks of type bvx2. The decoder writes all bytes that the
literals and matches of such a block yield, and the library `pyliblzfse` enlarges its buffer without
a limit. This module reads only the headers of the blocks, which are little-endian
(lzfse_internal.h of github.com/lzfse/lzfse):

    bvx-    uint32 decompressed size; the bytes, not compressed
    bvxn    uint32 decompressed size, enforced by the decoder; uint32 size of payload; payload
    bvx2    uint32 decompressed size; three uint64 with packed counts; tables; literals; matches
    bvx$    end of the stream
"""

import struct

RAW, SHORT, COMPRESSED, END = b"bvx-", b"bvxn", b"bvx2", b"bvx$"
COUNTS = struct.Struct("<3Q")
COUNT_BITS = (1 << 20) - 1  # Mask of a packed count.
MATCH_BYTES = 2359  # Maximum length of a match.
# Minimum number of bytes per match in streams of the encoder. Matches have at least 4 bytes; an
# entry without a match has 315 literals, except for the last entry of a block.
MIN_BYTES_PER_MATCH = 3


def decoded_bytes(data: bytes) -> int | None:
    """Compute the decompressed size of a stream from the headers of its blocks.

    Returns:
        The number of bytes; None if the stream is damaged or a block could expand too far. A block
        could expand too far if the decoder could write more than MATCH_BYTES / MIN_BYTES_PER_MATCH
        times the size that the header of the block declares.
    """
    total, position = 0, 0
    try:
        while (magic := data[position : position + 4]) != END:
            (size,) = struct.unpack_from("<I", data, position + 4)
            length = _block_bytes(magic, size, data, position)
            if length is None or position + length > len(data):
                return None
            total, position = total + size, position + length
    except struct.error:
        return None
    return total


def _block_bytes(magic: bytes, size: int, data: bytes, position: int) -> int | None:
    """Return the length of a block in the stream; None if its counts are unknown or implausible."""
    if magic == RAW:
        return 8 + size
    if magic == SHORT:
        return 12 + struct.unpack_from("<I", data, position + 8)[0]
    if magic != COMPRESSED:
        return None
    first, second, third = COUNTS.unpack_from(data, position + 8)
    literals, literal_payload, matches = (first >> shift & COUNT_BITS for shift in (0, 20, 40))
    header, match_payload = third & 0xFFFFFFFF, second >> 40 & COUNT_BITS
    # The encoder fills the literals of a block up to a multiple of four.
    is_plausible = literals <= size + 3 and matches <= size // MIN_BYTES_PER_MATCH + 1
    if not is_plausible or header < 8 + COUNTS.size:
        return None
    return header + literal_payload + match_payload
