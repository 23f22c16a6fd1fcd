"""Offloading of Gaussians to disk, in chunks, until a camera may see them again.

The Gaussians of a chunk have the same anchor keyframe.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.storage.checksummed_folder import ChecksummedFolder

from .chunk import Chunk, pack, unpack
from .chunk_entry import ChunkEntry, LostIdRange
from .model import GaussianBatch, GaussianMap, new_labels
from .retired_files import RetiredFiles
from .rows import ROW
from .visibility import BoundingSpheres, PlacedCamera

log = logging.getLogger(__name__)

_DISK_FULL = "The Gaussians stay in memory, which may run out: free some disk space."
MAX_MOTIONS = 32  # Maximum pending motions of a chunk; a chunk with more is rewritten.
REWRITTEN_PER_CALL = 16  # Chunks rewritten per call of `move_anchors`: 2 ms each.


class OffloadedGaussians:
    """Store of offloaded chunks in `folder`.

    Loading restores Gaussians exactly: they are bitwise equal to Gaussians that stayed in memory
    and moved with their anchor keyframes. A chunk on disk takes less than 1 kB of memory, plus
    the motions that are not yet applied to its file. If `folder` is None, a temporary folder is
    used and removed at the end. Not thread-safe.

    The folder contains the chunks of one map only. When a chunk is loaded, its file is retired: the
    file stays, since a process restored from the last snapshot would need it. Later snapshots do
    not contain the chunk. Once a later snapshot has been saved, the file is removed. `restore`
    removes all files newer than the snapshot, and retires older files that the snapshot does not
    contain. Without `restore`, the first `put` removes all earlier files.

    Attributes:
        files: The folder of the chunks.
        retired: The retired files.

    Raises:
        ConfigError: The folder cannot be used.
    """

    def __init__(self, folder: Path | None) -> None:
        self.files = ChecksummedFolder(folder, "gaussians", _DISK_FULL)
        self._entries: dict[int, ChunkEntry] = {}  # Key: file number, ascending.
        self._next_number = 0
        self.retired = RetiredFiles(self.files)
        self._spheres: BoundingSpheres | None = None  # Cache; None after a change of the entries.
        self._lost: list[LostIdRange] = []  # Ranges that `pop_lost_ids` will return.
        self._offloaded_total = self._loaded_total = self._damaged = 0

    def __len__(self) -> int:
        """Return the number of offloaded Gaussians."""
        return sum(entry.count for entry in self._entries.values())

    def numbers(self) -> list[int]:
        """Return the file numbers of the offloaded chunks, ascending."""
        return list(self._entries)

    # --- one chunk --------------------------------------------------------------------------------
    def put(self, chunk: Chunk) -> int | None:
        """Write a chunk to disk.

        Returns:
            The file number of the chunk. None if the chunk cannot be written to disk; the caller
            must then keep the chunk in memory.

        Raises:
            ValueError: The chunk has no Gaussians, or its ids do not ascend.
        """
        ids, rows = chunk.ids, chunk.rows
        if len(ids) == 0 or len(ids) != len(rows) or np.any(np.diff(ids) <= 0):
            raise ValueError(
                f"the chunk of anchor keyframe {chunk.anchor} has {len(rows)} rows and {len(ids)} "
                "ids. It must have at least one row, one id per row, and ascending ids."
            )
        if self._next_number == 0:
            self._remove_from(0)
        sphere = BoundingSpheres.around(rows, chunk.anchors)
        place = sphere.centers[0], float(sphere.radii_m[0])
        entry = ChunkEntry(chunk.anchor, int(ids[0]), int(ids[-1]), len(ids), *place)
        return self._write(chunk, entry)

    def load(self, number: int) -> Chunk:
        """Remove a chunk from the store and return it at the current pose of its anchor keyframe.

        If the file is damaged, an empty chunk is returned, and the Gaussians of the chunk are lost.
        The loss is counted and logged.

        Raises:
            KeyError: There is no such chunk.
        """
        chunk = self._read(number)
        if number in self._entries:  # Reading removes a damaged chunk.
            self._loaded_total += self._entries[number].count
            self._retire(number)
        return chunk

    # --- many chunks, to and from the map ---------------------------------------------------------
    def offload_from(
        self, gaussians: GaussianMap, chunks: np.ndarray, chosen: Iterable[int]
    ) -> list[int]:
        """Offload the Gaussians of some chunks from the map.

        The computing time is linear in the size of the map. Gaussians that cannot be written to
        disk stay in memory.

        Args:
            gaussians: The map.
            chunks: Chunk number of each Gaussian, [N] int, from `chunk_numbers`. Gaussians with the
                same number must have the same anchor keyframe.
            chosen: Chunk numbers to offload.

        Returns:
            Numbers of the written files, as `put` returns them.
        """
        mask = np.isin(chunks, np.array(sorted(chosen), np.int64))
        chunk_of = chunks[mask]
        taken = gaussians.extract(mask)
        numbers, refused = [], np.zeros(len(chunk_of), bool)
        for members in _members(chunk_of):
            ids, rows, anchors, labels = taken.at(members)
            number = self.put(Chunk(int(anchors[0]), ids, rows, labels))
            refused[members] = number is None
            numbers += [] if number is None else [number]
        if np.any(refused):
            gaussians.reinsert(*taken.at(refused))
        return numbers

    def load_into(self, gaussians: GaussianMap, numbers: Iterable[int]) -> np.ndarray:
        """Load chunks back into the map that they were offloaded from.

        The computing time is linear in the size of the map.

        Args:
            gaussians: The map.
            numbers: Numbers of the chunk files, as `put` returned them.

        Returns:
            Ids [M] of the loaded Gaussians, ascending.
        """
        chunks = [self.load(number) for number in sorted(numbers)]
        if not chunks:
            return np.zeros(0, np.int64)
        loaded = _joined([chunk.batch() for chunk in chunks])
        gaussians.reinsert(*loaded)
        return np.sort(loaded.ids)

    # --- access without loading -------------------------------------------------------------------
    def visible_chunks(self, camera: PlacedCamera, reach_m: float = inf) -> list[int]:
        """Return the file numbers of the chunks that a camera may see, ascending.

        The decision uses bounding spheres in memory; no file is read.

        Args:
            camera: The camera.
            reach_m: Distance beyond which chunks count as invisible.
        """
        if self._spheres is None:
            self._spheres = self._all_spheres()
        seen = camera.may_see(self._spheres.centers, self._spheres.radii_m, reach_m)
        numbers = self.numbers()
        return [numbers[k] for k in np.flatnonzero(seen)]

    def move_anchors(self, T_new_old: Mapping[int, np.ndarray]) -> None:
        """Move offloaded Gaussians as `GaussianMap.move_anchors` moves those in memory.

        Args:
            T_new_old: Motions [4, 4] in the map frame, by id of the anchor keyframe.
        """
        for number, entry in self._entries.items():
            if entry.anchor in T_new_old:
                self._entries[number] = entry.moved(T_new_old[entry.anchor])
                self._spheres = None
        moved_often = [n for n, entry in self._entries.items() if len(entry.motions) > MAX_MOTIONS]
        for number in moved_often[:REWRITTEN_PER_CALL]:
            self._rewrite_chunk(number)

    def chunks(self) -> Iterator[Chunk]:
        """Yield all offloaded Gaussians, one anchor keyframe after the other; ids ascend.

        To save memory, the files of only one anchor keyframe are read at a time.
        """
        by_anchor: dict[int, list[int]] = {}
        for number in sorted(self._entries, key=lambda n: self._entries[n].first_id):
            by_anchor.setdefault(self._entries[number].anchor, []).append(number)
        for anchor, numbers in by_anchor.items():
            parts = _joined([self._read(number).batch() for number in numbers])
            if len(parts.ids):
                ids, rows, _, labels = _in_order(parts)
                yield Chunk(anchor, ids, rows, labels)

    def _all_spheres(self) -> BoundingSpheres:
        entries = self._entries.values()
        return BoundingSpheres(
            np.array([entry.anchor for entry in entries], np.int32),
            np.array([entry.count for entry in entries], np.int64),
            np.array([entry.center_map for entry in entries]).reshape(-1, 3),
            np.array([entry.radius_m for entry in entries], float),
        )

    # --- damage -----------------------------------------------------------------------------------
    def pop_lost_ids(self, gaussians: GaussianMap) -> np.ndarray:
        """Return the ids [L], ascending, of Gaussians lost to damaged files since the last call.

        Only the id range of a damaged chunk is known. The result contains all ids of this range
        that exist neither in memory nor on disk, including ids of Gaussians removed earlier.

        Args:
            gaussians: The map, with the Gaussians in memory.
        """
        if not self._lost:
            return np.zeros(0, np.int64)
        lost, self._lost = self._lost, []
        ids = np.unique(np.concatenate([np.arange(one.first_id, one.last_id + 1) for one in lost]))
        offloaded_ids = [
            self._read(number).ids
            for number, entry in list(self._entries.items())
            if any(entry.first_id <= o.last_id and o.first_id <= entry.last_id for o in lost)
        ]
        return np.setdiff1d(
            ids, np.concatenate([gaussians.ids, *offloaded_ids]), assume_unique=True
        )

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the table of chunks as named arrays; the Gaussians stay in their files."""
        self.retired.on_snapshot()
        entries = list(self._entries.values())
        spheres = self._all_spheres()
        motions = [T for entry in entries for T in entry.motions]
        return {
            "numbers": np.array(self.numbers(), np.int64),
            "anchors": spheres.anchors,
            "first_ids": np.array([entry.first_id for entry in entries], np.int64),
            "last_ids": np.array([entry.last_id for entry in entries], np.int64),
            "counts": spheres.counts,
            "centers": spheres.centers,
            "radii_m": spheres.radii_m,
            "motion_counts": np.array([len(entry.motions) for entry in entries], np.int64),
            "motions": np.array(motions, float).reshape(-1, 4, 4),
            "next_number": np.array(self._next_number, np.int64),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore the table of chunks from a snapshot; the folder must contain their files.

        A chunk whose file is missing is dropped, counted and logged.
        """
        names = ("anchors", "first_ids", "last_ids", "counts", "centers", "radii_m")
        columns = [state[name] if name == "centers" else state[name].tolist() for name in names]
        motions = np.split(state["motions"], np.cumsum(state["motion_counts"]))[:-1]
        numbers = state["numbers"].tolist()
        self._entries = {
            number: ChunkEntry(*fields, motions=tuple(own))
            for number, *fields, own in zip(numbers, *columns, motions, strict=True)
        }
        self._next_number, self._spheres = int(state["next_number"]), None
        unused = self.files.sizes.keys() - self._entries.keys()
        self.retired.restart(sorted(number for number in unused if number < self._next_number))
        self._remove_from(self._next_number)
        for number in self._entries.keys() - self.files.sizes.keys():
            self._lose(number, "their file is gone")

    def metrics(self) -> dict[str, float]:
        """Return the counters of offloading."""
        return {
            "gaussians_offloaded": len(self),
            "chunks_offloaded": len(self._entries),
            "gaussians_disk_mb": sum(self.files.sizes.values()) / 1e6,
            "gaussians_offloaded_total": self._offloaded_total,
            "gaussians_loaded_total": self._loaded_total,
            "gaussians_lost_on_disk": self._damaged,
            "chunks_not_written": self.files.not_written,
        }

    # --- files ------------------------------------------------------------------------------------
    def _write(self, chunk: Chunk, entry: ChunkEntry) -> int | None:
        number = self._next_number
        if not self.files.write(number, pack(chunk)):
            return None
        self._entries[number] = entry
        self._next_number += 1
        self._spheres = None
        self._offloaded_total += entry.count
        return number

    def _read(self, number: int) -> Chunk:
        """Read a chunk, moved to the current pose of its anchor keyframe.

        If its file is damaged, drop the entry and return an empty chunk.
        """
        entry = self._entries[number]
        try:
            chunk = unpack(self.files.read(number))
            if (chunk.anchor, len(chunk.ids)) != (entry.anchor, entry.count):
                raise DataError(
                    f"file {number} holds {len(chunk.ids)} Gaussians of anchor keyframe "
                    f"{chunk.anchor} instead of {entry.count} of anchor keyframe {entry.anchor}"
                )
        except DataError as error:
            self._lose(number, str(error))
            rows = np.zeros((0, ROW), np.float32)
            return Chunk(entry.anchor, np.zeros(0, np.int64), rows, new_labels(0))
        return chunk.moved(entry.motions)

    def _rewrite_chunk(self, number: int) -> None:
        """Write a chunk again at the current pose of its anchor, so that no motions are pending."""
        chunk, entry = self._read(number), self._entries.get(number)
        if entry is not None and self._write(chunk, replace(entry, motions=())) is not None:
            self._offloaded_total -= entry.count
            self._retire(number)

    def _lose(self, number: int, reason: str) -> None:
        entry = self._entries.pop(number)
        count, anchor = entry.count, entry.anchor
        log.error(
            "offloading: %d Gaussians of anchor keyframe %d are lost (%s). The map has a gap there "
            "until the camera returns. Check the disk.",
            count,
            anchor,
            reason,
        )
        self._damaged += count
        self._spheres = None
        self._lost.append(LostIdRange(entry.first_id, entry.last_id))
        self.files.remove(number)

    def _retire(self, number: int) -> None:
        del self._entries[number]
        self._spheres = None
        self.retired.add(number)

    def _remove_from(self, first: int) -> None:
        """Remove the files of other maps, and of states newer than the restored one."""
        for number in [number for number in self.files.sizes if number >= first]:
            self.files.remove(number)


def _members(labels: np.ndarray) -> list[np.ndarray]:
    """Return the positions of each distinct value in `labels` [N], by ascending value."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(labels) else []


def _joined(batches: list[GaussianBatch]) -> GaussianBatch:
    return GaussianBatch(*map(np.concatenate, zip(*batches, strict=True)))


def _in_order(batch: GaussianBatch) -> GaussianBatch:
    return batch.at(np.argsort(batch.ids, kind="stable"))


def iter_all_gaussians(
    gaussians: GaussianMap, offloaded: OffloadedGaussians
) -> Iterator[GaussianBatch]:
    """Yield all Gaussians, those in memory and those on disk, in batches with ascending ids.

    The Gaussians of one anchor keyframe must have consecutive ids. To save memory, the files of
    only one anchor keyframe are read at a time.
    """
    resident, start = gaussians.all(), 0
    for chunk in offloaded.chunks():
        first, last = map(int, np.searchsorted(resident.ids, chunk.ids[[0, -1]]))
        yield resident.at(slice(start, first))
        yield _in_order(_joined([resident.at(slice(first, last)), chunk.batch()]))
        start = last
    yield resident.at(slice(start, None))
