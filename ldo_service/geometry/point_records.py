"""Compact tables of records by id, for data that every keyframe of the map has."""

from collections.abc import Collection, Iterable, Iterator, Mapping, MutableMapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

MIN_ROOM = 64  # Minimum capacity in records.
GROWTH = 1.25  # Factor by which the capacity grows: at most a fifth of the capacity is unused.


class RecordTable:
    """Records in one array, sorted by their field `id`.

    The table needs a quarter of the memory of a dict of arrays.
    """

    def __init__(self, dtype: DTypeLike) -> None:
        self._room = np.zeros(MIN_ROOM, dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __contains__(self, id_: object) -> bool:
        return isinstance(id_, int | np.integer) and self.row(int(id_)) is not None

    @property
    def all(self) -> np.ndarray:
        """View of all records [N]; invalid once a record is added or removed."""
        return self._room[: self._count]

    @property
    def ids(self) -> np.ndarray:
        """Ids [N] in ascending order."""
        return self.all["id"]

    def row(self, id_: int) -> int | None:
        """Return the row number of an id, or None if the id is unknown."""
        ids = self.ids
        row = int(ids.searchsorted(id_))
        return row if row < self._count and ids[row] == id_ else None

    def rows(self, ids: Iterable[int]) -> np.ndarray:
        """Return the row number of each known id in `ids`, in the order of `ids`."""
        rows, is_known = self._found(ids)
        return rows[is_known]

    def are_known(self, ids: Iterable[int]) -> np.ndarray:
        """Return which of n ids are known, [n] bool."""
        return self._found(ids)[1]

    def _found(self, ids: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows [n] of n ids, and which of the ids are known [n] bool."""
        wanted = np.fromiter(ids, np.int64)
        rows = np.searchsorted(self.ids, wanted)
        is_known = rows < self._count
        is_known[is_known] = self.ids[rows[is_known]] == wanted[is_known]
        return rows, is_known

    def put(self, id_: int, *values: Any) -> None:
        """Add or replace a record.

        Args:
            id_: Id of the record.
            *values: Values of the other fields, in the order of the dtype.
        """
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
        """Remove a record.

        Raises:
            KeyError: The id is unknown.
        """
        row = self.row(id_)
        if row is None:
            raise KeyError(id_)
        self._room[row : self._count - 1] = self._room[row + 1 : self._count]
        self._count -= 1

    def keep_only(self, ids: Iterable[int]) -> None:
        """Remove all records except those of the given ids."""
        self.replace_all(self.all[np.sort(np.unique(self.rows(ids)))])

    def replace_all(self, records: np.ndarray) -> None:
        """Replace the table by records [N], which must be in ascending order of their ids."""
        room = np.zeros(max(MIN_ROOM, len(records)), self._room.dtype)
        room[: len(records)] = records
        self._room, self._count = room, len(records)

    def columns(self) -> dict[str, np.ndarray]:
        """Return a copy of the table: one array per field, by field name."""
        return {name: self.all[name].copy() for name in self._room.dtype.names or ()}

    def restore(self, columns: Mapping[str, np.ndarray]) -> None:
        """Replace the table by arrays that `columns` returned."""
        records: np.ndarray = np.zeros(len(columns["id"]), self._room.dtype)
        for name in records.dtype.names or ():
            records[name] = columns[name]
        self.replace_all(records)


class PoseTable(MutableMapping[int, np.ndarray]):
    """Mapping from ids to transforms [4, 4], in ascending order of ids; an entry has 136 bytes."""

    def __init__(self) -> None:
        self._records = RecordTable([("id", np.int64), ("T", float, (4, 4))])

    def __getitem__(self, id_: int) -> np.ndarray:
        """Return a copy of a transform.

        Raises:
            KeyError: The id is unknown.
        """
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
        """Return the transforms [n, 4, 4] of the known ids in `ids`."""
        return self._records.all["T"][self._records.rows(ids)]

    def become(self, ids: Collection[int], T: np.ndarray) -> None:
        """Replace all entries by `ids` [n], in ascending order, and their transforms [n, 4, 4]."""
        self._records.restore({"id": np.fromiter(ids, np.int64), "T": T})
