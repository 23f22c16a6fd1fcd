"""Chunk: the Gaussians of one anchor keyframe, as arrays and as bytes."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import zstandard

from ldo_service.errors import DataError

from .model import LABEL_BYTES, GaussianBatch
from .rows import ROW, transform_rows

_HEADER = struct.Struct("<qq")  # Id of the anchor keyframe, number of Gaussians.
_LEVEL = 1  # Compression level of zstd.


@dataclass(frozen=True, eq=False, slots=True)
class Chunk:
    """Gaussians of one anchor keyframe.

    Attributes:
        anchor: Id of the anchor keyframe.
        ids: Ids of the M Gaussians, [M] int64, ascending.
        rows: Parameters in the map frame (see `gaussians.rows`), [M, 16] float32.
        labels: Labels as packed bytes (see `semantics.gaussian_labels`), [M, 32] uint8.
    """

    anchor: int
    ids: np.ndarray
    rows: np.ndarray
    labels: np.ndarray

    @property
    def anchors(self) -> np.ndarray:
        """Id of the anchor keyframe for each Gaussian, [M] int32, as in `GaussianMap.anchors`."""
        return np.full(len(self.ids), self.anchor, np.int32)

    def batch(self) -> GaussianBatch:
        """Return the Gaussians of the chunk as a `GaussianBatch`."""
        return GaussianBatch(self.ids, self.rows, self.anchors, self.labels)

    def moved(self, motions: Iterable[np.ndarray]) -> "Chunk":
        """Return the chunk with its Gaussians moved along with their anchor keyframe.

        The result is bitwise equal to that of `GaussianMap.move_anchors`.

        Args:
            motions: Motions T_new_old [4, 4] of the anchor keyframe, the earliest first.
        """
        rows = self.rows
        for T_new_old in motions:
            rows = transform_rows(rows, T_new_old)
        return replace(self, rows=rows)


def pack(chunk: Chunk) -> bytes:
    """Compress a chunk to bytes.

    Ids are stored as differences of consecutive ids. Rows and labels are stored byte by byte: the
    first byte of every Gaussian, then the second byte of every Gaussian, and so on. This order
    compresses better, because neighboring Gaussians often have equal bytes.
    """
    steps = np.diff(chunk.ids, prepend=0).astype("<i8")
    planes = np.ascontiguousarray(chunk.rows, "<f4").view(np.uint8).T
    arrays = steps, planes, np.ascontiguousarray(chunk.labels.T)
    body = _HEADER.pack(chunk.anchor, len(steps)) + b"".join(a.tobytes() for a in arrays)
    return zstandard.ZstdCompressor(level=_LEVEL).compress(body)


def unpack(data: bytes | memoryview) -> Chunk:
    """Return the chunk from its packed form.

    Raises:
        DataError: The bytes are not a packed chunk, or an earlier version of the service wrote
            them.
    """
    try:
        body = zstandard.ZstdDecompressor().decompress(data)
        anchor, count = _HEADER.unpack_from(body)
        steps = np.frombuffer(body, "<i8", count, _HEADER.size)
        planes = np.frombuffer(body, np.uint8, offset=_HEADER.size + steps.nbytes)
        if planes.size == 4 * ROW * count > 0:
            raise DataError(
                f"the file contains {count} Gaussians without labels, because an earlier version "
                "of the service wrote it; start with another state folder"
            )
        planes = planes.reshape(4 * ROW + LABEL_BYTES, count).T
        rows = np.ascontiguousarray(planes[:, : 4 * ROW]).view("<f4")
        labels = np.ascontiguousarray(planes[:, 4 * ROW :])
    except (zstandard.ZstdError, struct.error, ValueError, MemoryError) as error:
        raise DataError(
            f"the file of {len(data)} bytes cannot be decoded as Gaussians: {error}"
        ) from error
    return Chunk(anchor, np.cumsum(steps), rows, labels)
