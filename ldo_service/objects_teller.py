"""The objects of a map as messages; what did not change is not made again."""

from collections.abc import Sequence

import numpy as np

from ldo_service.schemas import MapObject, MapObjects
from ldo_service.semantics.objects import Objects
from ldo_service.wire import map_objects


class ObjectsTeller:
    """Makes map/objects: a thousand objects take 50 ms to make, and few change at a time. `names`
    of the vocabulary may get more."""

    def __init__(self) -> None:
        self._made: dict[int, tuple[bytes, MapObject]] = {}  # by id: the landmark, and its message

    def message(
        self,
        objects: Objects,
        names: Sequence[str],
        version: int,
        graph_version: int,
        stamp_ns: int,
    ) -> MapObjects:
        table = objects.landmarks
        rows, ids = [row.tobytes() for row in table], table["id"].tolist()
        known = [self._made.get(id_, (b"",))[0] == row for id_, row in zip(ids, rows, strict=True)]
        new = np.flatnonzero(~np.array(known, bool))
        for k, one in zip(new.tolist(), map_objects(table[new], names), strict=True):
            self._made[one.id] = rows[k], one
        self._made = {id_: self._made[id_] for id_ in ids}
        return MapObjects(
            stamp_ns=stamp_ns,
            version=version,
            graph_version=graph_version,
            objects=tuple(one for _, one in self._made.values()),
        )
