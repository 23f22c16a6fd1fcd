"""What is known of a map beside its shape: the labels of its Gaussians, and its objects."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from ldo_service.detection.dynamic_classes import Box, MovableConfig, movable_pixels
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.renderer import Contributions
from ldo_service.gaussians.training_views import View
from ldo_service.regions.foreground import Claims
from ldo_service.regions.open_vocabulary import Naming, NamingConfig
from ldo_service.regions.region import Answer, Region

from .data_association import MapView
from .gaussian_labels import BACKGROUND, MOST_LABELS, Disagreement, top_labels
from .objects import Objects, ObjectsConfig, Observed
from .semantic_fusion import Labelled, LabellingConfig, label_keyframe, reliable_image


@dataclass(frozen=True, slots=True)
class SemanticMapConfig:
    labelling: LabellingConfig = field(default_factory=LabellingConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    naming: NamingConfig = field(default_factory=NamingConfig)
    movable: MovableConfig = field(default_factory=MovableConfig)
    movable_confidence: float = 0.6  # of the detector: below, it is not relied on elsewhere, and a
    # hole where a picture was taken for a person would be worse than the person
    most_names: int = MOST_LABELS  # of the vocabulary; a later name is `other`
    most_waiting: int = 8  # keyframes whose boxes came before they were mapped: as many as may be
    # on their way to the mapper
    most_said_again: int = 64  # the newest keyframes whose boxes came: after a restart those of a
    # window, 8, come once more

    def __post_init__(self) -> None:
        if self.most_waiting < 0 or self.most_said_again < 1 or self.most_names > MOST_LABELS:
            raise ConfigError(
                named(self, "most_names", "most_waiting", "most_said_again")
                + (f": most_waiting at least 0, most_said_again 1, most_names up to {MOST_LABELS}.")
            )

    @property
    def hears_labeller(self) -> bool:
        return self.labelling.fusion.rule != "detector"


@dataclass(frozen=True, slots=True)
class Learnt:
    """What a keyframe told, and which of its regions a labeller is to be asked about."""

    keyframe: int
    observed: Observed
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
        self.naming = Naming(self.config.naming, is_heard=is_heard) if has_labeller else None
        self._map, self._threads = map_, threads
        self._by_detector, self._by_labeller = set[int](), set[int]()  # labels they gave
        self._done: dict[int, None] = {}  # the newest keyframes, in order
        self._waiting: dict[int, Claims | None] = {}  # by keyframe, the first to come first
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
    def claim(self, keyframe: int, claims: Claims | None) -> Learnt | None:
        """What a detector found in a keyframe; None: nobody looked. It waits until the keyframe is
        mapped; said again, it is left out."""
        if claims is None and self.naming is None:
            return None
        if keyframe in self._done or keyframe in self._waiting:
            self._repeated += 1
        elif keyframe in self._map.views:
            return self._learn(keyframe, claims)
        else:
            self._waiting[keyframe] = claims
            while len(self._waiting) > self.config.most_waiting:
                del self._waiting[next(iter(self._waiting))]
                self._too_early += 1
        return None

    def mapped(self, keyframe: int) -> Learnt | None:
        """A keyframe is in the map: learn what waits for it."""
        if keyframe not in self._waiting:
            return None
        return self._learn(keyframe, self._waiting.pop(keyframe))

    def _learn(self, keyframe: int, found: Claims | None) -> Learnt | None:
        """Its images may be forgotten by now, then nobody can tell what is in the boxes."""
        self._done[keyframe] = None
        self._labelled += 1
        while len(self._done) > self.config.most_said_again:
            del self._done[next(iter(self._done))]
        if not self._map.views.is_readable(keyframe):
            self._without_images += 1
            return None
        # who may walk away
        found = found and self._without_movable(keyframe, found)
        # who makes its image
        view, made_by = self._seen(keyframe)
        # what is said of it, and what is to be asked
        claims, asked = self._with_names(view, made_by.top, found or Claims.none())
        # what they are
        labelled = self._label(view, made_by.indices, claims, is_late=found is None)
        self._boxes += len(found.boxes) if found else 0
        self._disagreement = labelled.disagreement
        # which objects they are
        seen = self._map_view(view, made_by.indices, labelled.assigned.regions, claims)
        return Learnt(keyframe, self.objects.observe(seen, self._spared()), asked)

    def _seen(self, keyframe: int) -> tuple[View, Contributions]:
        """A keyframe, and who makes its image. Where depth is missing, as on what is dark, it is
        the map's, which other keyframes measured; what was left out of the map has none."""
        made_by, view = self._map.made_by(keyframe), self._map.views[keyframe]
        in_map_m = self._map.shown(keyframe).median_depth_m
        depth_m = np.where(view.depth_m > 0, view.depth_m, in_map_m)
        if view.mask is not None:
            depth_m *= view.mask > 0
        return replace(view, depth_m=depth_m), made_by

    def _without_movable(self, keyframe: int, found: Claims) -> Claims:
        """What may walk away belongs to no map: neither its surface nor its name."""
        names, sure = self.config.movable.classes, self.config.movable_confidence
        said = [self.vocabulary.name(int(label)) for label in found.labels]
        is_movable = np.isin(said, names) & (found.confidences >= sure)
        if is_movable.any():
            boxes = [Box(said[i], *(found.boxes[i] + 0.5)) for i in np.flatnonzero(is_movable)]
            depth_m = self._map.views[keyframe].depth_m
            pixels = movable_pixels(boxes, depth_m, self.config.movable)
            self._movable += self._map.leave_out(keyframe, pixels)
        return found.where(~is_movable)

    def _with_names(
        self, view: View, top: np.ndarray, claims: Claims
    ) -> tuple[Claims, tuple[Region, ...]]:
        """With what a labeller said before of what is there; what it is asked now."""
        self._by_detector.update(claims.labels.astype(int).tolist())
        if self.naming is None:
            return claims, ()
        is_labelled = reliable_image(self._map.gaussians.labels, top, self.naming.config.reliable)
        T_map_keyframe = self._map.views.poses
        claims, questions = self.naming.see(
            view, claims, self.vocabulary, is_labelled, T_map_keyframe
        )
        return claims, tuple(question.region for question in questions)

    def _is_labellers(self, label: int) -> bool:
        """Only the labeller gave it: of such things the detector says nothing."""
        return label in self._by_labeller and label not in self._by_detector

    def _spared(self) -> np.ndarray | None:
        """[256] bool, labels that only the labeller gave: a detector cannot miss them."""
        if not self._by_labeller:
            return None
        return np.array([self._is_labellers(label) for label in range(MOST_LABELS)])

    def _label(
        self, view: View, indices: np.ndarray, claims: Claims, *, is_late: bool = False
    ) -> Labelled:
        is_told = claims.open_confidences > 0
        self._by_labeller.update(claims.open_labels[is_told].astype(int).tolist())
        gaussians = self._map.gaussians
        before = gaussians.labels[indices]
        labelled = label_keyframe(
            gaussians.rows,
            gaussians.labels,
            indices,
            view.camera,
            view.T_map_camera,
            view.depth_m,
            claims,
            self.config.labelling,
            is_late=is_late,
            spared=self._spared(),
            threads=self._threads,
        )
        is_new = np.any(gaussians.labels[indices] != before, axis=1)
        self._map.relabelled(indices[is_new])
        return labelled

    def _map_view(
        self, view: View, indices: np.ndarray, regions: np.ndarray, claims: Claims
    ) -> MapView:
        gaussians = self._map.gaussians
        at = view.keyframe, view.camera, view.T_map_camera
        known = gaussians.rows, gaussians.labels, gaussians.ids, gaussians.anchors
        seen = indices, regions, claims.boxes, claims.classes(), view.depth_m
        return MapView(*at, *known, *seen)

    # --- answers ----------------------------------------------------------------------------------
    def answer(self, region: int, keyframe: int, answer: Answer) -> bool:
        """What a labeller takes a region for, as that keyframe showed it; whether it was folded in.

        Without the images of the keyframe nobody can tell which Gaussians are meant.
        """
        claims = self.naming and self.naming.answered(region, keyframe, answer, self.vocabulary)
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

    def refresh(self, view: View | None = None) -> None:
        """Make objects what has become of their Gaussians, or those that a keyframe may show."""
        gaussians = self._map.gaussians
        known = gaussians.rows, gaussians.labels, gaussians.ids, gaussians.anchors
        seen_from = view and (view.camera, view.T_map_camera)
        self.objects.refresh(*known, seen_from=seen_from)

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """All but the labels, which the map has."""
        return {
            "vocabulary": self.vocabulary.packed,
            "objects": self.objects.packed,
            "done": list(self._done),
            "labelled": self._labelled,
            "waiting": [(keyframe, _packed(claims)) for keyframe, claims in self._waiting.items()],
            "naming": self.naming and self.naming.packed,
            "given": [sorted(self._by_detector), sorted(self._by_labeller)],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        self.vocabulary = Vocabulary.unpacked(state["vocabulary"])
        self.objects = Objects.unpacked(state["objects"], self.config.objects)
        self._done, self._labelled = dict.fromkeys(state["done"]), state["labelled"]
        self._waiting = {
            keyframe: Claims(*arrays) if arrays else None for keyframe, arrays in state["waiting"]
        }
        self._by_detector, self._by_labeller = map(set, state["given"])
        if self.naming and state["naming"]:
            is_heard = self.config.hears_labeller
            self.naming = Naming.unpacked(state["naming"], self.config.naming, is_heard=is_heard)

    def statistics(self) -> dict[str, float]:
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
            "boxes_too_early": self._too_early,  # messages, of keyframes that never came in time
            "boxes_without_images": self._without_images,  # messages, of keyframes forgotten
            "gaussians_movable": self._movable,  # left out again: of what may walk away
            "label_disagreement_literal": self._disagreement.literal,
            "label_disagreement_expected": self._disagreement.expected,
            "label_names": len(self.names),
            "label_names_refused": self.vocabulary.refused,
            **self.objects.statistics(),
            **(self.naming.statistics() if self.naming else {}),
            "answers_without_images": self._answers_without_images,  # of keyframes forgotten
        }


def _packed(claims: Claims | None) -> list[np.ndarray]:
    """Arrays of a detector's claims; none where nobody looked."""
    names = [f.name for f in fields(Claims) if f.name not in ("parts", "anew")]
    return [getattr(claims, name) for name in names] if claims else []
