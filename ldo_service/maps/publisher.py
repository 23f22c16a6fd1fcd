"""Publication of the map and its objects, in messages of a bounded size.

`replica` holds the receiving side. Objects that did not change are not encoded again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.conversions.objects import map_objects
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.runtime.process import trim_memory
from ldo_service.schemas import (
    AnchorMotion,
    Array,
    Gaussians,
    MapDelta,
    MapObject,
    MapObjects,
    MapSnapshot,
)
from ldo_service.semantics.objects import Objects

from .messages import NO_GAUSSIANS, NO_IDS, gaussians_message, rechunk, split_changes

# A successor starts from a checkpoint and must not use a version again that followers may hold:
# more than a mapper could use up between two checkpoints.
VERSIONS_IN_A_CHECKPOINT = 1 << 20


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """How much at once, and how often; see `MapperConfig`."""

    part_gaussians: int
    changed_keyframes: int
    snapshot_keyframes: int
    snapshot_growth: float
    snapshot_keyframes_max: int


@dataclass(frozen=True, slots=True)
class MessageContext:
    """stamp_ns of the newest keyframe, version of the graph, all names of labels."""

    stamp_ns: int
    graph_version: int
    label_names: tuple[str, ...]


class MapPublisher:
    """Counts the versions of a MapBuilder's map: one per delta. New Gaussians are told at once, how
    old ones changed now and then, and the whole of it seldom."""

    def __init__(self, map_: MapBuilder, pace: PublishConfig) -> None:
        self.version = 0
        self._map, self._pace = map_, pace
        self._names_told = 0
        self._since_snapshot = pace.snapshot_keyframes  # the first keyframe sends one
        self._since_changed = 0
        self._in_snapshot = 0  # Gaussians in the last one

    def on_keyframe(self, now: MessageContext) -> Iterator[MapDelta]:
        """There is one more."""
        self._since_changed += 1
        is_time = self._since_changed >= self._pace.changed_keyframes
        yield from self.deltas(now, with_changed=is_time)

    def deltas(self, now: MessageContext, *, with_changed: bool) -> Iterator[MapDelta]:
        """What followers do not know."""
        changes = self._map.changes(with_changed=with_changed)
        for part in split_changes(changes, self._pace.part_gaussians):
            yield self.delta(
                now,
                removed=part.removed,
                changed=self._gaussians(part.changed),
                added=self._gaussians(part.added),
            )
        if with_changed:
            self._since_changed = 0
            self._map.offload_excess()
            trim_memory()  # copies as large as the map were made

    def delta(
        self,
        now: MessageContext,
        motions: tuple[AnchorMotion, ...] = (),
        removed: np.ndarray = NO_IDS,
        changed: Gaussians = NO_GAUSSIANS,
        added: Gaussians = NO_GAUSSIANS,
    ) -> MapDelta:
        self.version += 1
        return MapDelta(
            stamp_ns=now.stamp_ns,
            base_version=self.version - 1,
            version=self.version,
            graph_version=now.graph_version,
            motions=motions,
            removed=Array.of(removed),
            changed=changed,
            added=added,
            label_names=self._new_names(now.label_names),
        )

    def _new_names(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """All, if there are some that followers do not know."""
        is_news, self._names_told = len(names) > self._names_told, len(names)
        return names if is_news else ()

    def _gaussians(self, chosen: np.ndarray) -> Gaussians:
        return gaussians_message(self._map.gaussians.all().at(chosen))

    # --- the whole --------------------------------------------------------------------------------
    def snapshot_if_due(self, now: MessageContext) -> Iterator[MapDelta | MapSnapshot]:
        """To be asked once per keyframe."""
        self._since_snapshot += 1
        pace, grown = self._pace, self._map.size() - self._in_snapshot
        has_grown = grown >= pace.snapshot_growth * self._in_snapshot
        if self._since_snapshot >= (
            pace.snapshot_keyframes if has_grown else pace.snapshot_keyframes_max
        ):
            yield from self.publish_snapshot(now)

    def publish_snapshot(self, now: MessageContext) -> Iterator[MapDelta | MapSnapshot]:
        """First all that is new, so that followers and late joiners hold the same."""
        yield from self.deltas(now, with_changed=True)
        self._since_snapshot, self._in_snapshot = 0, self._map.size()
        parts = max(1, -(-self._map.size() // self._pace.part_gaussians))
        pieces = rechunk(self._map.batches(), parts, self._pace.part_gaussians)
        exposures = self._map.views.exposures
        for part, gaussians in enumerate(pieces):
            named = list(exposures) if part == 0 else []
            matrices = [exposures[k].matrix for k in named]
            yield MapSnapshot(
                stamp_ns=now.stamp_ns,
                version=self.version,
                graph_version=now.graph_version,
                part=part,
                parts=parts,
                gaussians=gaussians,
                keyframes=Array.of(np.array(named, np.int64)),
                exposures=Array.of(np.array(matrices, np.float32).reshape(-1, 2, 3)),
                label_names=now.label_names if part == 0 else (),
            )

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, int]:
        """Return the counters that `restore` needs."""
        return {
            "version": self.version,
            "since_changed": self._since_changed,
            "since_snapshot": self._since_snapshot,
            "in_snapshot": self._in_snapshot,
            "names_told": self._names_told,
        }

    def restore(self, state: dict[str, int]) -> None:
        self.version = state["version"] + VERSIONS_IN_A_CHECKPOINT
        self._since_changed = state["since_changed"]
        self._since_snapshot, self._in_snapshot = state["since_snapshot"], state["in_snapshot"]
        self._names_told = state["names_told"]


class ObjectPublisher:
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
