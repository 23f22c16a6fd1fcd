"""Disk cache of rendered frames, so that each machine renders a sequence once."""

import hashlib
import logging
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import zstandard

from ldo_service.errors import FrameError
from ldo_service.geometry import codecs
from ldo_service.storage.atomic_write import write_atomically
from ldo_service.storage.cache_folder import cache_root

log = logging.getLogger(__name__)

# Maximum size of all sequences together; a sequence of 640x480 pixels takes 0.3-0.9 GB.
LIMIT_BYTES = 3 << 30
_HEADER = struct.Struct("<16s4I")  # Digest of the body, then the lengths of its four images.
_DIGEST_BYTES = 16


@dataclass(frozen=True, slots=True)
class CachedFrame:
    """Cached images of one frame."""

    color: np.ndarray  # RGB [H, W, 3] uint8.
    depth_m: np.ndarray  # Depth [H, W] float32; 0 where unknown.
    class_ids: np.ndarray  # Class per pixel [H, W] uint8.
    instance_ids: np.ndarray  # Object per pixel [H, W] uint16; 0 for the building.


class FrameCache:
    """Disk cache of the frames of one sequence.

    The cache deletes the oldest sequences when the cached sequences exceed LIMIT_BYTES in total. If
    the cache cannot be written, frames are rendered at each read.
    """

    def __init__(self, identity: str, width: int, height: int) -> None:
        """Choose the folder of the sequence; nothing is written yet.

        Args:
            identity: Text that determines the bytes of all frames: the version of the renderer and
                the parameters of the sequence. The folder's name is its hash.
            width: Width of the images, pixels.
            height: Height of the images, pixels.
        """
        key = hashlib.blake2b(identity.encode(), digest_size=10).hexdigest()
        self.folder = cache_root() / "synthetic-flat" / key
        self._size = (height, width)

    def load_or_render(self, index: int, render: Callable[[int], CachedFrame]) -> CachedFrame:
        """Return a frame from the cache, or render and store it."""
        frame = self.load(index)
        if frame is None:
            frame = render(index)
            self.store(index, frame)
        return frame

    def load(self, index: int) -> CachedFrame | None:
        """Return the frame, or None if it is missing or damaged."""
        try:
            data = self._path(index).read_bytes()
        except OSError:
            return None
        try:
            return self._unpacked(data)
        except (FrameError, struct.error, zstandard.ZstdError, ValueError) as error:
            log.warning(
                "synthetic: cached frame %s is damaged (%s); it is rendered again, "
                "no action needed.",
                self._path(index),
                error,
            )
            return None

    def store(self, index: int, frame: CachedFrame) -> None:
        """Write the frame atomically; a failure is logged, not raised."""
        try:
            self._make_room()
            self.folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path(index), _packed(frame), unique=True)
        except OSError as error:
            log.warning(
                "synthetic: cannot cache frame %s in %s (%s); it is rendered at each read. "
                "Free disk space, or set LDO_CACHE to another folder.",
                index,
                self.folder,
                error,
            )

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:04d}.frame"

    def _make_room(self) -> None:
        """Delete the oldest sequences until the others and this sequence fit in LIMIT_BYTES.

        Nothing is deleted once the folder of this sequence exists.
        """
        if self.folder.exists() or not self.folder.parent.exists():
            return
        others = sorted(self.folder.parent.iterdir(), key=lambda other: other.stat().st_mtime)
        sizes = [sum(file.stat().st_size for file in other.iterdir()) for other in others]
        total = sum(sizes) + LIMIT_BYTES // 3  # The last term is reserved for this sequence.
        for other, size in zip(others, sizes, strict=True):
            if total <= LIMIT_BYTES:
                return
            shutil.rmtree(other, ignore_errors=True)
            total -= size

    def _unpacked(self, data: bytes) -> CachedFrame:
        digest, *lengths = _HEADER.unpack_from(data)
        body = data[_HEADER.size :]
        if len(body) != sum(lengths) or _digest(body) != digest:
            raise FrameError(
                f"the {len(data)} bytes do not match the length or digest in the header of the file"
            )
        parts, start = [], 0
        for length in lengths:
            parts.append(memoryview(body)[start : start + length])
            start += length
        height, width = self._size
        color = codecs.decode_color("png", width, height, parts[0])
        depth_m = codecs.decode_depth("f32+zstd", width, height, parts[1])
        return CachedFrame(
            color, depth_m, self._plane(parts[2], np.uint8), self._plane(parts[3], np.uint16)
        )

    def _plane(self, data: memoryview, dtype: type) -> np.ndarray:
        return np.frombuffer(zstandard.decompress(data), dtype).reshape(self._size)


def _packed(frame: CachedFrame) -> bytes:
    _, png = cv2.imencode(".png", cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
    planes = (frame.depth_m, frame.class_ids, frame.instance_ids)
    parts = [png.tobytes(), *(zstandard.compress(plane.tobytes(), 3) for plane in planes)]
    body = b"".join(parts)
    return _HEADER.pack(_digest(body), *map(len, parts)) + body


def _digest(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_DIGEST_BYTES).digest()
