"""A picture of the mapper's map, kept from its messages in bounded memory."""

import numpy as np

from ldo_service.conversions.poses import transform
from ldo_service.gaussians.model import GaussianMap, Piece
from ldo_service.gaussians.pruning import weightiest
from ldo_service.schemas import MapDelta, MapSnapshot

from .messages import piece_of

ROOM = 1.25  # of what is to be kept: what is too much goes when this is full, a lot at a time


class KnownGaussians:
    """Feed it every map/delta and map/snapshot; `rows` are the `most` weightiest or more, by a
    quarter at most.

    Unlike a `MapFollower` it goes on when a message is missed, with what is right and what is not,
    until the next snapshot, of which each part stands for itself: what it does not name between its
    first and its last is gone.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self.begin()

    def begin(self) -> None:
        self._map = GaussianMap()
        self.version = 0
        self.is_behind = False  # something was missed
        self._is_choice = False  # some were left out, and may have become weightier since
        self._next_id = 0  # above all ids that ever came
        self._parts: dict[int, int] = {}  # of a snapshot under way: the last id of each
        self._of_version = 0

    @property
    def rows(self) -> np.ndarray:
        """[N, 16], a view."""
        return self._map.rows

    def take(self, message: MapDelta | MapSnapshot) -> bool:
        """Whether anything changed."""
        if isinstance(message, MapSnapshot):
            changed = self._take_part(message)
        else:
            changed = self._take_delta(message)
        if len(self._map) > ROOM * self._most:
            self._map.remove(~weightiest(self.rows, self._most))
            self._is_choice = True
        return changed

    def _take_delta(self, delta: MapDelta) -> bool:
        if delta.since == 0 and self.version:
            self.begin()  # the mapper began anew
        if delta.version <= self.version:
            return False
        self.is_behind |= delta.since != self.version
        self.version = delta.version
        self._map.move_anchors({m.keyframe: transform(m.T_new_old) for m in delta.motions})
        if delta.removed.shape[0]:
            self._map.remove(np.isin(self._map.ids, delta.removed.numpy()))
        self._change(piece_of(delta.changed))
        self._add(piece_of(delta.added))
        return True

    def _change(self, changed: Piece) -> None:
        """Those that are known: others went, or were missed."""
        if not len(self._map):
            return
        where = np.searchsorted(self._map.ids, changed.ids)
        where = np.minimum(where, len(self._map) - 1)
        known = self._map.ids[where] == changed.ids
        self._map.rows[where[known]] = changed.rows[known]

    def _add(self, added: Piece) -> None:
        """Those that no snapshot brought already."""
        new = added.at(added.ids >= self._next_id)
        self._map.append(new.ids, new.rows, new.anchors)
        self._next_id = max(self._next_id, int(new.ids[-1]) + 1 if len(new.ids) else 0)

    # --- the whole --------------------------------------------------------------------------------
    def _take_part(self, part: MapSnapshot) -> bool:
        is_news = self.is_behind or self._is_choice or part.version > self.version
        if part.version < self.version or not is_news:
            return False
        if part.version != self._of_version:
            self._parts.clear()
            self._of_version = part.version
        piece = piece_of(part.gaussians)
        first, last = self._span(part, piece.ids)
        self._map.remove((self._map.ids >= first) & (self._map.ids <= last))
        old = piece.at(piece.ids < self._next_id)
        self._map.bring_back(old.ids, old.rows, old.anchors)
        self._add(piece)
        self._parts[part.part] = int(piece.ids[-1]) if len(piece.ids) else -1
        if len(self._parts) == part.parts:
            self.version, self.is_behind = part.version, False
            self._parts.clear()
        return True

    def _span(self, part: MapSnapshot, ids: np.ndarray) -> tuple[float, float]:
        """The first and the last id of those that a part speaks of."""
        if not len(ids):
            return (0, np.inf) if part.parts == 1 else (0, -1)
        follows = part.part == 0 or part.part - 1 in self._parts
        first = self._parts.get(part.part - 1, -1) + 1 if follows else int(ids[0])
        return first, np.inf if part.part == part.parts - 1 else int(ids[-1])
