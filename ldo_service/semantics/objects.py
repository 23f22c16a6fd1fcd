"""Objects of the map: creation, association, merge and removal (LDO-SLAM paper, III.C)."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ldo_service.geometry import Camera, se3

from .data_association import (
    AssociationCosts,
    MapView,
    RegionStatistics,
    associate,
    association_costs,
    predict_boxes,
    whole_regions,
)
from .distributions import divergence, entropy
from .gaussian_labels import BACKGROUND
from .object_landmarks import (
    LANDMARK,
    NO_MEMBER,
    derive_in_batches,
    distributions,
    entropies,
    merged_members,
    moved,
    new_landmarks,
    within,
)
from .objects_config import ObjectsConfig
from .observations import (
    ObjectUpdate,
    ObservedObject,
    add_views,
    boxes_overlap,
    find_missed,
    inside,
    merge_into,
    neighbors,
    one_each,
    update_votes,
)

CANDIDATE = -1  # Value of `id` for a landmark that is a candidate.


class Objects:
    """Table of all landmarks: objects and candidates.

    The class is not thread-safe. The same calls give bitwise equal results, even after the table
    was restored by `unpack`. An object keeps its id until the object is removed or merged into
    another object. Ids are never reused.
    """

    def __init__(self, config: ObjectsConfig | None = None) -> None:
        self.config = config or ObjectsConfig()
        self._table = np.zeros(0, LANDMARK)
        self._next_id = self._merged = self._removed = self._refused = 0

    def __len__(self) -> int:
        return int(np.count_nonzero(self._table["id"] != CANDIDATE))

    @property
    def landmarks(self) -> np.ndarray:
        """Copy of the objects without the candidates: records [K] of `LANDMARK`, sorted by id."""
        table = self._table[self._table["id"] != CANDIDATE]
        return table[np.argsort(table["id"])]

    def observe(
        self, view: MapView, undetectable: np.ndarray | None = None, *, is_late: bool = False
    ) -> ObjectUpdate:
        """Update the objects from a keyframe.

        Regions are associated with objects first, and the remaining regions with candidates. A
        region without an associated landmark creates a candidate.

        A candidate becomes an object after `min_keyframes` observations with KL(p || p_t) <
        `max_divergence`. p is the mean label distribution of the candidate's Gaussians before the
        keyframe. p_t is the mean label distribution of the Gaussians in the region. Both means are
        weighted by opacity. An observation with a larger divergence restarts the count.

        Args:
            view: The map and the regions of the keyframe.
            undetectable: Labels that the detector does not know, [256] bool. An object with such a
                label counts as missed only if the measured depth shows that the object is gone.
                None: the detector knows all labels.
            is_late: True if the keyframe was observed before and the view has only regions whose
                labels arrived later. Objects then gain no observation, and no landmark counts as
                missed. A candidate gains an observation only if the keyframe is before its first or
                after its last observation.

        Raises:
            ValueError: If the shapes of the arrays do not fit.
        """
        T_camera_map = se3.inverse(view.T_map_camera)
        limits = self.config.association
        # Observed and predicted regions.
        view, regions = whole_regions(view, T_camera_map, limits)
        near = np.flatnonzero(within(self._table, view.camera, T_camera_map))
        predicted = predict_boxes(self._table[near], view, T_camera_map, limits)
        # Data association.
        pairs = association_costs(distributions(self._table[near]), predicted, regions, limits)
        k, r = self._match(near, pairs)
        excused, left = self._pieces(near, k, pairs, regions, r)
        if is_late:
            is_new = self._lacks(near[k], view.keyframe)
            k, r, excused[:] = k[is_new], r[is_new], True
        # Observations and misses.
        observations = self._update(
            view, near[k], r, predicted.rows[k], predicted.shown[k], regions
        )
        is_missed = find_missed(self._table[near], predicted, undetectable, self.config)
        missed = np.flatnonzero(is_missed & ~excused)
        observations += self._miss(near[missed], predicted.boxes[missed])
        # New, merged and removed objects.
        created = self._promote(near[k])
        merged, gone = self._merge(view, near, near[k])
        removed = self._remove(gone)
        self._begin(view, regions, left)
        return ObjectUpdate(tuple(observations), created, merged, removed)

    # --- association ------------------------------------------------------------------------------
    def _match(self, near: np.ndarray, pairs: AssociationCosts) -> tuple[np.ndarray, np.ndarray]:
        """Match objects with regions, then candidates with the regions that are left.

        Returns:
            Positions in `near` of the matched landmarks, and the region of each.
        """
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
        """Find unmatched regions that show a piece of an unmatched landmark.

        A region is a piece if enough of its Gaussians lie in the box of the landmark.

        Returns:
            First, which landmarks are matched or have a piece, [K] bool; they do not count as
            missed. Second, the numbers of the regions that are neither matched nor a piece.
        """
        excused, is_left = np.zeros(len(near), bool), np.ones(len(regions.numbers), bool)
        excused[k], is_left[r] = True, False
        for row, region in np.argwhere(pairs.allowed & ~excused[:, None] & is_left):
            valid = regions.members[region] != NO_MEMBER
            share = inside(self._table[near[row]], regions.p_map[region][valid])
            if share >= self.config.merge_overlap:
                excused[row], is_left[region] = True, False
        return excused, np.flatnonzero(is_left)

    # --- observations -----------------------------------------------------------------------------
    def _update(
        self,
        view: MapView,
        which: np.ndarray,
        r: np.ndarray,
        rows: np.ndarray,
        shown: np.ndarray,
        regions: RegionStatistics,
    ) -> list[ObservedObject]:
        seen, p_seen = self._table[which], regions.distributions[r]
        differs = divergence(distributions(seen), p_seen) >= self.config.max_divergence
        begins = differs & (seen["id"] == CANDIDATE)
        seen["votes"] = update_votes(seen["votes"], rows, view, regions.numbers[r])
        seen["members"], seen["votes"] = merged_members(
            seen["members"], seen["votes"], regions.members[r], one_each(regions.members[r])
        )
        seen["seen"] = np.where(begins, 1, seen["seen"] + 1)
        first = np.minimum(seen["first"], view.keyframe)
        seen["first"] = np.where(begins, view.keyframe, first)
        seen["misses"], seen["last"] = 0, np.maximum(seen["last"], view.keyframe)
        add_views(seen, view.keyframe, shown, regions.boxes[r])
        self._derive(seen, view.rows, view.labels, view.ids, view.anchors)
        self._table[which] = seen
        entropies_seen = entropy(p_seen)
        return [
            ObservedObject(
                int(seen["id"][i]), regions.boxes[r[i]], p_seen[i], entropies_seen[i], False
            )
            for i in np.flatnonzero(seen["id"] != CANDIDATE)
        ]

    def _lacks(self, which: np.ndarray, keyframe: int) -> np.ndarray:
        """Return which landmarks are candidates observed only before or only after a keyframe.

        Args:
            which: Rows of the landmarks in the table, [K].
            keyframe: Id of the keyframe.

        Returns:
            [K] bool.
        """
        table = self._table[which]
        is_within = (table["first"] <= keyframe) & (keyframe <= table["last"])
        return (table["id"] == CANDIDATE) & ~is_within

    def _derive(self, table: np.ndarray, *gaussians: np.ndarray) -> None:
        """Derive pose, size and label of landmarks from their Gaussians, in place.

        Landmarks with too few Gaussians in memory stay unchanged.
        """
        derive_in_batches(table, *gaussians, least=self.config.association.min_gaussians)

    def _promote(self, which: np.ndarray) -> tuple[int, ...]:
        """Turn candidates with enough observations and a label into objects; return the ids."""
        seen = self._table[which]
        ready = (seen["id"] == CANDIDATE) & (seen["seen"] >= self.config.min_keyframes)
        ready = which[ready & (seen["labels"][:, 0] != BACKGROUND)]
        room = max(0, self.config.max_objects - len(self))
        self._refused += len(ready[room:])
        ids = self._next_id + np.arange(len(ready[:room]))
        self._table["id"][ready[:room]] = ids
        self._next_id += len(ids)
        return tuple(ids.tolist())

    # --- misses -----------------------------------------------------------------------------------
    def _miss(self, which: np.ndarray, boxes: np.ndarray) -> list[ObservedObject]:
        for name in ("missed", "misses"):
            self._table[name][which] += 1
        missed = self._table[which]
        p = distributions(missed)
        return [
            ObservedObject(int(missed["id"][i]), boxes[i], p[i], float(entropy(p[i])), True)
            for i in np.flatnonzero(missed["id"] != CANDIDATE)
        ]

    def _remove(self, gone: np.ndarray) -> tuple[int, ...]:
        """Remove landmarks with too many misses, and those for which `gone` [K] is True.

        Returns:
            Ids of the objects that were removed after misses.
        """
        table, config = self._table, self.config
        missed = np.flatnonzero((table["misses"] > 0) & ~gone)
        is_unsure = entropies(table[missed]) > config.uncertain_entropy
        limit = np.where(is_unsure, config.uncertain_miss_limit, config.miss_limit)
        is_candidate = table["id"][missed] == CANDIDATE
        limit = np.where(is_candidate, config.candidate_miss_limit, limit)
        over = missed[table["misses"][missed] >= limit]
        removed = np.sort(table["id"][over][table["id"][over] != CANDIDATE])
        self._removed += len(removed)
        gone[over] = True
        if np.any(gone):
            self._table = table[~gone]
        return tuple(removed.tolist())

    # --- merges -----------------------------------------------------------------------------------
    def _merge(
        self, view: MapView, near: np.ndarray, matched: np.ndarray
    ) -> tuple[tuple[tuple[int, int], ...], np.ndarray]:
        """Merge landmarks that overlap; see `observations.boxes_overlap`.

        Returns:
            Pairs of a removed id and the id that it was merged into, and the landmarks that were
            merged into others and must be removed, [K] bool.
        """
        merged: list[tuple[int, int]] = []
        gone = np.zeros(len(self._table), bool)
        for a, b in neighbors(self._table, near, matched):
            one, other = self._table[[a]], self._table[[b]]
            if gone[a] or gone[b] or not boxes_overlap(one, other, view, self.config.merge_overlap):
                continue
            keep, merged_row = (a, b) if self._age(a) < self._age(b) else (b, a)
            self._merge_pair(keep, merged_row, view)
            gone[merged_row] = True
            if self._table["id"][merged_row] != CANDIDATE:
                merged.append((int(self._table["id"][merged_row]), int(self._table["id"][keep])))
        self._merged += len(merged)
        return tuple(merged), gone

    def _age(self, k: int) -> tuple[bool, int, int]:
        """Return a sort key for landmark `k`: objects before candidates, older landmarks first."""
        return self._table["id"][k] == CANDIDATE, int(self._table["id"][k]), k

    def _merge_pair(self, keep: int, merged_row: int, view: MapView) -> None:
        one = self._table[[keep]]
        merge_into(one, self._table[[merged_row]])
        self._derive(one, view.rows, view.labels, view.ids, view.anchors)
        self._table[[keep]] = one

    # --- candidates -------------------------------------------------------------------------------
    def _begin(self, view: MapView, regions: RegionStatistics, left: np.ndarray) -> None:
        """Create a candidate for each region in `left`.

        If there are then more than `max_candidates`, those observed longest ago are dropped.
        """
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
            # Candidates observed longest ago are dropped first. New ones, at the end of the table,
            # are dropped last, because a late label may have an old keyframe.
            is_new = candidates >= len(self._table) - len(new)
            oldest = np.lexsort((self._table["last"][candidates], is_new))[:excess]
            self._table = np.delete(self._table, candidates[oldest])

    # --- corrections ------------------------------------------------------------------------------
    def move(self, T_new_old: Mapping[int, np.ndarray]) -> None:
        """Move the landmarks after a correction of the keyframe poses.

        Each landmark moves with one keyframe: the anchor keyframe of most of its Gaussians.
        A later call of `refresh` derives exact poses for landmarks whose Gaussians are in memory.

        Args:
            T_new_old: Corrections in the map frame, [4, 4], by id of the moved keyframe.
        """
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
        """Derive pose, size and label of landmarks from the map again.

        This is needed after corrections, late label results and optimization of the Gaussians.

        Args:
            rows: Gaussians of the map, [N, 16].
            labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
            ids: Ids of the Gaussians, [N], ascending.
            anchors: Anchor keyframes of the Gaussians, [N].
            seen_from: Camera and its pose T_map_camera, [4, 4]; only landmarks in view of this
                camera are derived. None: all landmarks are derived.
        """
        which = np.arange(len(self._table))
        if seen_from:
            camera, T_map_camera = seen_from
            which = np.flatnonzero(within(self._table, camera, se3.inverse(T_map_camera)))
        table = self._table[which]
        self._derive(table, rows, labels, ids, anchors)
        self._table[which] = table

    # --- state ------------------------------------------------------------------------------------
    def pack(self) -> dict[str, Any]:
        """Return the landmarks and counters as arrays, for a file or a checkpoint."""
        table = self._table.copy().view(np.uint8).reshape(len(self._table), LANDMARK.itemsize)
        counts = [self._next_id, self._merged, self._removed, self._refused]
        return {"landmarks": table, "counts": np.array(counts, np.int64)}

    @staticmethod
    def unpack(packed: Mapping[str, Any], config: ObjectsConfig | None = None) -> "Objects":
        """Restore the objects from the result of `pack`.

        Raises:
            ValueError: If another version wrote the landmarks in another format.
        """
        table = np.ascontiguousarray(packed["landmarks"])
        if table.dtype != np.uint8 or table.ndim != 2 or table.shape[1] != LANDMARK.itemsize:
            raise ValueError(
                f"the array of landmarks is {table.dtype}{table.shape}, but must be uint8[K, "
                f"{LANDMARK.itemsize}]: another version of the service wrote it. Restore it with "
                "that version."
            )
        out = Objects(config)
        out._table = table.copy().view(LANDMARK)[:, 0]
        out._next_id, out._merged, out._removed, out._refused = map(int, packed["counts"])
        return out

    def metrics(self) -> dict[str, float]:
        """Return the counters of the objects."""
        return {
            "objects": len(self),
            "object_candidates": len(self._table) - len(self),
            "objects_merged": self._merged,
            "objects_retired": self._removed,
            "objects_rejected": self._refused,  # Candidates that did not fit into max_objects.
        }
