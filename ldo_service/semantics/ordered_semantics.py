"""Labels and objects of a map, made independent of the arrival times of label results.

A label result labels Gaussians. Later keyframes use these labels for their objects, for the names
of their regions and for the choice of the next label requests. Labels and objects would therefore
depend on the speed of labeller and detector if keyframes were processed only once, on arrival.

The live semantics are the labels and objects that the map shows. They never wait for label results.
When a keyframe arrives while a label result is missing, this module first copies the live
semantics. The copy processes this keyframe and all later keyframes a second time, whenever the
mapper has no message to handle. The copy processes a keyframe only after the results of all earlier
requests have arrived. It requests no result that has already arrived. When the copy has processed
all keyframes, it replaces the live semantics.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.regions.foreground import RegionDetections
from ldo_service.regions.region import Region, RegionLabelResult, pack, unpack

from .delayed_copy import DelayedCopy, GaussianLabels, next_id_of, renumbered, request_key
from .observations import KeyframeSemantics
from .semantic_map import SemanticMap
from .semantic_map_config import SemanticMapConfig

# Maximum number of keyframes that the copy has yet to process, a few kB each. If there are more,
# the copy is dropped and the live semantics stay.
MAX_KEYFRAMES = 1024
# Maximum number of stored label results, about 100 B each. 1024 keyframes request fewer.
MAX_RESULTS = 4096
NOT_LABELLED = RegionLabelResult("", 0.0)
# Offset added to region ids in label requests of the copy. It keeps them apart from the region
# ids in requests of the live semantics.
FIRST_REGION = 1 << 32


class OrderedSemantics:
    """Labels and objects of a map, and a `DelayedCopy` of them that waits for label results.

    The copy processes each keyframe again after the results of all earlier label requests have
    arrived. When the copy has processed all keyframes, it replaces the live semantics.

    Attributes:
        live: The labels and objects that the map shows; they never wait for label results.
    """

    def __init__(
        self,
        map_: MapBuilder,
        config: SemanticMapConfig | None = None,
        *,
        has_labeller: bool = False,
        threads: int = 1,
    ) -> None:
        """Create the semantics of a map; the arguments are those of `SemanticMap`."""
        self._map, self._config = map_, config
        self._options = {"has_labeller": has_labeller, "threads": threads}
        self.live = SemanticMap(map_, config, **self._options, before_fusion=self._before_fusion)
        self._copy: DelayedCopy | None = None
        # Label requests that have not been sent yet, by the region id of the request.
        self._waiting: dict[int, Region] = {}
        # Sent requests without a result, the oldest first.
        self._sent: list[Region] = []
        self._results: dict[bytes, RegionLabelResult] = {}  # Keys are from `request_key`.
        self._replaced = self._abandoned = 0

    # --- live semantics ---------------------------------------------------------------------------
    def add_detections(
        self, keyframe: int, detections: RegionDetections | None
    ) -> KeyframeSemantics | None:
        """Fuse the detections of a keyframe, see `SemanticMap.add_detections`."""
        return self._noted(self.live.add_detections(keyframe, detections))

    def on_keyframe_mapped(self, keyframe: int) -> KeyframeSemantics | None:
        """Fuse the stored detections of a keyframe that was just mapped.

        Returns:
            The result of the fusion; None if no detections were stored for the keyframe.
        """
        return self._noted(self.live.on_keyframe_mapped(keyframe))

    def apply_label(self, region: int, keyframe: int, answer: RegionLabelResult) -> bool:
        """Store a label result for a `DelayedCopy`; fuse it into `live` if `live` requested it.

        The labeller answers in the order of the requests. Earlier requests without a result were
        therefore lost, for example because they ended its process. The `DelayedCopy` counts them as
        not labelled. A lost request is not recognized before a later one is answered.

        Args:
            region: Id of the region in the request.
            keyframe: Keyframe of the request.
            answer: The label result.

        Returns:
            True if the label was fused into `live`.
        """
        places = [
            place
            for place, one in enumerate(self._sent)
            if (one.id, one.keyframe) == (region, keyframe)
        ]
        if places:
            *lost, answered = self._sent[: places[0] + 1]
            del self._sent[: places[0] + 1]
            for one in lost:
                self._store_result(one, NOT_LABELLED)
            self._store_result(answered, answer)
        return region < FIRST_REGION and self.live.apply_label(region, keyframe, answer)

    def _store_result(self, request: Region, answer: RegionLabelResult) -> None:
        if self._copy is not None:
            self._results[request_key(request)] = answer
            while len(self._results) > MAX_RESULTS:
                del self._results[next(iter(self._results))]

    def mark_sent(self, region: int) -> None:
        """Record that the waiting label request of a region was sent."""
        self._sent.append(self._waiting.pop(region))

    def withdraw(self, region: int, keyframe: int, *, is_replaced: bool) -> None:
        """Drop a label request that was not sent; a `DelayedCopy` may make it again.

        Args:
            region: Id of the region in the request.
            keyframe: Keyframe of the request.
            is_replaced: True if a newer request for the region is still to be sent.
        """
        if not is_replaced:
            self._waiting.pop(region, None)
        if self.live.naming is not None and region < FIRST_REGION:
            self.live.naming.withdraw(region, keyframe)

    def move(self, T_new_old: Mapping[int, np.ndarray]) -> None:
        """Move the objects after a correction of keyframe poses, see `Objects.move`."""
        self.live.objects.move(T_new_old)
        if self._copy is not None:
            self._copy.semantics.objects.move(T_new_old)

    def _before_fusion(self) -> None:
        """Copy the live semantics if an earlier label result is missing; called before fusion."""
        pending = [*self._sent, *self._waiting.values()]
        if self._copy is None and pending:
            first_object = next_id_of(self.live.objects)
            labels = GaussianLabels.of(self._map.gaussians)
            semantics = self._new_semantics(self.live.snapshot())
            self._copy = DelayedCopy(semantics, labels, first_object, pending)

    def _new_semantics(self, state: Mapping[str, Any]) -> SemanticMap:
        semantics = SemanticMap(self._map, self._config, **self._options, changes_map=False)
        semantics.restore(state)
        semantics.vocabulary = self.live.vocabulary
        return semantics

    def _noted(self, fused: KeyframeSemantics | None) -> KeyframeSemantics | None:
        """Store the requests of a keyframe, and its detections if a copy needs them."""
        if fused is None:
            return None
        self._wait(fused.requested)
        if self._copy is not None:
            self._copy.keyframes[fused.keyframe] = fused.detections
            if len(self._copy.keyframes) > MAX_KEYFRAMES:
                self._copy = None
                self._results.clear()
                self._abandoned += 1
        return fused

    def _wait(self, requests: Iterable[Region]) -> None:
        for region in requests:
            self._waiting.pop(region.id, None)
            self._waiting[region.id] = region

    # --- copy -------------------------------------------------------------------------------------
    def has_work(self) -> bool:
        """Return whether a `DelayedCopy` exists and has all label results for its next `step`."""
        return self._copy is not None and not self._waiting and not self._sent

    def step(self) -> "OrderedStep":
        """Advance the `DelayedCopy` by one label result or one keyframe.

        The copy applies all label results of earlier keyframes before it processes the next
        keyframe. After the last keyframe, the copy replaces the live semantics.
        """
        copy, gaussians = self._copy, self._map.gaussians
        assert copy is not None
        for keyframe in copy.keyframes_of_step():
            if self._map.views.is_readable(keyframe):
                self._map.load_visible(keyframe)
        with copy.labels.in_map(gaussians):
            missing = copy.step(self._results)
            is_done = not (missing or copy.results_due or copy.keyframes)
            if is_done:
                copy.semantics.refresh()
        requests = [replace(region, id=FIRST_REGION + region.id) for region in missing]
        self._wait(requests)
        if is_done:
            self._replace_live(copy)
        return OrderedStep(tuple(requests), is_done)

    def _replace_live(self, copy: "DelayedCopy") -> None:
        self._map.mark_relabeled(copy.labels.write(self._map.gaussians))
        objects = renumbered(copy.semantics.objects, self.live.objects, copy.first_object)
        self.live.adopt(copy.semantics, objects)
        self._copy = None
        self._results.clear()
        self._replaced += 1

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """Return the state of `live` and of the `DelayedCopy`, without the labels of the map."""
        return {
            **self.live.snapshot(),
            "requests": [
                [pack(region) for region in self._waiting.values()],
                [pack(region) for region in self._sent],
            ],
            "results": [(key, *packed_result(result)) for key, result in self._results.items()],
            "copy": self._copy and self._copy.snapshot(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a state that `snapshot` returned."""
        self.live.restore(state)
        waiting, sent = ([unpack(row) for row in rows] for rows in state["requests"])
        self._waiting, self._sent = {region.id: region for region in waiting}, sent
        self._results = {key: unpacked_result(*values) for key, *values in state["results"]}
        saved = state["copy"]
        self._copy = saved and DelayedCopy.restored(saved, self._new_semantics(saved["semantics"]))

    def metrics(self) -> dict[str, float]:
        """Return the counters of the live semantics and of all copies made so far."""
        return {
            **self.live.metrics(),
            # Keyframes that are still to be processed again, while no message arrives.
            "keyframes_to_relabel": len(self._copy.keyframes) + 1 if self._copy else 0,
            "labels_reordered": self._replaced,
            # Copies that were dropped because they had too many keyframes to process.
            "label_copies_dropped": self._abandoned,
        }


@dataclass(frozen=True, slots=True)
class OrderedStep:
    """Result of `OrderedSemantics.step`."""

    requests: tuple[Region, ...]  # Regions to send to the labeller.
    is_done: bool  # True if the copy has replaced the live semantics.


def packed_result(result: RegionLabelResult) -> Sequence[Any]:
    """Return label, confidence and other labels of a label result, to be saved in a state."""
    return result.label, result.confidence, result.others


def unpacked_result(label: str, confidence: float, others: Sequence[Any]) -> RegionLabelResult:
    """Restore a label result from the values that `packed_result` returned."""
    return RegionLabelResult(label, confidence, tuple((name, sure) for name, sure in others))
