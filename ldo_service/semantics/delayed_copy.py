"""Copy of the labels and objects of a map, which waits for label results.

The copy processes each keyframe after the map, as soon as the results of all earlier label requests
have arrived; see `ordered_semantics`.
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

from .object_landmarks import LANDMARK, NO_MEMBER
from .objects import Objects
from .semantic_map import SemanticMap


@dataclass(eq=False, slots=True)
class DelayedCopy:
    """Copy of a map's labels and objects, which processes each keyframe later than the map.

    It waits until the results of all earlier label requests to the labeller have arrived.

    Attributes:
        semantics: The copied semantics except the labels of the Gaussians.
        labels: The copied labels of the Gaussians.
        first_object: First id of the objects that were created after the copy was made.
        results_due: Regions whose label results come before the next keyframe, in order.
        keyframes: Detections of the keyframes to process, in order.
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
        """Apply one label result or process one keyframe, unless label results are missing.

        Args:
            results: Label results that have arrived, by `request_key` of their requests.

        Returns:
            Regions whose label results must arrive before the next call.
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
            "labels": [self.labels.ids, self.labels.labels, self.labels.next_id],
            "first_object": self.first_object,
            "results_due": [pack(region) for region in self.results_due],
            "keyframes": [
                (k, found.pack() if found else []) for k, found in self.keyframes.items()
            ],
        }

    @staticmethod
    def restored(state: Mapping[str, Any], semantics: SemanticMap) -> "DelayedCopy":
        """Return the `DelayedCopy` whose state `snapshot` returned.

        Args:
            state: The result of `snapshot`.
            semantics: Semantics that have already been restored.
        """
        keyframes = {
            keyframe: RegionDetections(*arrays) if arrays else None
            for keyframe, arrays in state["keyframes"]
        }
        due = [unpack(row) for row in state["results_due"]]
        labels = GaussianLabels(*state["labels"])
        return DelayedCopy(semantics, labels, state["first_object"], due, keyframes)


@dataclass(eq=False, slots=True)
class GaussianLabels:
    """Labels of Gaussians that are stored apart from the map.

    Attributes:
        ids: Ids of the Gaussians, [N], ascending.
        labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
        next_id: Lower bound of the ids of Gaussians that were created later.
    """

    ids: np.ndarray
    labels: np.ndarray
    next_id: int

    @staticmethod
    def of(gaussians: GaussianMap) -> "GaussianLabels":
        """Copy the labels of those Gaussians of a map that are in memory."""
        return GaussianLabels(gaussians.ids.copy(), gaussians.labels.copy(), gaussians.next_id)

    @contextmanager
    def in_map(self, gaussians: GaussianMap) -> Iterator[None]:
        """Replace the labels of a map by these labels until the context ends.

        At the end, changes of the labels are stored here and the map gets its own labels back. No
        Gaussian may be added to the map, removed or loaded from disk in the meantime.
        """
        shown, ids = gaussians.labels.copy(), gaussians.ids.copy()
        gaussians.labels[:] = self._of(gaussians)
        try:
            yield
            absent = ~np.isin(self.ids, ids, assume_unique=True)
            all_ids = np.concatenate([ids, self.ids[absent]])
            order = np.argsort(all_ids)
            self.labels = np.concatenate([gaussians.labels, self.labels[absent]])[order]
            self.ids = all_ids[order]
        finally:
            gaussians.labels[:] = shown

    def write(self, gaussians: GaussianMap) -> np.ndarray:
        """Write the labels into a map, and return the rows that changed.

        Offloaded Gaussians keep the labels that they have on disk.
        """
        labels = self._of(gaussians)
        changed = np.flatnonzero(np.any(labels != gaussians.labels, axis=1))
        gaussians.labels[:] = labels
        return changed

    def _of(self, gaussians: GaussianMap) -> np.ndarray:
        """Return the label rows of the N Gaussians of a map that are in memory, [N, 32] uint8.

        A Gaussian that is newer than this copy gets no label. A Gaussian that was on disk when the
        copy was made keeps its label in the map.
        """
        labels, ids = gaussians.labels.copy(), gaussians.ids
        if len(self.ids) == 0:
            labels[ids >= self.next_id] = 0
            return labels
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        is_known = self.ids[at] == ids
        labels[ids >= self.next_id] = 0
        labels[is_known] = self.labels[at[is_known]]
        return labels


def request_key(region: Region) -> bytes:
    """Return a digest of the whole content of a label request except the id of the region."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(repr((region.keyframe, region.box_px, region.label, region.score)).encode())
    for view in region.views:
        digest.update(view.jpeg)
    return digest.digest()


def renumbered(objects: Objects, before: Objects, first_new: int) -> Objects:
    """Return the objects of a `DelayedCopy` with the ids that the map already shows.

    Objects that are new in the copy are matched with objects that are new in the map, so that the
    matched objects have the most Gaussians in common. A matched object gets the id in the map;
    another new object gets an unused id.

    Args:
        objects: Objects of the copy.
        before: Objects that the map shows.
        first_new: First id that was unused when the copy was made.
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
    """Return the id of the next new object."""
    return int(objects.pack()["counts"][0])


def common_members(members: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the numbers of common members of K and R landmarks, [K, R].

    The members of a landmark are a sample of its Gaussians.

    Args:
        members: Ids of the members, [K, 256]; NO_MEMBER where unused.
        others: The same, [R, 256].
    """
    shared = [
        [np.count_nonzero(np.isin(one[one != NO_MEMBER], other)) for other in others]
        for one in members
    ]
    return np.array(shared, np.int64).reshape(len(members), len(others))
