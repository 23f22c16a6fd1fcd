"""Publication of the map and its objects, in messages of bounded size.

Receivers build a copy of the map with the module `replica`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.conversions.objects import map_objects
from ldo_service.conversions.poses import pose_to_message
from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.runtime.process import trim_memory
from ldo_service.schemas import (
    AnchorMotion,
    Array,
    Gaussians,
    Keyframe,
    MapDelta,
    MapObject,
    MapObjects,
    MapRendering,
    MapSnapshot,
)
from ldo_service.semantics.objects import Objects

from .messages import NO_GAUSSIANS, NO_IDS, gaussians_message, rechunk, split_changes

# A restored mapper adds this number to the map version in its checkpoint, so that it does not reuse
# a version that replicas may have. Between two checkpoints, it publishes fewer versions.
VERSIONS_IN_A_CHECKPOINT = 1 << 20


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """Settings of the size and the rate of map messages."""

    # 16,384 Gaussians have 1.2 MB, or 1.8 MB with labels. A larger message would delay other
    # messages longer.
    max_gaussians_per_message: int = 16_384
    # Number of keyframes between two deltas of changed Gaussians. All Gaussians in view change at
    # every keyframe.
    update_interval_keyframes: int = 5
    snapshot_interval_keyframes: int = 10  # Minimum number of keyframes between two snapshots.
    # A snapshot is published when the map has grown by this fraction since the previous
    # snapshot. All snapshots together then have at most a few times the size of all deltas.
    min_snapshot_growth: float = 0.25
    # A snapshot is published after this number of keyframes even without growth, because a
    # subscriber that missed a delta waits for the next snapshot.
    max_snapshot_interval_keyframes: int = 200

    def __post_init__(self) -> None:
        counts = (
            *("max_gaussians_per_message", "update_interval_keyframes"),
            "snapshot_interval_keyframes",
        )
        if min(getattr(self, name) for name in counts) < 1:
            raise ConfigError(
                named(self, *counts) + ": max_gaussians_per_message, update_interval_keyframes and "
                "snapshot_interval_keyframes must be at least 1."
            )
        if self.min_snapshot_growth < 0:
            raise ConfigError(named(self, "min_snapshot_growth") + " must not be negative.")


@dataclass(frozen=True, slots=True)
class MessageContext:
    """Values that the caller supplies for every map message.

    Attributes:
        stamp_ns: Stamp of the newest keyframe.
        graph_version: Version of the pose graph.
        label_names: Names of all labels, by index.
    """

    stamp_ns: int
    graph_version: int
    label_names: tuple[str, ...]


class MapPublisher:
    """Publisher of the map of a `MapBuilder`, as map deltas and map snapshots.

    A delta has changes of the map, and a snapshot has the whole map. Each delta increases the
    version of the map. New Gaussians are published at each keyframe, changes of published Gaussians
    less often, and snapshots rarely.
    """

    def __init__(self, map_: MapBuilder, config: PublishConfig | None = None) -> None:
        self.config = config or PublishConfig()
        self.version = 0
        self._map = map_
        self._names_published = 0
        # The first keyframe publishes a snapshot.
        self._since_snapshot = self.config.snapshot_interval_keyframes
        self._since_changed = 0  # Keyframes since the last delta with changed Gaussians.
        self._in_snapshot = 0  # Number of Gaussians in the last snapshot.

    def on_keyframe(self, now: MessageContext) -> Iterator[MapDelta]:
        """Yield the deltas to publish after a new keyframe."""
        self._since_changed += 1
        is_time = self._since_changed >= self.config.update_interval_keyframes
        yield from self.deltas(now, with_changed=is_time)

    def deltas(self, now: MessageContext, *, with_changed: bool) -> Iterator[MapDelta]:
        """Yield the deltas with the unpublished changes of the map.

        Args:
            now: Context of the messages.
            with_changed: True to include changes of published Gaussians, and afterwards to move
                Gaussians above the memory limit to disk (`MapBuilder.offload_excess`). False to
                include only new and removed Gaussians.
        """
        changes = self._map.changes(with_changed=with_changed)
        for part in split_changes(changes, self.config.max_gaussians_per_message):
            yield self.delta(
                now,
                removed=part.removed,
                changed=self._gaussians(part.changed),
                added=self._gaussians(part.added),
            )
        if with_changed:
            self._since_changed = 0
            self._map.offload_excess()
            trim_memory()  # The steps above made copies as large as the map.

    def rendering(
        self, keyframe: Keyframe, now: MessageContext, *, contributions: bool
    ) -> MapRendering:
        """Render the map at the pose of a keyframe, and return the message.

        Args:
            keyframe: Message of a keyframe of the map.
            now: Context of the message.
            contributions: True to also compute the contribution of each Gaussian to the image,
                for a later call of `MapBuilder.visible_contributions`.
        """
        views, k = self._map.views, keyframe.keyframe
        rendering = self._map.render_keyframe(k, contributions=contributions)
        return MapRendering(
            stamp_ns=keyframe.stamp_ns,
            keyframe=k,
            version=self.version,
            graph_version=now.graph_version,
            camera=keyframe.camera,
            T_map_camera=pose_to_message(views.poses[k]),
            color=Array.of(_to_bytes(views.exposures[k].applied(rendering.color))),
            depth_m=Array.of(rendering.median_depth_m),
            opacity=Array.of(_to_bytes(rendering.opacity)),
        )

    def delta(
        self,
        now: MessageContext,
        motions: tuple[AnchorMotion, ...] = (),
        removed: np.ndarray = NO_IDS,
        changed: Gaussians = NO_GAUSSIANS,
        added: Gaussians = NO_GAUSSIANS,
    ) -> MapDelta:
        """Return a delta with the next version of the map.

        Args:
            now: Context of the message.
            motions: Motions of anchor keyframes. Each Gaussian moves with its anchor keyframe.
            removed: Ids of the removed Gaussians, [N] int64.
            changed: Gaussians that replace published ones with the same ids.
            added: New Gaussians.
        """
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
        """Return all label names if at least one was never published, else an empty tuple."""
        is_news, self._names_published = len(names) > self._names_published, len(names)
        return names if is_news else ()

    def _gaussians(self, chosen: np.ndarray) -> Gaussians:
        return gaussians_message(self._map.gaussians.all().at(chosen))

    # --- snapshots --------------------------------------------------------------------------------
    def snapshot_if_due(self, now: MessageContext) -> Iterator[MapDelta | MapSnapshot]:
        """Yield a snapshot if enough keyframes have passed since the last one.

        Call this once per keyframe. A snapshot is due after `snapshot_interval_keyframes` keyframes
        if the map has grown by the fraction `min_snapshot_growth`, else after
        `max_snapshot_interval_keyframes`.
        """
        self._since_snapshot += 1
        config, growth = self.config, self._map.size() - self._in_snapshot
        if growth >= config.min_snapshot_growth * self._in_snapshot:
            interval = config.snapshot_interval_keyframes
        else:
            interval = config.max_snapshot_interval_keyframes
        if self._since_snapshot >= interval:
            yield from self.publish_snapshot(now)

    def publish_snapshot(self, now: MessageContext) -> Iterator[MapDelta | MapSnapshot]:
        """Yield the deltas with all unpublished changes, then a snapshot of the whole map.

        After the deltas, an existing copy of the map equals a new copy that starts from the
        snapshot.
        """
        yield from self.deltas(now, with_changed=True)
        self._since_snapshot, self._in_snapshot = 0, self._map.size()
        parts = max(1, -(-self._map.size() // self.config.max_gaussians_per_message))
        messages = rechunk(self._map.batches(), parts, self.config.max_gaussians_per_message)
        exposures = self._map.views.exposures
        for part, gaussians in enumerate(messages):
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
            "names_published": self._names_published,
        }

    def restore(self, state: dict[str, int]) -> None:
        self.version = state["version"] + VERSIONS_IN_A_CHECKPOINT
        self._since_changed = state["since_changed"]
        self._since_snapshot, self._in_snapshot = state["since_snapshot"], state["in_snapshot"]
        self._names_published = state["names_published"]


class ObjectPublisher:
    """Publisher of the topic map/objects.

    The publisher caches the message of each object and converts only objects that have changed.
    Without the cache, the conversion of a thousand objects would take 50 ms per message.
    """

    def __init__(self) -> None:
        # Landmark row as bytes, and the message made from it, by object id.
        self._made: dict[int, tuple[bytes, MapObject]] = {}

    def message(
        self,
        objects: Objects,
        names: Sequence[str],
        version: int,
        graph_version: int,
        stamp_ns: int,
    ) -> MapObjects:
        """Return the message of all objects.

        Args:
            objects: The objects.
            names: Names of the vocabulary, by label index; the vocabulary may grow between calls.
            version: Version of the map.
            graph_version: Version of the pose graph.
            stamp_ns: Stamp of the newest keyframe.
        """
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


def _to_bytes(image: np.ndarray) -> np.ndarray:
    """Convert an image from 0..1 float to 0..255 uint8."""
    scaled = np.clip(image, 0.0, 1.0)
    scaled *= 255.0
    scaled += 0.5
    return scaled.astype(np.uint8)
