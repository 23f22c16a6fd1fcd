"""A copy of the mapper's map, kept from its messages."""

import numpy as np

from ldo_service.conversions.poses import transform
from ldo_service.gaussians.model import GaussianMap
from ldo_service.schemas import MapDelta, MapSnapshot

from .messages import piece_of

NEUTRAL = np.array([[1, 1, 1], [0, 0, 0]], np.float32)


class MapFollower:
    """Feed it every map/delta and map/snapshot; `map` is equal to the mapper's at `version`, and
    `label_names` says what its labels are, by index.

    A missed delta is noticed (`is_behind`), and the next complete snapshot puts it right.
    """

    def __init__(self) -> None:
        self._parts: dict[int, MapSnapshot] = {}
        self._begin()

    def _begin(self) -> None:
        self.map = GaussianMap()
        self.version = 0
        self.is_behind = False
        self.label_names: tuple[str, ...] = ()
        self._exposures: dict[int, np.ndarray] = {}
        self._parts.clear()

    def exposure(self, keyframe: int) -> np.ndarray:
        """Gains and biases [2, 3] of a keyframe's camera, as of the last snapshot; 1 and 0 for one
        that it did not name."""
        return self._exposures.get(keyframe, NEUTRAL)

    def take(self, message: MapDelta | MapSnapshot) -> bool:
        """Whether `map` changed."""
        if isinstance(message, MapSnapshot):
            return self._take_part(message)
        if message.since == 0 and self.version:
            self._begin()  # the mapper began anew
        if message.version <= self.version:
            return False
        if message.since != self.version:
            self.is_behind = True
            return False
        self._apply(message)
        return True

    def _apply(self, delta: MapDelta) -> None:
        if delta.motions:
            self.map.move_anchors({m.keyframe: transform(m.T_new_old) for m in delta.motions})
        if delta.removed.shape[0]:
            self.map.remove(np.isin(self.map.ids, delta.removed.numpy()))
        if delta.changed.ids.shape[0]:
            changed = piece_of(delta.changed)
            where = np.searchsorted(self.map.ids, changed.ids)
            self.map.rows[where], self.map.labels[where] = changed.rows, changed.labels
            self.map.touch(where.astype(np.uint32))
        self.map.append(*piece_of(delta.added))
        self.label_names = delta.label_names or self.label_names
        self.version = delta.version

    def _take_part(self, part: MapSnapshot) -> bool:
        if part.part == 0 and part.version >= self.version:
            exposures = part.exposures.numpy().copy()
            self._exposures = dict(zip(part.keyframes.numpy().tolist(), exposures, strict=True))
        if part.version < self.version or (part.version == self.version and not self.is_behind):
            return False
        if any(other.version != part.version for other in self._parts.values()):
            self._parts.clear()
        self._parts[part.part] = part
        if len(self._parts) < part.parts:
            return False
        self.map = GaussianMap()
        for number in range(part.parts):
            self.map.append(*piece_of(self._parts[number].gaussians))
        self.label_names = self._parts[0].label_names
        self.version, self.is_behind = part.version, False
        self._parts.clear()
        return True
