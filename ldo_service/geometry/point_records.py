"""A table of records by id, in one array: for what is kept of each keyframe as long as the map."""

from collections.abc import Collection, Iterable, Iterator, Mapping, MutableMapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

MIN_ROOM = 64  # records
GROWTH = 1.25  # at most a fifth of the room is empty


class RecordTable:
    """Records with a field `id`, ascending; so compact as a dict of arrays is not, by four."""

    def __init__(self, dtype: DTypeLike) -> None:
        self._room = np.zeros(MIN_ROOM, dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __contains__(self, id_: object) -> bool:
        return isinstance(id_, int | np.integer) and self.row(int(id_)) is not None

    @property
    def all(self) -> np.ndarray:
        """[N] records: writing to them writes to the table, until one is put or removed."""
        return self._room[: self._count]

    @property
    def ids(self) -> np.ndarray:
        return self.all["id"]

    def row(self, id_: int) -> int | None:
        row = int(np.searchsorted(self.ids, id_))
        return row if row < self._count and self.ids[row] == id_ else None

    def rows(self, ids: Iterable[int]) -> np.ndarray:
        """Of those ids that are known, as often as they are named."""
        rows, is_known = self._found(ids)
        return rows[is_known]

    def are_known(self, ids: Iterable[int]) -> np.ndarray:
        """[n] bool of n ids."""
        return self._found(ids)[1]

    def _found(self, ids: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
        """Rows [n] of n ids, and which of these are theirs [n] bool."""
        wanted = np.fromiter(ids, np.int64)
        rows = np.searchsorted(self.ids, wanted)
        is_known = rows < self._count
        is_known[is_known] = self.ids[rows[is_known]] == wanted[is_known]
        return rows, is_known

    def put(self, id_: int, *values: Any) -> None:
        """Its other fields, in their order; in place of what was known of it."""
        row = int(np.searchsorted(self.ids, id_))
        if row == self._count or self.ids[row] != id_:
            self._make_room(row)
        self._room[row] = (id_, *values)

    def _make_room(self, row: int) -> None:
        if self._count == len(self._room):
            more = np.zeros(max(MIN_ROOM, int((GROWTH - 1) * self._count)), self._room.dtype)
            self._room = np.concatenate([self._room, more])
        self._room[row + 1 : self._count + 1] = self._room[row : self._count]
        self._count += 1

    def remove(self, id_: int) -> None:
        """Raises KeyError when it is not known."""
        row = self.row(id_)
        if row is None:
            raise KeyError(id_)
        self._room[row : self._count - 1] = self._room[row + 1 : self._count]
        self._count -= 1

    def keep_only(self, ids: Iterable[int]) -> None:
        self.replace_all(self.all[np.sort(np.unique(self.rows(ids)))])

    def replace_all(self, records: np.ndarray) -> None:
        """Exactly these [N], ids ascending."""
        room = np.zeros(max(MIN_ROOM, len(records)), self._room.dtype)
        room[: len(records)] = records
        self._room, self._count = room, len(records)

    def columns(self) -> dict[str, np.ndarray]:
        """A copy, by the name of the field."""
        return {name: self.all[name].copy() for name in self._room.dtype.names or ()}

    def restore(self, columns: Mapping[str, np.ndarray]) -> None:
        """The inverse of `columns`."""
        records: np.ndarray = np.zeros(len(columns["id"]), self._room.dtype)
        for name in records.dtype.names or ():
            records[name] = columns[name]
        self.replace_all(records)


class PoseTable(MutableMapping[int, np.ndarray]):
    """Transforms [4, 4] by id, ascending, in 136 bytes each."""

    def __init__(self) -> None:
        self._records = RecordTable([("id", np.int64), ("T", float, (4, 4))])

    def __getitem__(self, id_: int) -> np.ndarray:
        """A copy. Raises KeyError."""
        row = self._records.row(id_)
        if row is None:
            raise KeyError(id_)
        return self._records.all["T"][row].copy()

    def __setitem__(self, id_: int, T: np.ndarray) -> None:
        self._records.put(id_, T)

    def __delitem__(self, id_: int) -> None:
        self._records.remove(id_)

    def __iter__(self) -> Iterator[int]:
        return iter(self._records.ids.tolist())

    def __len__(self) -> int:
        return len(self._records)

    def __contains__(self, id_: object) -> bool:
        return id_ in self._records

    def of(self, ids: Iterable[int]) -> np.ndarray:
        """[n, 4, 4] of known ones."""
        return self._records.all["T"][self._records.rows(ids)]

    def become(self, ids: Collection[int], T: np.ndarray) -> None:
        """Exactly these, ids ascending."""
        self._records.restore({"id": np.fromiter(ids, np.int64), "T": T})
