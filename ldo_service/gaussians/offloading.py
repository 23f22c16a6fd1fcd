"""Gaussians that sleep on disk, in chunks of one anchor's, until a camera comes near."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import se3
from ldo_service.storage.checksummed_folder import ChecksummedFolder

from .chunk import Chunk, pack, unpack
from .model import ROW, GaussianBatch, GaussianMap, new_labels
from .visibility import BoundingSpheres, PlacedCamera

log = logging.getLogger(__name__)

_DISK_FULL = "Gaussians stay in memory, which may run out: free some disk space."
MAX_MOTIONS = 32  # of a chunk that are remembered; then
SETTLED_AT_ONCE = 16  # chunks with more are written anew, so many at a motion: 2 ms each


@dataclass(frozen=True, eq=False, slots=True)
class _Entry:
    """What memory keeps of a chunk beside the number of its file: its ids are `count` of those
    from the first to the last, `motions` what its anchor moved since it was written."""

    anchor: int
    first_id: int
    last_id: int
    count: int
    center_map: np.ndarray  # [3] of a sphere around it, now
    radius_m: float
    motions: tuple[np.ndarray, ...] = ()  # T_new_old [4, 4]

    def moved(self, T_new_old: np.ndarray) -> "_Entry":
        center = se3.transform(T_new_old, self.center_map)
        return replace(self, center_map=center, motions=(*self.motions, T_new_old))


@dataclass(frozen=True, slots=True)
class LostIdRange:
    """The ids from the first to the last that are nowhere else are lost."""

    first_id: int
    last_id: int


class OffloadedGaussians:
    """Chunks of Gaussians in `folder`, as if they had never left the map: bit for bit what they
    would be had they moved with their anchors while awake.

    A chunk takes below 1 kB of memory. Without a folder a temporary one is used, which goes with
    this object. Not for two threads at once. Raises ConfigError for a folder that cannot be used.

    The folder belongs to one state: `restore` and, without it, the first `put` remove the chunks
    that the state does not know. Files of chunks that woke stay until a `snapshot` without them is
    `saved`: who goes on from the last saved state needs them.
    """

    def __init__(self, folder: Path | None) -> None:
        self._files = ChecksummedFolder(folder, "gaussians", _DISK_FULL)
        self._entries: dict[int, _Entry] = {}  # by number, ascending
        self._next_number = 0
        self._retired: list[int] = []  # since the last snapshot
        self._retired_before: list[int] = []  # and before it
        self._spheres: BoundingSpheres | None = None  # None when the entries changed
        self._lost: list[LostIdRange] = []  # that nobody was told of
        self._slept = self._awoken = self._damaged = 0

    def __len__(self) -> int:
        """Gaussians that sleep."""
        return sum(entry.count for entry in self._entries.values())

    def numbers(self) -> list[int]:
        """Those of the chunks, ascending."""
        return list(self._entries)

    # --- one chunk --------------------------------------------------------------------------------
    def put(self, chunk: Chunk) -> int | None:
        """Write a chunk; its number.

        None when the disk does not take it: then it must stay awake. Raises ValueError for a chunk
        without Gaussians, or with ids that do not ascend.
        """
        ids, rows = chunk.ids, chunk.rows
        if len(ids) == 0 or len(ids) != len(rows) or np.any(np.diff(ids) <= 0):
            raise ValueError(f"anchor {chunk.anchor}: {len(ids)} ids, must ascend, one per row.")
        if self._next_number == 0:
            self._remove_unknown()
        sphere = BoundingSpheres.around(rows, chunk.anchors)
        place = sphere.centers[0], float(sphere.radii_m[0])
        entry = _Entry(chunk.anchor, int(ids[0]), int(ids[-1]), len(ids), *place)
        return self._write(chunk, entry)

    def load(self, number: int) -> Chunk:
        """Take a chunk out, as its anchor stands now.

        It is empty when its file is damaged, which is counted and logged: those Gaussians are lost.
        Raises KeyError for a number that does not sleep.
        """
        chunk = self._read(number)
        if number in self._entries:  # still: a damaged one is gone
            self._awoken += self._entries[number].count
            self._retire(number)
        return chunk

    # --- many, between here and the map -----------------------------------------------------------
    def offload_from(
        self, gaussians: GaussianMap, clumps: np.ndarray, chosen: Iterable[int]
    ) -> list[int]:
        """Let the Gaussians of the chosen clumps fall asleep; the numbers of their chunks.

        clumps [N] int, each of one anchor's Gaussians. Those that the disk does not take stay
        awake. Linear in the size of the map.
        """
        mask = np.isin(clumps, np.array(sorted(chosen), np.int64))
        of_clump = clumps[mask]
        taken = gaussians.extract(mask)
        numbers, refused = [], np.zeros(len(of_clump), bool)
        for members in _members(of_clump):
            ids, rows, anchors, labels = taken.at(members)
            number = self.put(Chunk(int(anchors[0]), ids, rows, labels))
            refused[members] = number is None
            numbers += [] if number is None else [number]
        if np.any(refused):
            gaussians.reinsert(*taken.at(refused))
        return numbers

    def load_into(self, gaussians: GaussianMap, numbers: Iterable[int]) -> np.ndarray:
        """Wake chunks into the map they came from; their ids [M] ascending. Linear in the size of
        the map."""
        chunks = [self.load(number) for number in sorted(numbers)]
        if not chunks:
            return np.zeros(0, np.int64)
        woken = _joined([chunk.piece() for chunk in chunks])
        gaussians.reinsert(*woken)
        return np.sort(woken.ids)

    # --- without waking ---------------------------------------------------------------------------
    def visible_chunks(self, camera: PlacedCamera, reach_m: float = inf) -> list[int]:
        """Numbers, ascending, of the chunks that the camera may see up to `reach_m` away. No file
        is read."""
        if self._spheres is None:
            self._spheres = self._all_spheres()
        seen = camera.may_see(self._spheres.centers, self._spheres.radii_m, reach_m)
        numbers = self.numbers()
        return [numbers[k] for k in np.flatnonzero(seen)]

    def move(self, T_new_old: Mapping[int, np.ndarray]) -> None:
        """What `GaussianMap.move_anchors` does to those that are awake."""
        for number, entry in self._entries.items():
            if entry.anchor in T_new_old:
                self._entries[number] = entry.moved(T_new_old[entry.anchor])
                self._spheres = None
        moved_often = [n for n, entry in self._entries.items() if len(entry.motions) > MAX_MOTIONS]
        for number in moved_often[:SETTLED_AT_ONCE]:
            self._rewrite_chunk(number)

    def chunks(self) -> Iterator[Chunk]:
        """All that sleep, by anchor, in order of their ids; those of one anchor in memory at a
        time."""
        by_anchor: dict[int, list[int]] = {}
        for number in sorted(self._entries, key=lambda n: self._entries[n].first_id):
            by_anchor.setdefault(self._entries[number].anchor, []).append(number)
        for anchor, numbers in by_anchor.items():
            parts = _joined([self._read(number).piece() for number in numbers])
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
        """Ids [L], ascending, of which some were lost since the last call, and none is there now:
        neither awake in the map they came from, nor asleep."""
        if not self._lost:
            return np.zeros(0, np.int64)
        lost, self._lost = self._lost, []
        ids = np.unique(np.concatenate([np.arange(one.first_id, one.last_id + 1) for one in lost]))
        asleep = [
            self._read(number).ids
            for number, entry in list(self._entries.items())
            if any(entry.first_id <= o.last_id and o.first_id <= entry.last_id for o in lost)
        ]
        return np.setdiff1d(ids, np.concatenate([gaussians.ids, *asleep]), assume_unique=True)

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, np.ndarray]:
        """The table of what sleeps, as named arrays; the Gaussians stay in their files."""
        self._retired_before, self._retired = [*self._retired_before, *self._retired], []
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

    def saved(self) -> None:
        """The last snapshot is where a successor will find it: files that it does not name go."""
        for number in self._retired_before:
            self._files.remove(number)
        self._retired_before = []

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a snapshot, with the files in this folder; chunks whose file is gone are
        dropped, counted and logged."""
        names = ("anchors", "first_ids", "last_ids", "counts", "centers", "radii_m")
        columns = [state[name] if name == "centers" else state[name].tolist() for name in names]
        motions = np.split(state["motions"], np.cumsum(state["motion_counts"]))[:-1]
        numbers = state["numbers"].tolist()
        self._entries = {
            number: _Entry(*fields, motions=tuple(own))
            for number, *fields, own in zip(numbers, *columns, motions, strict=True)
        }
        self._next_number, self._spheres = int(state["next_number"]), None
        self._retired, self._retired_before = [], []
        self._remove_unknown()
        for number in self._entries.keys() - self._files.sizes.keys():
            self._lose(number, "their file is gone")

    def metrics(self) -> dict[str, float]:
        return {
            "gaussians_offloaded": len(self),
            "chunks_offloaded": len(self._entries),
            "gaussians_offloaded_total": self._slept,
            "gaussians_loaded_total": self._awoken,
            "gaussians_lost_on_disk": self._damaged,
            "chunks_not_written": self._files.not_written,
        }

    # --- files ------------------------------------------------------------------------------------
    def _write(self, chunk: Chunk, entry: _Entry) -> int | None:
        number = self._next_number
        if not self._files.write(number, pack(chunk)):
            return None
        self._entries[number] = entry
        self._next_number += 1
        self._spheres = None
        self._slept += entry.count
        return number

    def _read(self, number: int) -> Chunk:
        """The chunk as it is now; an empty one, and the entry is gone, if damaged."""
        entry = self._entries[number]
        try:
            chunk = unpack(self._files.read(number))
            if (chunk.anchor, len(chunk.ids)) != (entry.anchor, entry.count):
                raise DataError(f"the file holds {len(chunk.ids)} of anchor {chunk.anchor}")
        except DataError as error:
            self._lose(number, str(error))
            rows = np.zeros((0, ROW), np.float32)
            return Chunk(entry.anchor, np.zeros(0, np.int64), rows, new_labels(0))
        return chunk.moved(entry.motions)

    def _rewrite_chunk(self, number: int) -> None:
        """Write a chunk anew, as it is now, and forget how it came there."""
        chunk, entry = self._read(number), self._entries.get(number)
        if entry is not None and self._write(chunk, replace(entry, motions=())) is not None:
            self._slept -= entry.count
            self._retire(number)

    def _lose(self, number: int, reason: str) -> None:
        entry = self._entries.pop(number)
        count, anchor = entry.count, entry.anchor
        log.error("anchor %d: %d of its sleeping Gaussians are lost: %s", anchor, count, reason)
        self._damaged += count
        self._spheres = None
        self._lost.append(LostIdRange(entry.first_id, entry.last_id))
        self._files.remove(number)

    def _retire(self, number: int) -> None:
        del self._entries[number]
        self._spheres = None
        if self._files.is_temporary:  # no successor will find it
            self._files.remove(number)
        else:
            self._retired.append(number)

    def _remove_unknown(self) -> None:
        for number in self._files.sizes.keys() - self._entries.keys():
            self._files.remove(number)


def _members(labels: np.ndarray) -> list[np.ndarray]:
    """Where each label is in labels [N], ascending; label by label."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(labels) else []


def _joined(pieces: list[GaussianBatch]) -> GaussianBatch:
    return GaussianBatch(*map(np.concatenate, zip(*pieces, strict=True)))


def _in_order(piece: GaussianBatch) -> GaussianBatch:
    return piece.at(np.argsort(piece.ids, kind="stable"))


def iter_all_gaussians(
    gaussians: GaussianMap, sleeping: OffloadedGaussians
) -> Iterator[GaussianBatch]:
    """All Gaussians, awake or asleep, in pieces; ids ascend throughout, as those of one anchor
    follow each other. Of those asleep, one anchor's are in memory at a time."""
    awake, start = gaussians.all(), 0
    for chunk in sleeping.chunks():
        first, last = map(int, np.searchsorted(awake.ids, chunk.ids[[0, -1]]))
        yield awake.at(slice(start, first))
        yield _in_order(_joined([awake.at(slice(first, last)), chunk.piece()]))
        start = last
    yield awake.at(slice(start, None))
