"""The size that a PNG or JPEG announces, read before anything is decompressed.

A kilobyte of JPEG may announce 20000x20000 pixels, for which a decoder allocates 2.3 GB, and 300
bytes of PNG a chunk of 4 GB, which OpenCV 5 allocates before it looks for them (both measured).
"""

import struct

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # ITU T.81, table B.1


def announced_size(data: memoryview) -> tuple[int, int] | None:
    """Width and height in pixels; None for what is neither PNG nor JPEG, or breaks off before, or
    is a PNG with a chunk that is longer than the file."""
    if bytes(data[:8]) == PNG and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return (width, height) if _has_whole_chunks(data) else None
    if bytes(data[:2]) == JPEG:
        return _of_jpeg(data)
    return None


def _has_whole_chunks(data: memoryview) -> bool:
    """Whether all of them lie in the file up to the last, which is `IEND`: length, name, content,
    checksum."""
    position = len(PNG)
    while position + 12 <= len(data):
        length, name = struct.unpack(">I4s", data[position : position + 8])
        position += 12 + length
        if name == b"IEND":
            return position <= len(data)
    return False


def _of_jpeg(data: memoryview) -> tuple[int, int] | None:
    """Walk the segments up to the start of the frame: marker, length, content."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
        elif marker in START_OF_FRAME:
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        else:
            position += 2 + struct.unpack(">H", data[position + 2 : position + 4])[0]
    return None
