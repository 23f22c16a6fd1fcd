"""Copy of the labels and objects of a map that waits for the results of the labeller.

The map processes a keyframe at once. The copy processes the same keyframe later: after the results
of all earlier label requests have arrived. See `ordered_semantics`.
"""

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from ldo_service.gaussians.model import GaussianMap
from ldo_service.regions.foreground import RegionDetections
from ldo_service.regions.region import Region, RegionLabelResult, pack, unpack

from .gaussian_labels import ROW
from .object_landmarks import LANDMARK, NO_MEMBER
from .objects import Objects
from .semantic_map import SemanticMap


@dataclass(eq=False, slots=True)
class DelayedCopy:
    """Copy of the labels and objects of a map that processes each keyframe later than the map.

    The copy processes a keyframe after the results of all earlier label requests have arrived.

    Attributes:
        semantics: The copied semantics except the labels of the Gaussians.
        labels: The copied labels of the Gaussians.
        first_object: Minimum id of objects that were created after the copy was made.
        results_due: Regions whose label results must be applied before the next keyframe, in order.
        keyframes: Detections of the keyframes to process, by keyframe id, in order.
    """

    semantics: SemanticMap
    labels: "GaussianLabels"
    first_object: int
    results_due: list[Region]
    keyframes: dict[int, RegionDetections | None] = field(default_factory=dict)

    def keyframes_of_step(self) -> list[int]:
        """Return the keyframes whose images the next call of `step` needs."""
        naming = self.semantics.naming
        if not self.results_due or naming is None:
            return list(self.keyframes)[:1]
        region = self.results_due[0]
        return [region.keyframe, *naming.shown_in(region.id)]

    def step(self, results: Mapping[bytes, RegionLabelResult]) -> list[Region]:
        """Apply the next label result or process the next keyframe.

        The method does nothing while a label result that it needs has not arrived.

        Args:
            results: Label results that have arrived, by `request_key` of their requests.

        Returns:
            Regions whose label results have not arrived but are needed by the next call.
        """
        missing = [one for one in self.results_due if request_key(one) not in results]
        if missing:
            return missing
        if self.results_due:
            region = self.results_due.pop(0)
            self.semantics.apply_label(region.id, region.keyframe, results[request_key(region)])
        elif self.keyframes:
            keyframe = next(iter(self.keyframes))
            fused = self.semantics.add_detections(keyframe, self.keyframes.pop(keyframe))
            self.results_due = list(fused.requested) if fused else []
        return [one for one in self.results_due if request_key(one) not in results]

    def snapshot(self) -> dict[str, Any]:
        """Return the state as plain values and arrays."""
        return {
            "semantics": self.semantics.snapshot(),
            "labels": [*self.labels.all(), self.labels.next_id],
            "first_object": self.first_object,
            "results_due": [pack(region) for region in self.results_due],
            "keyframes": [
                (k, found.pack() if found else []) for k, found in self.keyframes.items()
            ],
        }

    @staticmethod
    def restored(state: Mapping[str, Any], semantics: SemanticMap) -> "DelayedCopy":
        """Return a `DelayedCopy` with the state that `snapshot` returned.

        Args:
            state: The result of `snapshot`.
            semantics: Semantics of the copy, already restored from `state["semantics"]`.
        """
        keyframes = {
            keyframe: RegionDetections(*arrays) if arrays else None
            for keyframe, arrays in state["keyframes"]
        }
        due = [unpack(row) for row in state["results_due"]]
        labels = GaussianLabels(*state["labels"])
        return DelayedCopy(semantics, labels, state["first_object"], due, keyframes)


def _no_labels() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(0, np.int64), np.zeros((0, ROW.itemsize), np.uint8)


@dataclass(eq=False, slots=True)
class GaussianLabels:
    """Labels of Gaussians that are stored apart from the map.

    Attributes:
        ids: Ids of the Gaussians, [N], ascending.
        labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
        next_id: Minimum id of Gaussians that were created after these labels were stored.
        absent: Ids [M] and label rows [M, 32] of further Gaussians, which were not in memory at the
            end of the last `in_map` block. They are apart, so that the rows of consecutive blocks
            usually fit the map as they are.
    """

    ids: np.ndarray
    labels: np.ndarray
    next_id: int
    absent: tuple[np.ndarray, np.ndarray] = field(default_factory=_no_labels)

    @staticmethod
    def of(gaussians: GaussianMap) -> "GaussianLabels":
        """Copy the labels of those Gaussians of a map that are in memory."""
        return GaussianLabels(gaussians.ids.copy(), gaussians.labels.copy(), gaussians.next_id)

    @contextmanager
    def in_map(self, gaussians: GaussianMap) -> Iterator[None]:
        """Give a map these labels inside a `with` block.

        At the end of the block, this object stores the changed labels, and the map gets its own
        labels back. The block must not add Gaussians to the map, remove them, or load them from
        disk.
        """
        shown = gaussians.labels.copy()
        gaussians.labels[:] = self._of(gaussians)
        try:
            yield
            self._store(gaussians)
        finally:
            gaussians.labels[:] = shown

    def _store(self, gaussians: GaussianMap) -> None:
        """Store the labels of those Gaussians of a map that are in memory."""
        if np.array_equal(self.ids, gaussians.ids):
            self.labels = gaussians.labels.copy()  # A saved state may refer to the old array.
            return
        ids, labels = self.all()
        is_absent = ~np.isin(ids, gaussians.ids, assume_unique=True)
        self.absent = ids[is_absent], labels[is_absent]
        self.ids, self.labels = gaussians.ids.copy(), gaussians.labels.copy()

    def all(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids, ascending, and the label rows of all Gaussians."""
        absent_ids, absent_labels = self.absent
        if len(absent_ids) == 0:
            return self.ids, self.labels
        ids = np.concatenate([self.ids, absent_ids])
        order = np.argsort(ids)
        return ids[order], np.concatenate([self.labels, absent_labels])[order]

    def write(self, gaussians: GaussianMap) -> np.ndarray:
        """Write the labels into a map, and return the indices of the changed rows.

        Gaussians that are on disk instead of in memory keep their labels.
        """
        labels = self._of(gaussians)
        changed = np.flatnonzero(np.any(labels != gaussians.labels, axis=1))
        gaussians.labels[:] = labels
        return changed

    def _of(self, gaussians: GaussianMap) -> np.ndarray:
        """Return the label rows of the N Gaussians of a map that are in memory, [N, 32] uint8.

        A Gaussian that is newer than this copy gets no label. A Gaussian that was on disk when the
        copy was made keeps its label in the map. The caller must not change the returned rows.
        """
        if np.array_equal(self.ids, gaussians.ids):
            return self.labels
        labels, ids = gaussians.labels.copy(), gaussians.ids
        labels[ids >= self.next_id] = 0
        known_ids, known_labels = self.all()
        if len(known_ids):
            at = np.minimum(np.searchsorted(known_ids, ids), len(known_ids) - 1)
            is_known = known_ids[at] == ids
            labels[is_known] = known_labels[at[is_known]]
        return labels


def request_key(region: Region) -> bytes:
    """Return a digest of all contents of a region's label request except the id of the region."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(repr((region.keyframe, region.box_px, region.label, region.score)).encode())
    for view in region.views:
        digest.update(view.jpeg)
    return digest.digest()


def renumbered(objects: Objects, before: Objects, first_new: int) -> Objects:
    """Return the objects of a `DelayedCopy`, with the ids of the same objects in the map.

    An object is new if it was created after the copy was made. New objects of the copy are matched
    with new objects of the map, so that the matched pairs have the most Gaussians in common. A
    matched object gets the id of its match in the map. Any other new object gets an unused id.

    Args:
        objects: Objects of the copy.
        before: Objects of the map.
        first_new: Minimum id of new objects.
    """
    packed, known = objects.pack(), before.pack()
    table = packed["landmarks"].view(LANDMARK)[:, 0]
    others = known["landmarks"].view(LANDMARK)[:, 0]
    new = np.flatnonzero(table["id"] >= first_new)
    others = others[others["id"] >= first_new]
    shared = common_members(table["members"][new], others["members"])
    i, j = linear_sum_assignment(shared, maximize=True)
    is_same = shared[i, j] > 0
    next_id = max(next_id_of(objects), next_id_of(before))
    ids = np.full(len(new), -1, np.int64)
    ids[i[is_same]] = others["id"][j[is_same]]
    ids[ids < 0] = next_id + np.arange(np.count_nonzero(ids < 0))
    table["id"][new] = ids
    counts = np.array([max(next_id, 1 + ids.max(initial=-1)), *known["counts"][1:]], np.int64)
    return Objects.unpack({"landmarks": packed["landmarks"], "counts": counts}, objects.config)


def next_id_of(objects: Objects) -> int:
    """Return the id that the next new object will get."""
    return int(objects.pack()["counts"][0])


def common_members(members: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Count the members that each of K landmarks has in common with each of R others, [K, R].

    The members of a landmark are a sample of its Gaussians.

    Args:
        members: Ids of the members of K landmarks, [K, 256]; NO_MEMBER where unused.
        others: Ids of the members of R landmarks, [R, 256]; NO_MEMBER where unused.
    """
    shared = [
        [np.count_nonzero(np.isin(one[one != NO_MEMBER], other)) for other in others]
        for one in members
    ]
    return np.array(shared, np.int64).reshape(len(members), len(others))
