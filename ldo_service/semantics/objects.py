"""The objects of the map: how they come, are recognised, become one, and go (paper, III.C)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3

from .data_association import (
    AssociationConfig,
    AssociationCosts,
    MapView,
    PredictedBoxes,
    RegionStatistics,
    associate,
    association_costs,
    compute_region_statistics,
    merge_parts,
    predict_boxes,
)
from .distributions import divergence, entropy
from .gaussian_labels import BACKGROUND
from .object_landmarks import (
    LANDMARK,
    NO_MEMBER,
    derive,
    distributions,
    entropies,
    joined,
    labels_of,
    moved,
    new_landmarks,
    within,
)
from .observations import (
    add_views,
    boxes_overlap,
    inside,
    merge_into,
    neighbors,
    one_each,
    update_votes,
)

CANDIDATE = -1  # in place of an id
_AT_A_TIME = 128  # landmarks that are derived together, to stay in cache


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    association: AssociationConfig = field(default_factory=AssociationConfig)
    min_keyframes: int = 3  # that see it, until it is an object (III.C)
    max_divergence: float = 0.2  # nats, of what they see from what was known (III.C)
    miss_limit: int = 10  # keyframes in a row, while it is visible (III.C)
    uncertain_miss_limit: int = 5  # of objects with more than
    uncertain_entropy: float = 0.5  # nats: these go earlier (III.C)
    candidate_miss_limit: int = 3  # nothing is lost with a candidate: it may come again
    min_visible: float = 0.5  # share of its members in view and not hidden, to be missed
    min_side_px: float = 20.0  # of its box; smaller ones are nobody's fault
    merge_overlap: float = 0.5  # share of the members of one in the box of the other
    max_objects: int = 2000  # 6 MB, and some ms per keyframe where all are in view
    max_candidates: int = 256  # those seen last

    def __post_init__(self) -> None:
        counts = (
            *("min_keyframes", "miss_limit", "uncertain_miss_limit"),
            *("candidate_miss_limit", "max_objects", "max_candidates"),
        )
        if min(getattr(self, name) for name in counts) < 1:
            raise ConfigError(named(self, *counts) + ": each must be at least 1.")
        if min(self.max_divergence, self.uncertain_entropy) < 0:
            raise ConfigError(
                named(self, "max_divergence", "uncertain_entropy") + ": each must be at least 0."
            )
        if not (0 < self.min_visible <= 1 and 0 < self.merge_overlap <= 1):
            raise ConfigError(
                named(self, "min_visible", "merge_overlap")
                + ": min_visible and merge_overlap must be in (0, 1]."
            )


@dataclass(frozen=True, eq=False, slots=True)
class ObjectSighting:
    """An object in a keyframe: the box that shows it, or where one was missed.

    box [4] px, x0 y0 x1 y1; distribution [C] and entropy (nats) of the Gaussians in its region, of
    the object itself where it was missed
    """

    object: int
    box: np.ndarray
    distribution: np.ndarray
    entropy: float
    is_miss: bool


@dataclass(frozen=True, slots=True)
class ObjectUpdate:
    """What a keyframe made of the objects: ids that came, that went, and that became another."""

    observations: tuple[ObjectSighting, ...] = ()
    born: tuple[int, ...] = ()
    merged: tuple[tuple[int, int], ...] = ()  # this one is that one now
    retired: tuple[int, ...] = ()


class Objects:
    """All landmarks. Not for two threads at once; the same calls give the same bits, also after
    `unpack`. An id is given once, and is its object's until that is merged or retired."""

    def __init__(self, config: ObjectsConfig | None = None) -> None:
        self.config = config or ObjectsConfig()
        self._table = np.zeros(0, LANDMARK)
        self._next_id = self._merged = self._retired = self._refused = 0

    def __len__(self) -> int:
        return int(np.count_nonzero(self._table["id"] != CANDIDATE))

    @property
    def landmarks(self) -> np.ndarray:
        """A copy of the objects, records [K] of `LANDMARK`, by id."""
        table = self._table[self._table["id"] != CANDIDATE]
        return table[np.argsort(table["id"])]

    def observe(self, view: MapView, spared: np.ndarray | None = None) -> ObjectUpdate:
        """Take in what a keyframe shows. `spared` [256] bool: labels that the detector does not
        know, and cannot miss unless their place is empty.

        A region that no landmark is associated with begins a candidate. It becomes an object when
        it was seen in min_keyframes, and each time KL(p || p_t) < max_divergence: p is what its
        Gaussians were said to be before, p_t what those in the region are said to be now, both
        means weighted by opacity. A keyframe that disagrees begins the count anew. Objects are
        associated first, candidates with the regions that are left.

        Raises ValueError for arrays that do not fit.
        """
        T_camera_map = se3.inverse(view.T_map_camera)
        limits = self.config.association
        # what is there, and what should be
        view, regions = _seen(view, T_camera_map, limits)
        near = np.flatnonzero(within(self._table, view.camera, T_camera_map))
        looks = predict_boxes(self._table[near], view, T_camera_map, limits)
        # which is which
        pairs = association_costs(distributions(self._table[near]), looks, regions, limits)
        k, r = self._match(near, pairs)
        excused, left = self._pieces(near, k, pairs, regions, r)
        # what is learnt of those seen, and of those not
        observations = self._update(view, near[k], r, looks.rows[k], looks.shown[k], regions)
        missed = self._missed(near, looks, excused, spared)
        observations += self._miss(near[missed], looks.boxes[missed])
        # who comes, who is another, who goes
        born = self._promote(near[k])
        merged, gone = self._merge(view, near, near[k])
        retired = self._retire(gone)
        self._begin(view, regions, left)
        return ObjectUpdate(tuple(observations), born, merged, retired)

    # --- association ------------------------------------------------------------------------------
    def _match(self, near: np.ndarray, pairs: AssociationCosts) -> tuple[np.ndarray, np.ndarray]:
        """Landmarks, as numbers in `near`, and the regions that show them."""
        is_object = (self._table["id"][near] != CANDIDATE)[:, None]
        allowed, least = pairs.allowed.copy(), self.config.association.min_iou
        k, r = associate(pairs.iou, allowed & is_object, least)
        allowed[:, r] = False
        others, left = associate(pairs.iou, allowed & ~is_object, least)
        return np.concatenate([k, others]), np.concatenate([r, left])

    def _pieces(
        self,
        near: np.ndarray,
        k: np.ndarray,
        pairs: AssociationCosts,
        regions: RegionStatistics,
        r: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Which landmarks near are not missed, [K] bool, since they were matched or a region shows
        a piece of them, and the regions that are neither matched nor such pieces."""
        excused, is_left = np.zeros(len(near), bool), np.ones(len(regions.numbers), bool)
        excused[k], is_left[r] = True, False
        for row, region in np.argwhere(pairs.allowed & ~excused[:, None] & is_left):
            valid = regions.members[region] != NO_MEMBER
            share = inside(self._table[near[row]], regions.p_map[region][valid])
            if share >= self.config.merge_overlap:
                excused[row], is_left[region] = True, False
        return excused, np.flatnonzero(is_left)

    # --- those seen -------------------------------------------------------------------------------
    def _update(
        self,
        view: MapView,
        which: np.ndarray,
        r: np.ndarray,
        rows: np.ndarray,
        shown: np.ndarray,
        regions: RegionStatistics,
    ) -> list[ObjectSighting]:
        seen, p_seen = self._table[which], regions.distributions[r]
        differs = divergence(distributions(seen), p_seen) >= self.config.max_divergence
        begins = differs & (seen["id"] == CANDIDATE)
        seen["votes"] = update_votes(seen["votes"], rows, view, regions.numbers[r])
        seen["members"], seen["votes"] = joined(
            seen["members"], seen["votes"], regions.members[r], one_each(regions.members[r])
        )
        seen["seen"] = np.where(begins, 1, seen["seen"] + 1)
        seen["first"] = np.where(begins, view.keyframe, seen["first"])
        seen["misses"], seen["last"] = 0, view.keyframe
        add_views(seen, view.keyframe, shown, regions.boxes[r])
        self._derive(seen, view.rows, view.labels, view.ids, view.anchors)
        self._table[which] = seen
        entropies_seen = entropy(p_seen)
        return [
            ObjectSighting(
                int(seen["id"][i]), regions.boxes[r[i]], p_seen[i], entropies_seen[i], False
            )
            for i in np.flatnonzero(seen["id"] != CANDIDATE)
        ]

    def _derive(self, table: np.ndarray, *gaussians: np.ndarray) -> None:
        """As far as enough of their Gaussians are awake; `gaussians`: see `landmarks.derive`."""
        for start in range(0, len(table), _AT_A_TIME):
            derive(
                table[start : start + _AT_A_TIME],
                *gaussians,
                least=self.config.association.min_gaussians,
            )

    def _promote(self, which: np.ndarray) -> tuple[int, ...]:
        """Ids of candidates that became objects."""
        seen = self._table[which]
        ready = (seen["id"] == CANDIDATE) & (seen["seen"] >= self.config.min_keyframes)
        ready = which[ready & (seen["labels"][:, 0] != BACKGROUND)]
        room = max(0, self.config.max_objects - len(self))
        self._refused += len(ready[room:])
        ids = self._next_id + np.arange(len(ready[:room]))
        self._table["id"][ready[:room]] = ids
        self._next_id += len(ids)
        return tuple(ids.tolist())

    # --- those not seen ---------------------------------------------------------------------------
    def _missed(
        self,
        near: np.ndarray,
        looks: PredictedBoxes,
        excused: np.ndarray,
        spared: np.ndarray | None,
    ) -> np.ndarray:
        """Numbers of those near that a detector should have seen, or whose place is empty."""
        sides = np.clip(looks.boxes[:, 2:] - looks.boxes[:, :2], 0, None)
        is_large = np.sqrt(np.prod(sides, axis=1)) >= self.config.min_side_px
        is_visible = (looks.shown >= self.config.min_visible) & is_large
        if spared is not None:
            is_visible &= ~spared[labels_of(self._table[near])]
        return np.flatnonzero((is_visible | (looks.through >= self.config.min_visible)) & ~excused)

    def _miss(self, which: np.ndarray, boxes: np.ndarray) -> list[ObjectSighting]:
        for name in ("missed", "misses"):
            self._table[name][which] += 1
        missed = self._table[which]
        p = distributions(missed)
        return [
            ObjectSighting(int(missed["id"][i]), boxes[i], p[i], float(entropy(p[i])), True)
            for i in np.flatnonzero(missed["id"] != CANDIDATE)
        ]

    def _retire(self, gone: np.ndarray) -> tuple[int, ...]:
        """Ids of those missed too often. Drops them, and those that are `gone` [K] bool."""
        table, config = self._table, self.config
        missed = np.flatnonzero((table["misses"] > 0) & ~gone)
        is_unsure = entropies(table[missed]) > config.uncertain_entropy
        limit = np.where(is_unsure, config.uncertain_miss_limit, config.miss_limit)
        is_candidate = table["id"][missed] == CANDIDATE
        limit = np.where(is_candidate, config.candidate_miss_limit, limit)
        over = missed[table["misses"][missed] >= limit]
        retired = np.sort(table["id"][over][table["id"][over] != CANDIDATE])
        self._retired += len(retired)
        gone[over] = True
        if np.any(gone):
            self._table = table[~gone]
        return tuple(retired.tolist())

    # --- those that are one -----------------------------------------------------------------------
    def _merge(
        self, view: MapView, near: np.ndarray, matched: np.ndarray
    ) -> tuple[tuple[tuple[int, int], ...], np.ndarray]:
        """Objects that became another, and which landmarks [K] bool did: see `merging`."""
        merged: list[tuple[int, int]] = []
        gone = np.zeros(len(self._table), bool)
        for a, b in neighbors(self._table, near, matched):
            one, other = self._table[[a]], self._table[[b]]
            if gone[a] or gone[b] or not boxes_overlap(one, other, view, self.config.merge_overlap):
                continue
            keep, goes = (a, b) if self._age(a) < self._age(b) else (b, a)
            self._join(keep, goes, view)
            gone[goes] = True
            if self._table["id"][goes] != CANDIDATE:
                merged.append((int(self._table["id"][goes]), int(self._table["id"][keep])))
        self._merged += len(merged)
        return tuple(merged), gone

    def _age(self, k: int) -> tuple[bool, int, int]:
        """By which objects come before candidates, then the first."""
        return self._table["id"][k] == CANDIDATE, int(self._table["id"][k]), k

    def _join(self, keep: int, goes: int, view: MapView) -> None:
        one = self._table[[keep]]
        merge_into(one, self._table[[goes]])
        self._derive(one, view.rows, view.labels, view.ids, view.anchors)
        self._table[[keep]] = one

    # --- those that come --------------------------------------------------------------------------
    def _begin(self, view: MapView, regions: RegionStatistics, left: np.ndarray) -> None:
        """A candidate of each region that is left; of too many those seen longest ago go."""
        new = new_landmarks(len(left), view.keyframe)
        new["members"], new["seen"] = regions.members[left], 1
        new["votes"] = one_each(new["members"])
        add_views(new, view.keyframe, np.ones(len(left)), regions.boxes[left])
        self._derive(new, view.rows, view.labels, view.ids, view.anchors)
        if len(new):
            self._table = np.concatenate([self._table, new])
        candidates = np.flatnonzero(self._table["id"] == CANDIDATE)
        excess = len(candidates) - self.config.max_candidates
        if excess > 0:
            oldest = np.argsort(self._table["last"][candidates], kind="stable")[:excess]
            self._table = np.delete(self._table, candidates[oldest])

    # --- corrections ------------------------------------------------------------------------------
    def move(self, T_new_old: Mapping[int, np.ndarray]) -> None:
        """Keyframes were corrected: each landmark goes with the one that most of its members hang
        on, so that those asleep are where their Gaussians will wake. `refresh` has the others."""
        corrected = np.array(sorted(T_new_old), np.int64)
        which = np.flatnonzero(np.isin(self._table["anchor"], corrected))
        if len(which):
            table = self._table[which]
            moved(table, np.stack([T_new_old[int(k)] for k in table["anchor"]]))
            self._table[which] = table

    def refresh(
        self,
        rows: np.ndarray,
        labels: np.ndarray,
        ids: np.ndarray,
        anchors: np.ndarray,
        seen_from: tuple[Camera, np.ndarray] | None = None,
    ) -> None:
        """Derive landmarks anew from the map, after corrections, late labels and refinement: all,
        or those in the view of a camera at T_map_camera."""
        which = np.arange(len(self._table))
        if seen_from:
            camera, T_map_camera = seen_from
            which = np.flatnonzero(within(self._table, camera, se3.inverse(T_map_camera)))
        table = self._table[which]
        self._derive(table, rows, labels, ids, anchors)
        self._table[which] = table

    # --- state ------------------------------------------------------------------------------------
    def pack(self) -> dict[str, Any]:
        """Arrays and plain numbers, for a file or a state."""
        table = self._table.copy().view(np.uint8).reshape(len(self._table), LANDMARK.itemsize)
        counts = [self._next_id, self._merged, self._retired, self._refused]
        return {"landmarks": table, "counts": np.array(counts, np.int64)}

    @staticmethod
    def unpack(packed: Mapping[str, Any], config: ObjectsConfig | None = None) -> "Objects":
        """As it was. Raises ValueError when this is not what `pack` gave."""
        table = np.ascontiguousarray(packed["landmarks"])
        if table.dtype != np.uint8 or table.ndim != 2 or table.shape[1] != LANDMARK.itemsize:
            raise ValueError(f"landmarks {table.dtype}{table.shape} are not of this version.")
        out = Objects(config)
        out._table = table.copy().view(LANDMARK)[:, 0]
        out._next_id, out._merged, out._retired, out._refused = map(int, packed["counts"])
        return out

    def metrics(self) -> dict[str, float]:
        return {
            "objects": len(self),
            "object_candidates": len(self._table) - len(self),
            "objects_merged": self._merged,
            "objects_retired": self._retired,
            "objects_rejected": self._refused,  # there are max_objects
        }


def _seen(
    view: MapView, T_camera_map: np.ndarray, config: AssociationConfig
) -> tuple[MapView, RegionStatistics]:
    """What a keyframe shows of things, not of their parts."""
    regions = compute_region_statistics(view, T_camera_map, config)
    whole = merge_parts(view, regions, config)
    return whole, regions if whole is view else compute_region_statistics(
        whole, T_camera_map, config
    )
