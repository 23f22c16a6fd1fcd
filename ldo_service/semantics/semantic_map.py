"""The labels of a map while it grows: what is claimed of each keyframe, folded in once."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.gaussians.map_builder import MapBuilder

from .consistency import Disagreement
from .labelling import Claims, LabellingConfig, label_keyframe
from .labels import BACKGROUND, MOST_LABELS, top_labels
from .vocabulary import Vocabulary


@dataclass(frozen=True, slots=True)
class SemanticMapConfig:
    labelling: LabellingConfig = field(default_factory=LabellingConfig)
    most_names: int = MOST_LABELS  # of the vocabulary; a later name is `other`
    most_waiting: int = 8  # keyframes whose boxes came before they were mapped: as many as may be
    # on their way to the mapper

    def __post_init__(self) -> None:
        if self.most_waiting < 0 or self.most_names > MOST_LABELS:
            raise ConfigError(f"{self}: most_waiting at least 0, most_names up to {MOST_LABELS}.")


class SemanticMap:
    """Labels the Gaussians of a MapBuilder, which keeps what each keyframe measured and where it
    is now.

    Deterministic as the builder is. Where nothing is ever claimed, the map stays bit for bit as it
    is without this class.
    """

    def __init__(self, config: SemanticMapConfig | None = None, *, threads: int = 1) -> None:
        self.config = config or SemanticMapConfig()
        self.vocabulary = Vocabulary(self.config.most_names)
        self._threads = threads
        self._done: set[int] = set()  # keyframes
        self._waiting: dict[int, Claims] = {}  # by keyframe, the first to come first
        self._disagreement = Disagreement(0.0, 0.0)
        self._boxes = self._repeated = self._too_early = self._without_images = 0

    @property
    def names(self) -> tuple[str, ...]:
        """Of the labels; none before anything was claimed."""
        return self.vocabulary.names if self._done or self._waiting else ()

    def claim(self, map_: MapBuilder, keyframe: int, claims: Claims) -> None:
        """What is in a keyframe. It waits until the keyframe is mapped; said again, it is left
        out."""
        if keyframe in self._done or keyframe in self._waiting:
            self._repeated += 1
        elif keyframe in map_.views:
            self._label(map_, keyframe, claims)
        else:
            self._waiting[keyframe] = claims
            while len(self._waiting) > self.config.most_waiting:
                del self._waiting[next(iter(self._waiting))]
                self._too_early += 1

    def mapped(self, map_: MapBuilder, keyframe: int) -> None:
        """A keyframe is in the map: label what waits for it."""
        claims = self._waiting.pop(keyframe, None)
        if claims is not None:
            self._label(map_, keyframe, claims)

    def _label(self, map_: MapBuilder, keyframe: int, claims: Claims) -> None:
        """Its images may be forgotten by now, then nobody can tell what is in the boxes."""
        self._done.add(keyframe)
        if not map_.views.is_readable(keyframe):
            self._without_images += 1
            return
        view = map_.views[keyframe]
        indices = map_.made_by(keyframe)
        before = map_.gaussians.labels[indices]
        labelled = label_keyframe(
            map_.gaussians.rows,
            map_.gaussians.labels,
            indices,
            view.camera,
            view.T_map_camera,
            view.depth_m,
            claims,
            self.config.labelling,
            threads=self._threads,
        )
        is_new = np.any(map_.gaussians.labels[indices] != before, axis=1)
        map_.relabelled(indices[is_new])
        self._boxes += len(claims.boxes)
        self._disagreement = labelled.disagreement

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """All but the labels, which the map has."""
        return {
            "vocabulary": self.vocabulary.packed,
            "done": np.array(sorted(self._done), np.int64),
            "waiting": [
                (keyframe, [getattr(claims, f.name) for f in fields(claims)])
                for keyframe, claims in self._waiting.items()
            ],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        self.vocabulary = Vocabulary.unpacked(state["vocabulary"])
        self._done = set(state["done"].tolist())
        self._waiting = {keyframe: Claims(*arrays) for keyframe, arrays in state["waiting"]}

    def statistics(self, map_: MapBuilder) -> dict[str, float]:
        """`label_disagreement` is that of the newest keyframe labelled, summed over its Gaussians:
        `_literal` as the paper prints it, `_expected` as it is made smaller."""
        labelled = 0
        if self._boxes:
            labelled = int(np.count_nonzero(top_labels(map_.gaussians.labels) != BACKGROUND))
        return {
            "gaussians_labelled": labelled,  # of those awake
            "keyframes_labelled": len(self._done),
            "boxes": self._boxes,
            "boxes_repeated": self._repeated,  # messages, said again after a restart
            "boxes_too_early": self._too_early,  # messages, of keyframes that never came in time
            "boxes_without_images": self._without_images,  # messages, of keyframes forgotten
            "label_disagreement_literal": self._disagreement.literal,
            "label_disagreement_expected": self._disagreement.expected,
            "label_names": len(self.names),
            "label_names_refused": self.vocabulary.refused,
        }
