"""Gaussians that sleep on disk, an anchor's together, until a camera comes near."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError

from .anchor_spheres import AnchorSpheres, PlacedCamera
from .chunk import Chunk, packed, unpacked
from .model import ROW, GaussianMap
from .sealed_folder import SealedFolder

log = logging.getLogger(__name__)

Poses = Mapping[int, np.ndarray]  # T_map_anchor [4, 4] by anchor
_DISK_FULL = "Gaussians stay in memory, which may run out: free some disk space."


@dataclass(frozen=True, eq=False, slots=True)
class _Entry:
    """What memory keeps of a chunk: its file, where its anchor stood, a sphere around it."""

    serial: int  # of the file
    first_id: int
    count: int
    T_map_anchor: np.ndarray  # when it fell asleep
    center_anchor: np.ndarray  # [3]
    radius_m: float


class SleepingGaussians:
    """Chunks of Gaussians in `folder`, as if they had never left the map.

    A chunk is moved when it wakes, by all that its anchor moved while it slept: an anchor that
    stands where it stood gets it back bit for bit, another to float32 rounding and the sign of
    quaternions. A chunk takes below 1 kB of memory. Without a folder a temporary one is used, which
    goes with this object. Not for two threads at once. Raises ConfigError for a folder that cannot
    be used.

    The folder belongs to one state: `restore` and, without it, the first `put` remove the chunks
    that the state does not know. Files of chunks that woke stay until the second `snapshot` after,
    when the first is sure to be saved: who goes on from the last saved state needs them.
    """

    def __init__(self, folder: Path | None) -> None:
        self._files = SealedFolder(folder, "gaussians", _DISK_FULL)
        self._entries: dict[int, _Entry] = {}  # by anchor
        self._next_serial = 0
        self._woken: list[int] = []  # serials, since the last snapshot
        self._woken_before: list[int] = []  # between the last two snapshots
        self._spheres: AnchorSpheres | None = None  # None when the entries changed
        self._slept = self._awoken = self._lost = 0

    def __len__(self) -> int:
        """Gaussians that sleep."""
        return sum(entry.count for entry in self._entries.values())

    def __contains__(self, anchor: int) -> bool:
        return anchor in self._entries

    def anchors(self) -> list[int]:
        """Those that sleep, ascending."""
        return sorted(self._entries)

    # --- one chunk --------------------------------------------------------------------------------
    def put(self, anchor: int, ids: np.ndarray, rows: np.ndarray, T_map_anchor: np.ndarray) -> bool:
        """Write the Gaussians ids [M] ascending, rows [M, 16] of an anchor at T_map_anchor.

        False when the disk does not take them: then they must stay awake. Raises ValueError for
        an anchor that sleeps already, no Gaussians, or ids that do not ascend.
        """
        if anchor in self._entries:
            raise ValueError(f"anchor {anchor} sleeps already.")
        if len(ids) == 0 or len(ids) != len(rows) or np.any(np.diff(ids) <= 0):
            raise ValueError(f"anchor {anchor}: {len(ids)} ids, must ascend, one for each row.")
        if self._next_serial == 0:
            self._remove_unknown()
        if not self._files.write(self._next_serial, packed(Chunk(anchor, ids, rows))):
            return False
        anchors = np.full(len(ids), anchor, np.int32)
        sphere = AnchorSpheres.around(rows, anchors, {anchor: T_map_anchor})
        self._entries[anchor] = _Entry(
            self._next_serial,
            int(ids[0]),
            len(ids),
            np.array(T_map_anchor, float),
            sphere.centers[0],
            float(sphere.radii_m[0]),
        )
        self._next_serial += 1
        self._spheres = None
        self._slept += len(ids)
        return True

    def wake(self, anchor: int, T_map_anchor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take a chunk out: ids [M], rows [M, 16] with the anchor at T_map_anchor.

        Both are empty when its file is damaged, which is counted and logged: those Gaussians are
        lost. Raises KeyError for an anchor that does not sleep.
        """
        entry = self._entries[anchor]
        chunk = self._read(anchor, entry, T_map_anchor)
        if anchor in self._entries:  # still: a damaged one is gone
            self._forget(anchor)
            self._retire(entry.serial)
            self._awoken += entry.count
        return chunk.ids, chunk.rows

    # --- many, between here and the map -----------------------------------------------------------
    def take_from(
        self, gaussians: GaussianMap, anchors: Iterable[int], T_map_anchor: Poses
    ) -> list[int]:
        """Let all Gaussians of `anchors` fall asleep; the anchors that did.

        The others have none, or the disk does not take them, and they stay awake. Linear in the
        size of the map. Raises ValueError for anchors that sleep already, KeyError without a pose.
        """
        poses = {anchor: T_map_anchor[anchor] for anchor in sorted(set(anchors))}
        if twice := poses.keys() & self._entries.keys():
            raise ValueError(f"anchors {sorted(twice)} sleep already.")
        mask = np.isin(gaussians.anchors, np.array(list(poses), np.int32))
        ids, rows, hung = gaussians.take_out(mask)
        asleep = []
        for anchor, T in poses.items():
            own = hung == anchor
            if np.any(own) and self.put(anchor, ids[own], rows[own], T):
                asleep.append(anchor)
        refused = ~np.isin(hung, np.array(asleep, np.int32))
        if np.any(refused):
            gaussians.bring_back(ids[refused], rows[refused], hung[refused])
        return asleep

    def return_to(
        self, gaussians: GaussianMap, anchors: Iterable[int], T_map_anchor: Poses
    ) -> np.ndarray:
        """Wake the chunks of `anchors` into the map they came from; their ids [M] ascending.
        Linear in the size of the map."""
        chunks = [Chunk(a, *self.wake(a, T_map_anchor[a])) for a in sorted(anchors)]
        if not chunks:
            return np.zeros(0, np.int64)
        ids = np.concatenate([chunk.ids for chunk in chunks])
        rows = np.concatenate([chunk.rows for chunk in chunks])
        gaussians.bring_back(ids, rows, np.concatenate([chunk.anchors for chunk in chunks]))
        return np.sort(ids)

    # --- without waking ---------------------------------------------------------------------------
    def seen_from(
        self, camera: PlacedCamera, T_map_anchor: Poses, reach_m: float = inf
    ) -> list[int]:
        """Anchors, ascending, whose sleeping Gaussians the camera may see up to `reach_m` away,
        with the anchors at these poses. No file is read."""
        spheres = self._all_spheres()
        seen = camera.may_see(spheres.centers_map(T_map_anchor), spheres.radii_m, reach_m)
        return spheres.anchors[seen].tolist()

    def chunks(self, T_map_anchor: Poses) -> Iterator[Chunk]:
        """All that sleep, in order of their ids, at these poses; one in memory at a time."""
        for anchor in sorted(self._entries, key=lambda k: self._entries[k].first_id):
            chunk = self._read(anchor, self._entries[anchor], T_map_anchor[anchor])
            if len(chunk.ids):
                yield chunk

    def _all_spheres(self) -> AnchorSpheres:
        if self._spheres is None:
            anchors = self.anchors()
            entries = [self._entries[k] for k in anchors]
            self._spheres = AnchorSpheres(
                np.array(anchors, np.int32),
                np.array([entry.count for entry in entries], np.int64),
                np.array([entry.center_anchor for entry in entries]).reshape(-1, 3),
                np.array([entry.radius_m for entry in entries], float),
            )
        return self._spheres

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, np.ndarray]:
        """The table of what sleeps, as named arrays; the Gaussians stay in their files."""
        for serial in self._woken_before:
            self._files.remove(serial)
        self._woken_before, self._woken = self._woken, []
        anchors = self.anchors()
        entries = [self._entries[k] for k in anchors]
        return {
            "anchors": np.array(anchors, np.int32),
            "serials": np.array([entry.serial for entry in entries], np.int64),
            "first_ids": np.array([entry.first_id for entry in entries], np.int64),
            "counts": np.array([entry.count for entry in entries], np.int64),
            "T_map_anchor": np.array([entry.T_map_anchor for entry in entries]).reshape(-1, 4, 4),
            "centers": np.array([entry.center_anchor for entry in entries]).reshape(-1, 3),
            "radii_m": np.array([entry.radius_m for entry in entries], float),
            "next_serial": np.array(self._next_serial, np.int64),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a snapshot, with the files in this folder; chunks whose file is gone are
        dropped, counted and logged."""
        names = ("serials", "first_ids", "counts", "T_map_anchor", "centers", "radii_m")
        self._entries = {
            int(anchor): _Entry(int(serial), int(first), int(count), T, center, float(radius))
            for anchor, serial, first, count, T, center, radius in zip(
                state["anchors"], *(state[name] for name in names), strict=True
            )
        }
        self._next_serial, self._spheres = int(state["next_serial"]), None
        self._woken, self._woken_before = [], []
        self._remove_unknown()
        for anchor, entry in list(self._entries.items()):
            if entry.serial not in self._files.sizes:
                self._lose(anchor, "their file is gone")

    def statistics(self) -> dict[str, float]:
        return {
            "gaussians_asleep": len(self),
            "anchors_asleep": len(self._entries),
            "gaussians_fell_asleep": self._slept,
            "gaussians_woken": self._awoken,
            "gaussians_lost_on_disk": self._lost,
            "chunks_not_written": self._files.not_written,
        }

    # --- files ------------------------------------------------------------------------------------
    def _read(self, anchor: int, entry: _Entry, T_map_anchor: np.ndarray) -> Chunk:
        """The chunk at a pose of its anchor; an empty one, and the entry is gone, if damaged."""
        try:
            chunk = unpacked(self._files.read(entry.serial))
            if (chunk.anchor, len(chunk.ids)) != (anchor, entry.count):
                raise DataError(f"the file holds {len(chunk.ids)} of anchor {chunk.anchor}")
        except DataError as error:
            self._lose(anchor, str(error))
            return Chunk(anchor, np.zeros(0, np.int64), np.zeros((0, ROW), np.float32))
        return chunk.carried(entry.T_map_anchor, T_map_anchor)

    def _lose(self, anchor: int, reason: str) -> None:
        entry = self._entries[anchor]
        log.error("anchor %d: its %d sleeping Gaussians are lost: %s", anchor, entry.count, reason)
        self._lost += entry.count
        self._forget(anchor)
        self._files.remove(entry.serial)

    def _forget(self, anchor: int) -> None:
        del self._entries[anchor]
        self._spheres = None

    def _retire(self, serial: int) -> None:
        if self._files.is_temporary:  # no successor will find it
            self._files.remove(serial)
        else:
            self._woken.append(serial)

    def _remove_unknown(self) -> None:
        known = {entry.serial for entry in self._entries.values()}
        for serial in self._files.sizes.keys() - known:
            self._files.remove(serial)


def whole_map(
    gaussians: GaussianMap, sleeping: SleepingGaussians, T_map_anchor: Poses
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """All Gaussians, awake or asleep, in pieces of ids, rows and anchors; ids ascend throughout,
    as those of one anchor follow each other. At most one chunk is in memory at a time."""
    start = 0
    for chunk in sleeping.chunks(T_map_anchor):
        stop = int(np.searchsorted(gaussians.ids, chunk.ids[0]))
        yield gaussians.ids[start:stop], gaussians.rows[start:stop], gaussians.anchors[start:stop]
        yield chunk.ids, chunk.rows, chunk.anchors
        start = stop
    yield gaussians.ids[start:], gaussians.rows[start:], gaussians.anchors[start:]
