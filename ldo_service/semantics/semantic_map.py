"""What is known of a map beside its shape: the labels of its Gaussians, and its objects."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from ldo_service.detection.dynamic_classes import Box, DynamicClassConfig, dynamic_class_mask
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.renderer import Contributions
from ldo_service.gaussians.training_views import TrainingView
from ldo_service.regions.foreground import RegionDetections
from ldo_service.regions.open_vocabulary import OpenVocabularyConfig, OpenVocabularyLabeling
from ldo_service.regions.region import Region, RegionLabelResult

from .data_association import MapView
from .gaussian_labels import BACKGROUND, MAX_LABELS, Disagreement, top_labels
from .objects import Objects, ObjectsConfig, ObjectUpdate
from .semantic_fusion import (
    FusionResult,
    SemanticFusionConfig,
    fuse_detections,
    reliable_label_mask,
)


@dataclass(frozen=True, slots=True)
class SemanticMapConfig:
    labelling: SemanticFusionConfig = field(default_factory=SemanticFusionConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    naming: OpenVocabularyConfig = field(default_factory=OpenVocabularyConfig)
    movable: DynamicClassConfig = field(default_factory=DynamicClassConfig)
    movable_confidence: float = 0.6  # of the detector: below, it is not relied on elsewhere, and a
    # hole where a picture was taken for a person would be worse than the person
    most_names: int = MAX_LABELS  # of the vocabulary; a later name is `other`
    most_waiting: int = 8  # keyframes whose boxes came before they were mapped: as many as may be
    # on their way to the mapper
    most_said_again: int = 64  # the newest keyframes whose boxes came: after a restart those of a
    # window, 8, come once more

    def __post_init__(self) -> None:
        if self.most_waiting < 0 or self.most_said_again < 1 or self.most_names > MAX_LABELS:
            raise ConfigError(
                named(self, "most_names", "most_waiting", "most_said_again")
                + (f": most_waiting at least 0, most_said_again 1, most_names up to {MAX_LABELS}.")
            )

    @property
    def hears_labeller(self) -> bool:
        return self.labelling.fusion.rule != "detector"


@dataclass(frozen=True, slots=True)
class KeyframeSemantics:
    """What a keyframe told, and which of its regions a labeller is to be asked about."""

    keyframe: int
    observed: ObjectUpdate
    asked: tuple[Region, ...] = ()


class SemanticMap:
    """Labels the Gaussians of a MapBuilder, which keeps what each keyframe measured and where it
    is now, and finds objects among them. What is claimed of a keyframe is folded in once; what a
    labeller says of a part of it, later, when it is said.

    Deterministic as the builder is. Where nothing is ever claimed, the map stays bit for bit as it
    is without this class.
    """

    def __init__(
        self,
        map_: MapBuilder,
        config: SemanticMapConfig | None = None,
        *,
        has_labeller: bool = False,
        threads: int = 1,
    ) -> None:
        """`has_labeller`: there is somebody to be asked for names."""
        self.config = config or SemanticMapConfig()
        self.vocabulary = Vocabulary(self.config.most_names)
        self.objects = Objects(self.config.objects)
        is_heard = self.config.hears_labeller
        self.naming = (
            OpenVocabularyLabeling(self.config.naming, is_heard=is_heard) if has_labeller else None
        )
        self._map, self._threads = map_, threads
        self._by_detector, self._by_labeller = set[int](), set[int]()  # labels they gave
        self._done: dict[int, None] = {}  # the newest keyframes, in order
        self._waiting: dict[
            int, RegionDetections | None
        ] = {}  # by keyframe, the first to come first
        self._disagreement = Disagreement(0.0, 0.0)
        self._labelled = 0  # keyframes
        self._boxes = self._repeated = self._too_early = self._without_images = 0
        self._answers_without_images = self._movable = 0

    @property
    def is_used(self) -> bool:
        """Something was claimed."""
        return bool(self._done or self._waiting)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the labels; none before anything was claimed."""
        return self.vocabulary.names if self.is_used else ()

    # --- keyframes --------------------------------------------------------------------------------
    def add_detections(
        self, keyframe: int, claims: RegionDetections | None
    ) -> KeyframeSemantics | None:
        """What a detector found in a keyframe; None: nobody looked. It waits until the keyframe is
        mapped; said again, it is left out."""
        if claims is None and self.naming is None:
            return None
        if keyframe in self._done or keyframe in self._waiting:
            self._repeated += 1
        elif keyframe in self._map.views:
            return self._fuse_keyframe(keyframe, claims)
        else:
            self._waiting[keyframe] = claims
            while len(self._waiting) > self.config.most_waiting:
                del self._waiting[next(iter(self._waiting))]
                self._too_early += 1
        return None

    def on_keyframe_mapped(self, keyframe: int) -> KeyframeSemantics | None:
        """A keyframe is in the map: learn what waits for it."""
        if keyframe not in self._waiting:
            return None
        return self._fuse_keyframe(keyframe, self._waiting.pop(keyframe))

    def _fuse_keyframe(
        self, keyframe: int, found: RegionDetections | None
    ) -> KeyframeSemantics | None:
        """Its images may be forgotten by now, then nobody can tell what is in the boxes."""
        self._done[keyframe] = None
        self._labelled += 1
        while len(self._done) > self.config.most_said_again:
            del self._done[next(iter(self._done))]
        if not self._map.views.is_readable(keyframe):
            self._without_images += 1
            return None
        # who may walk away
        found = found and self._remove_dynamic(keyframe, found)
        # who makes its image
        view, made_by = self._seen(keyframe)
        # what is said of it, and what is to be asked
        claims, asked = self._with_names(view, made_by.top, found or RegionDetections.none())
        # what they are
        labelled = self._label(view, made_by.indices, claims, is_late=found is None)
        self._boxes += len(found.boxes) if found else 0
        self._disagreement = labelled.disagreement
        # which objects they are
        seen = self._map_view(view, made_by.indices, labelled.assigned.regions, claims)
        return KeyframeSemantics(
            keyframe, self.objects.observe(seen, self._undetectable_labels()), asked
        )

    def _seen(self, keyframe: int) -> tuple[TrainingView, Contributions]:
        """A keyframe, and who makes its image. Where depth is missing, as on what is dark, it is
        the map's, which other keyframes measured; what was left out of the map has none."""
        made_by, view = self._map.visible_contributions(keyframe), self._map.views[keyframe]
        in_map_m = self._map.render_keyframe(keyframe).median_depth_m
        depth_m = np.where(view.depth_m > 0, view.depth_m, in_map_m)
        if view.mask is not None:
            depth_m *= view.mask > 0
        return replace(view, depth_m=depth_m), made_by

    def _remove_dynamic(self, keyframe: int, found: RegionDetections) -> RegionDetections:
        """What may walk away belongs to no map: neither its surface nor its name."""
        names, sure = self.config.movable.classes, self.config.movable_confidence
        said = [self.vocabulary.name(int(label)) for label in found.labels]
        is_movable = np.isin(said, names) & (found.confidences >= sure)
        if is_movable.any():
            boxes = [Box(said[i], *(found.boxes[i] + 0.5)) for i in np.flatnonzero(is_movable)]
            depth_m = self._map.views[keyframe].depth_m
            pixels = dynamic_class_mask(boxes, depth_m, self.config.movable)
            self._movable += self._map.remove_masked(keyframe, pixels)
        return found.where(~is_movable)

    def _with_names(
        self, view: TrainingView, top: np.ndarray, claims: RegionDetections
    ) -> tuple[RegionDetections, tuple[Region, ...]]:
        """With what a labeller said before of what is there; what it is asked now."""
        self._by_detector.update(claims.labels.astype(int).tolist())
        if self.naming is None:
            return claims, ()
        is_labelled = reliable_label_mask(
            self._map.gaussians.labels, top, self.naming.config.reliable
        )
        T_map_keyframe = self._map.views.poses
        claims, questions = self.naming.observe_keyframe(
            view, claims, self.vocabulary, is_labelled, T_map_keyframe
        )
        return claims, tuple(question.region for question in questions)

    def _is_labellers(self, label: int) -> bool:
        """Only the labeller gave it: of such things the detector says nothing."""
        return label in self._by_labeller and label not in self._by_detector

    def _undetectable_labels(self) -> np.ndarray | None:
        """[256] bool, labels that only the labeller gave: a detector cannot miss them."""
        if not self._by_labeller:
            return None
        return np.array([self._is_labellers(label) for label in range(MAX_LABELS)])

    def _label(
        self,
        view: TrainingView,
        indices: np.ndarray,
        claims: RegionDetections,
        *,
        is_late: bool = False,
    ) -> FusionResult:
        is_told = claims.open_confidences > 0
        self._by_labeller.update(claims.open_labels[is_told].astype(int).tolist())
        gaussians = self._map.gaussians
        before = gaussians.labels[indices]
        labelled = fuse_detections(
            gaussians.rows,
            gaussians.labels,
            indices,
            view.camera,
            view.T_map_camera,
            view.depth_m,
            claims,
            self.config.labelling,
            is_late=is_late,
            spared=self._undetectable_labels(),
            threads=self._threads,
        )
        is_new = np.any(gaussians.labels[indices] != before, axis=1)
        self._map.mark_relabeled(indices[is_new])
        return labelled

    def _map_view(
        self, view: TrainingView, indices: np.ndarray, regions: np.ndarray, claims: RegionDetections
    ) -> MapView:
        gaussians = self._map.gaussians
        at = view.keyframe, view.camera, view.T_map_camera
        known = gaussians.rows, gaussians.labels, gaussians.ids, gaussians.anchors
        seen = indices, regions, claims.boxes, claims.classes(), view.depth_m
        return MapView(*at, *known, *seen)

    # --- answers ----------------------------------------------------------------------------------
    def apply_label(self, region: int, keyframe: int, answer: RegionLabelResult) -> bool:
        """What a labeller takes a region for, as that keyframe showed it; whether it was folded in.

        Without the images of the keyframe nobody can tell which Gaussians are meant.
        """
        claims = self.naming and self.naming.apply_label_result(
            region, keyframe, answer, self.vocabulary
        )
        if claims is None:
            return False
        if not self._map.views.is_readable(keyframe):
            self._answers_without_images += 1
            return False
        view, made_by = self._seen(keyframe)
        self._label(view, made_by.indices, claims, is_late=True)
        self.refresh(view)
        if self._is_labellers(int(claims.open_labels[0])):
            self._tell_where_shown(region, keyframe)
        return True

    def _tell_where_shown(self, region: int, told: int) -> None:
        """What a region is, in the other keyframes that the labeller was shown of it. Where it has
        a name of the detector's, this has spoken of it there."""
        assert self.naming is not None
        for keyframe in self.naming.shown_in(region):
            if keyframe == told or not self._map.views.is_readable(keyframe):
                continue
            view, made_by = self._seen(keyframe)
            claims = self.naming.carried(region, view, self.vocabulary, self._map.views.poses)
            if claims is not None:
                self._label(view, made_by.indices, claims, is_late=True)
                self.refresh(view)

    def refresh(self, view: TrainingView | None = None) -> None:
        """Make objects what has become of their Gaussians, or those that a keyframe may show."""
        gaussians = self._map.gaussians
        known = gaussians.rows, gaussians.labels, gaussians.ids, gaussians.anchors
        seen_from = view and (view.camera, view.T_map_camera)
        self.objects.refresh(*known, seen_from=seen_from)

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """All but the labels, which the map has."""
        return {
            "vocabulary": self.vocabulary.pack(),
            "objects": self.objects.pack(),
            "done": list(self._done),
            "labelled": self._labelled,
            "waiting": [(keyframe, _packed(claims)) for keyframe, claims in self._waiting.items()],
            "naming": self.naming and self.naming.pack(),
            "given": [sorted(self._by_detector), sorted(self._by_labeller)],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        self.vocabulary = Vocabulary.unpack(state["vocabulary"])
        self.objects = Objects.unpack(state["objects"], self.config.objects)
        self._done, self._labelled = dict.fromkeys(state["done"]), state["labelled"]
        self._waiting = {
            keyframe: RegionDetections(*arrays) if arrays else None
            for keyframe, arrays in state["waiting"]
        }
        self._by_detector, self._by_labeller = map(set, state["given"])
        if self.naming and state["naming"]:
            is_heard = self.config.hears_labeller
            self.naming = OpenVocabularyLabeling.unpack(
                state["naming"], self.config.naming, is_heard=is_heard
            )

    def metrics(self) -> dict[str, float]:
        """`label_disagreement` is that of the newest keyframe labelled, summed over its Gaussians:
        `_literal` as the paper prints it, `_expected` as it is made smaller."""
        labelled = 0
        if self._boxes:
            labelled = int(np.count_nonzero(top_labels(self._map.gaussians.labels) != BACKGROUND))
        return {
            "gaussians_labelled": labelled,  # of those awake
            "keyframes_labelled": self._labelled,
            "boxes": self._boxes,
            "boxes_repeated": self._repeated,  # messages, said again after a restart
            "detections_too_early": self._too_early,  # Their keyframe came too late.
            "boxes_without_images": self._without_images,  # messages, of keyframes forgotten
            "gaussians_dynamic_removed": self._movable,  # left out again: of what may walk away
            "label_disagreement_literal": self._disagreement.literal,
            "label_disagreement_expected": self._disagreement.expected,
            "label_names": len(self.names),
            "label_names_rejected": self.vocabulary.refused,
            **self.objects.metrics(),
            **(self.naming.metrics() if self.naming else {}),
            "answers_without_images": self._answers_without_images,  # of keyframes forgotten
        }


def _packed(claims: RegionDetections | None) -> list[np.ndarray]:
    """Arrays of a detector's claims; none where nobody looked."""
    names = [f.name for f in fields(RegionDetections) if f.name not in ("parts", "replaces_labels")]
    return [getattr(claims, name) for name in names] if claims else []
