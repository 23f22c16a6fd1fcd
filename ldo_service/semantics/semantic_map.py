"""Labels of the Gaussians of a map, and the objects of the map."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ldo_service.detection.dynamic_classes import Box, dynamic_class_mask
from ldo_service.detection.vocabulary import LabelSources, Vocabulary
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.renderer import Contributions
from ldo_service.gaussians.training_views import TrainingView
from ldo_service.regions.foreground import RegionDetections
from ldo_service.regions.open_vocabulary import OpenVocabularyLabeling
from ldo_service.regions.region import Region, RegionLabelResult

from .data_association import MapView
from .gaussian_labels import Disagreement, count_labelled
from .objects import Objects
from .observations import KeyframeSemantics
from .semantic_fusion import (
    FusionResult,
    assign_detections,
    fuse_detections,
    reliable_label_mask,
)
from .semantic_map_config import SemanticMapConfig


class SemanticMap:
    """Labels of the Gaussians of a `MapBuilder`, and the objects that these Gaussians form.

    The `MapBuilder` stores the images and the current pose of each keyframe. The detections of a
    keyframe are fused once. Label results of the keyframe's regions are fused when they arrive. The
    same inputs give the same results if the `MapBuilder` is deterministic. Without detections and
    label results, this class does not change the map.
    """

    def __init__(
        self,
        map_: MapBuilder,
        config: SemanticMapConfig | None = None,
        *,
        has_labeller: bool = False,
        threads: int = 1,
        before_fusion: Callable[[], None] = lambda: None,
        changes_map: bool = True,
    ) -> None:
        """Create the semantics of a map.

        Args:
            map_: The map with the Gaussians to label.
            config: Settings.
            has_labeller: True if a labeller receives label requests.
            threads: Number of threads.
            before_fusion: Called before the detections of a keyframe are fused.
            changes_map: If False, only the labels of the map change, and the changes are not
                marked.
        """
        self.config = config or SemanticMapConfig()
        self.vocabulary = Vocabulary(self.config.max_names)
        self.objects = Objects(self.config.objects)
        is_fused = self.config.uses_labeller
        self.naming = (
            OpenVocabularyLabeling(self.config.naming, is_fused=is_fused) if has_labeller else None
        )
        self._map, self._threads = map_, threads
        self._before_fusion, self._changes_map = before_fusion, changes_map
        self._sources = LabelSources()
        self._done: dict[int, None] = {}  # Newest fused keyframes, in the order of fusion.
        # Detections of keyframes that are not mapped yet, the oldest first.
        self._waiting: dict[int, RegionDetections | None] = {}
        self._disagreement = Disagreement(0.0, 0.0)
        self._labelled = 0  # Number of keyframes whose detections were received and fused.
        self._boxes = self._repeated = self._too_early = self._without_images = 0
        self._results_without_images = self._movable = 0

    @property
    def is_used(self) -> bool:
        """True if detections of any keyframe were received."""
        return bool(self._done or self._waiting)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the labels; empty before any detections were received."""
        return self.vocabulary.names if self.is_used else ()

    # --- keyframes --------------------------------------------------------------------------------
    def add_detections(
        self, keyframe: int, detections: RegionDetections | None
    ) -> KeyframeSemantics | None:
        """Fuse the detections of a keyframe, or store them until the keyframe is mapped.

        Repeated detections of a keyframe are dropped and counted.

        Args:
            keyframe: Id of the keyframe.
            detections: Detections; None if no detector ran on the keyframe.

        Returns:
            The result of the fusion; None if nothing was fused.
        """
        if detections is None and self.naming is None:
            return None
        if keyframe in self._done or keyframe in self._waiting:
            self._repeated += 1
        elif keyframe in self._map.views:
            return self._fuse_keyframe(keyframe, detections)
        else:
            self._waiting[keyframe] = detections
            while len(self._waiting) > self.config.max_waiting:
                del self._waiting[next(iter(self._waiting))]
                self._too_early += 1
        return None

    def on_keyframe_mapped(self, keyframe: int) -> KeyframeSemantics | None:
        """Fuse the stored detections of a keyframe that was just mapped.

        Returns:
            The result of the fusion; None if nothing was fused.
        """
        if keyframe not in self._waiting:
            return None
        return self._fuse_keyframe(keyframe, self._waiting.pop(keyframe))

    def _fuse_keyframe(
        self, keyframe: int, found: RegionDetections | None
    ) -> KeyframeSemantics | None:
        """Fuse the detections of a mapped keyframe.

        If the images of the keyframe are no longer stored, the Gaussians in the boxes cannot be
        found. The keyframe is then counted, its detections are dropped, and None is returned.
        """
        self._before_fusion()
        self._done[keyframe] = None
        self._labelled += 1
        while len(self._done) > self.config.max_remembered:
            del self._done[next(iter(self._done))]
        if not self._map.views.is_readable(keyframe):
            self._without_images += 1
            return None
        # Remove dynamic classes.
        received = found
        found = found and self._remove_dynamic(keyframe, found)
        # Find the Gaussians that contribute to the image.
        view, made_by = self._seen(keyframe)
        # Add labels of the labeller and choose label requests.
        detections, requested = self._with_names(
            view, made_by.top, found or RegionDetections.none()
        )
        # Label the Gaussians.
        labelled = self._label(view, made_by.indices, detections, is_late=found is None)
        self._boxes += len(found.boxes) if found else 0
        self._disagreement = labelled.disagreement
        # Update the objects.
        seen = self._map_view(view, made_by.indices, labelled.assigned.regions, detections)
        observed = self.objects.observe(seen, self._sources.undetectable())
        return KeyframeSemantics(keyframe, received, observed, requested)

    def _seen(self, keyframe: int) -> tuple[TrainingView, Contributions]:
        """Return a keyframe with completed depth, and the Gaussians that contribute to its image.

        Where depth is missing, such as on dark surfaces, the depth rendered from the map is used.
        Pixels of the ignore mask have no depth.
        """
        made_by, view = self._map.visible_contributions(keyframe), self._map.views[keyframe]
        in_map_m = self._map.render_keyframe(keyframe).median_depth_m
        depth_m = np.where(view.depth_m > 0, view.depth_m, in_map_m)
        if view.mask is not None:
            depth_m *= view.mask > 0
        return replace(view, depth_m=depth_m), made_by

    def _remove_dynamic(self, keyframe: int, found: RegionDetections) -> RegionDetections:
        """Remove the surface of dynamic classes from the map, and return the other detections."""
        names, sure = self.config.movable.classes, self.config.movable_confidence
        kinds = [self.vocabulary.name(int(label)) for label in found.labels]
        is_movable = np.isin(kinds, names) & (found.confidences >= sure)
        if is_movable.any() and self._changes_map:
            boxes = [Box(kinds[i], *(found.boxes[i] + 0.5)) for i in np.flatnonzero(is_movable)]
            depth_m = self._map.views[keyframe].depth_m
            pixels = dynamic_class_mask(boxes, depth_m, self.config.movable)
            self._movable += self._map.remove_masked(keyframe, pixels)
        return found.where(~is_movable)

    def _with_names(
        self, view: TrainingView, top: np.ndarray, detections: RegionDetections
    ) -> tuple[RegionDetections, tuple[Region, ...]]:
        """Add known labels by the labeller to the detections of a keyframe.

        For `top`, see `reliable_label_mask`.

        Returns:
            The detections with the known labels, and the regions to send to the labeller.
        """
        self._sources.by_detector.update(detections.labels.astype(int).tolist())
        if self.naming is None:
            return detections, ()
        is_labelled = reliable_label_mask(
            self._map.gaussians.labels, top, self.naming.config.reliable
        )
        T_map_keyframe = self._map.views.poses
        detections, requests = self.naming.observe_keyframe(
            view, detections, self.vocabulary, is_labelled, T_map_keyframe
        )
        return detections, tuple(request.region for request in requests)

    def _label(
        self,
        view: TrainingView,
        indices: np.ndarray,
        detections: RegionDetections,
        *,
        is_late: bool = False,
    ) -> FusionResult:
        """Fuse labels of regions into the Gaussians `indices` [V], and mark changed Gaussians."""
        is_labelled = detections.open_confidences > 0
        self._sources.by_labeller.update(detections.open_labels[is_labelled].astype(int).tolist())
        gaussians = self._map.gaussians
        before = gaussians.labels[indices]
        labelled = fuse_detections(
            gaussians.rows,
            gaussians.labels,
            indices,
            view.camera,
            view.T_map_camera,
            view.depth_m,
            detections,
            self.config.labelling,
            is_late=is_late,
            undetectable=self._sources.undetectable(),
            threads=self._threads,
        )
        is_new = np.any(gaussians.labels[indices] != before, axis=1)
        if self._changes_map:
            self._map.mark_relabeled(indices[is_new])
        return labelled

    def _map_view(
        self,
        view: TrainingView,
        indices: np.ndarray,
        regions: np.ndarray,
        detections: RegionDetections,
    ) -> MapView:
        gaussians = self._map.gaussians
        at = view.keyframe, view.camera, view.T_map_camera
        known = gaussians.rows, gaussians.labels, gaussians.ids, gaussians.anchors
        seen = indices, regions, detections.boxes, detections.classes(), view.depth_m
        return MapView(*at, *known, *seen)

    # --- label results ----------------------------------------------------------------------------
    def apply_label(self, region: int, keyframe: int, answer: RegionLabelResult) -> bool:
        """Fuse a label result of the labeller for a region of a keyframe, and update the objects.

        If the images of the keyframe are no longer stored, the Gaussians of the region cannot be
        found, and nothing is fused.

        Returns:
            True if the label was fused.
        """
        detections = self.naming and self.naming.apply_label_result(
            region, keyframe, answer, self.vocabulary
        )
        if detections is None:
            return False
        if not self._map.views.is_readable(keyframe):
            self._results_without_images += 1
            return False
        view, made_by = self._seen(keyframe)
        labelled = self._label(view, made_by.indices, detections, is_late=True)
        self.refresh(view)
        at = self._map_view(view, made_by.indices, labelled.assigned.regions, detections)
        is_undetectable = self._sources.is_labellers(int(detections.open_labels[0]))
        # If the detector found the region, its detections in each keyframe already observe the
        # object.
        if self.config.uses_labeller and (is_undetectable or detections.confidences[0] == 0):
            views = [at, *self._other_views(region, keyframe, is_labelled=is_undetectable)]
            for seen in sorted(views, key=lambda seen: seen.keyframe):
                self.objects.observe(seen, is_late=True)
        return True

    def _other_views(
        self, region: int, labelled_keyframe: int, *, is_labelled: bool
    ) -> list[MapView]:
        """Return map views of a region in the other keyframes that show the region.

        Args:
            region: Id of the region, which has a label.
            labelled_keyframe: Keyframe in which the label was fused already.
            is_labelled: True: fuse the label in these keyframes too. This is meant for labels that
                the detector never gives; other labels were fused with the keyframes' detections.
        """
        assert self.naming is not None
        views = []
        for keyframe in self.naming.shown_in(region):
            if keyframe == labelled_keyframe or not self._map.views.is_readable(keyframe):
                continue
            view, made_by = self._seen(keyframe)
            found = self.naming.propagated(region, view, self.vocabulary, self._map.views.poses)
            if found is None:
                continue
            if is_labelled:
                regions = self._label(view, made_by.indices, found, is_late=True).assigned.regions
                self.refresh(view)
            else:
                regions = self._assign(view, made_by.indices, found)
            views.append(self._map_view(view, made_by.indices, regions, found))
        return views

    def _assign(
        self, view: TrainingView, indices: np.ndarray, detections: RegionDetections
    ) -> np.ndarray:
        """Return the region of each Gaussian in `indices` [V], as [V] int32; no label changes."""
        at = view.camera, view.T_map_camera, view.depth_m, detections, self.config.labelling
        rows = self._map.gaussians.rows
        return assign_detections(rows, indices, *at, threads=self._threads).regions

    def refresh(self, view: TrainingView | None = None) -> None:
        """Derive pose, size and label of objects from their Gaussians again.

        Args:
            view: Keyframe; only objects in its view are derived. None: all objects are derived.
        """
        gaussians = self._map.gaussians
        known = gaussians.rows, gaussians.labels, gaussians.ids, gaussians.anchors
        seen_from = view and (view.camera, view.T_map_camera)
        self.objects.refresh(*known, seen_from=seen_from)

    # --- state ------------------------------------------------------------------------------------
    def adopt(self, other: "SemanticMap", objects: Objects) -> None:
        """Replace the regions and label requests by those of `other`, and the objects by `objects`.

        The counters of this instance do not change.
        """
        assert self.naming is not None
        assert other.naming is not None
        self.objects = objects
        self.naming.adopt(other.naming)
        self._sources = other._sources

    def snapshot(self) -> dict[str, Any]:
        """Return the state, except the labels of the Gaussians, which are a part of the map."""
        return {
            "vocabulary": self.vocabulary.pack(),
            "objects": self.objects.pack(),
            "done": list(self._done),
            "labelled": self._labelled,
            "waiting": [(k, found.pack() if found else []) for k, found in self._waiting.items()],
            "naming": self.naming and self.naming.pack(),
            "given": self._sources.pack(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a state that `snapshot` returned."""
        self.vocabulary = Vocabulary.unpack(state["vocabulary"])
        self.objects = Objects.unpack(state["objects"], self.config.objects)
        self._done, self._labelled = dict.fromkeys(state["done"]), state["labelled"]
        self._waiting = {
            keyframe: RegionDetections(*arrays) if arrays else None
            for keyframe, arrays in state["waiting"]
        }
        self._sources = LabelSources.unpack(state["given"])
        if self.naming and state["naming"]:
            is_fused = self.config.uses_labeller
            self.naming = OpenVocabularyLabeling.unpack(
                state["naming"], self.config.naming, is_fused=is_fused
            )

    def metrics(self) -> dict[str, float]:
        """Return the counters of the semantics.

        The two `label_disagreement` metrics are sums over the Gaussians of the newest labelled
        keyframe; see `gaussian_labels.Disagreement`.
        """
        return {
            # Resident Gaussians only.
            "gaussians_labelled": count_labelled(self._map.gaussians.labels) if self._boxes else 0,
            "keyframes_labelled": self._labelled,
            "boxes": self._boxes,
            "boxes_repeated": self._repeated,  # Messages repeated after a restart.
            "detections_too_early": self._too_early,  # Dropped before their keyframe was mapped.
            # Keyframes with detections, but without stored images.
            "boxes_without_images": self._without_images,
            # Gaussians of dynamic classes that were removed from the map.
            "gaussians_dynamic_removed": self._movable,
            "label_disagreement_literal": self._disagreement.literal,
            "label_disagreement_expected": self._disagreement.expected,
            "label_names": len(self.names),
            "label_names_rejected": self.vocabulary.refused,
            **self.objects.metrics(),
            **(self.naming.metrics() if self.naming else {}),
            # Label results for keyframes without stored images.
            "answers_without_images": self._results_without_images,
        }
