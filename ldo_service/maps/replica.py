"""Map replica: a copy of the mapper's map, updated by the messages of the mapper."""

import numpy as np

from ldo_service.conversions.poses import pose_from_message
from ldo_service.gaussians.model import GaussianBatch, GaussianMap
from ldo_service.gaussians.pruning import weightiest
from ldo_service.schemas import MapDelta, MapSnapshot

from .messages import batch_of

NEUTRAL = np.array([[1, 1, 1], [0, 0, 0]], np.float32)  # Default gains and biases, [2, 3].
# A bounded replica is reduced to its limit when its size exceeds the limit by this factor.
SLACK = 1.25


class MapReplica:
    """Replica of a map. Pass every message of map/delta and map/snapshot to `apply`.

    An exact replica has all Gaussians: `map` equals the map of the mapper at `version`. After a
    missed delta, an exact replica sets `is_behind` and stays unchanged until it has received a
    complete snapshot.

    A bounded replica has at most `max_gaussians` Gaussians, and up to a quarter more for a short
    time. It keeps the Gaussians with the largest weight, which is opacity times area. After a
    missed delta, a bounded replica sets `is_behind` and still applies further deltas, so the map
    may have errors until the next snapshot. Each part of a snapshot is applied on arrival: its
    Gaussians replace all Gaussians in the same range of ids.

    Args:
        max_gaussians: Maximum number of Gaussians of a bounded replica; None for an exact replica.
    """

    def __init__(self, max_gaussians: int | None = None) -> None:
        self._max_gaussians = max_gaussians
        self.reset()

    def reset(self) -> None:
        """Start again with an empty map."""
        self.map = GaussianMap()
        self.version = 0
        self.is_behind = False
        self.label_names: tuple[str, ...] = ()  # Names of the labels, by index.
        self._exposures: dict[int, np.ndarray] = {}
        self._next_id = 0  # Greater than all ids received so far.
        # True if Gaussians were removed because of the limit. Their weight may have grown
        # since then. A snapshot of the same version must therefore be applied too.
        self._was_cut = False
        # Parts of the incomplete snapshot of an exact replica.
        self._parts: dict[int, MapSnapshot] = {}
        self._last_ids: dict[int, int] = {}  # Last id of each part that a bounded replica applied.
        self._applied_version = 0  # Version of the parts in `_last_ids`.

    def exposure(self, keyframe: int) -> np.ndarray:
        """Return the gains and biases [2, 3] of a keyframe's image, from the last snapshot.

        For a keyframe that the snapshot does not contain, all gains are 1 and all biases 0.
        """
        return self._exposures.get(keyframe, NEUTRAL)

    def apply(self, message: MapDelta | MapSnapshot) -> bool:
        """Apply a message, and return whether the map changed."""
        if isinstance(message, MapDelta):
            has_changed = self._apply_delta(message)
        elif self._max_gaussians is None:
            has_changed = self._collect_part(message)
        else:
            has_changed = self._apply_part(message)
        self._cut_to_limit()
        return has_changed

    # --- changes ----------------------------------------------------------------------------------
    def _apply_delta(self, delta: MapDelta) -> bool:
        if delta.base_version == 0 and self.version:
            self.reset()  # The mapper restarted with an empty map.
        if delta.version <= self.version:
            return False
        if delta.base_version != self.version:
            self.is_behind = True
            if self._max_gaussians is None:
                return False
        if delta.motions:
            self.map.move_anchors(
                {m.keyframe: pose_from_message(m.T_new_old) for m in delta.motions}
            )
        if delta.removed.shape[0]:
            self.map.remove(np.isin(self.map.ids, delta.removed.numpy()))
        self._change(batch_of(delta.changed))
        self._add(batch_of(delta.added))
        self.label_names = delta.label_names or self.label_names
        self.version = delta.version
        return True

    def _change(self, changed: GaussianBatch) -> None:
        """Overwrite the changed Gaussians; skip those that a bounded replica does not hold."""
        if not (len(self.map) and len(changed.ids)):
            return
        where = np.searchsorted(self.map.ids, changed.ids)
        where = np.minimum(where, len(self.map) - 1)
        is_here = self.map.ids[where] == changed.ids
        where = where[is_here]
        self.map.rows[where] = changed.rows[is_here]
        self.map.labels[where] = changed.labels[is_here]
        self.map.touch(where.astype(np.uint32))

    def _add(self, added: GaussianBatch) -> None:
        """Append the Gaussians with new ids; skip those that an earlier message contained."""
        new = added.at(added.ids >= self._next_id)
        self.map.append(*new)
        self._next_id = max(self._next_id, int(new.ids[-1]) + 1 if len(new.ids) else 0)

    def _cut_to_limit(self) -> None:
        if self._max_gaussians is not None and len(self.map) > SLACK * self._max_gaussians:
            self.map.remove(~weightiest(self.map.rows, self._max_gaussians))
            self._was_cut = True

    # --- snapshots --------------------------------------------------------------------------------
    def _collect_part(self, part: MapSnapshot) -> bool:
        """Store one message of a snapshot; replace the map after the last missing message.

        Returns:
            True if the map was replaced.
        """
        self._note_exposures(part)
        if part.version < self.version or (part.version == self.version and not self.is_behind):
            return False
        if any(other.version != part.version for other in self._parts.values()):
            self._parts.clear()
        self._parts[part.part] = part
        if len(self._parts) < part.parts:
            return False
        self.map, self._next_id = GaussianMap(), 0
        for number in range(part.parts):
            self._add(batch_of(self._parts[number].gaussians))
        self.label_names = self._parts[0].label_names
        self.version, self.is_behind = part.version, False
        self._parts.clear()
        return True

    def _apply_part(self, part: MapSnapshot) -> bool:
        """Replace all Gaussians in the id range of one message of a snapshot by its Gaussians.

        Returns:
            False if the message has nothing new, so that the map stays the same.
        """
        self._note_exposures(part)
        is_news = self.is_behind or self._was_cut or part.version > self.version
        if part.version < self.version or not is_news:
            return False
        if part.version != self._applied_version:
            self._last_ids.clear()
            self._applied_version = part.version
        batch = batch_of(part.gaussians)
        first, last = self._span(part, batch.ids)
        self.map.remove((self.map.ids >= first) & (self.map.ids <= last))
        self.map.reinsert(*batch.at(batch.ids < self._next_id))
        self._add(batch)
        self.label_names = part.label_names or self.label_names
        self._last_ids[part.part] = int(batch.ids[-1]) if len(batch.ids) else -1
        if len(self._last_ids) == part.parts:
            self.version, self.is_behind = part.version, False
            self._last_ids.clear()
        return True

    def _span(self, part: MapSnapshot, ids: np.ndarray) -> tuple[float, float]:
        """Return the first and the last id of the range that one message of a snapshot replaces."""
        if not len(ids):
            return (0, np.inf) if part.parts == 1 else (0, -1)
        follows = part.part == 0 or part.part - 1 in self._last_ids
        first = self._last_ids.get(part.part - 1, -1) + 1 if follows else int(ids[0])
        return first, np.inf if part.part == part.parts - 1 else int(ids[-1])

    def _note_exposures(self, part: MapSnapshot) -> None:
        if part.part == 0 and part.version >= self.version:
            exposures = part.exposures.numpy().copy()
            self._exposures = dict(zip(part.keyframes.numpy().tolist(), exposures, strict=True))
