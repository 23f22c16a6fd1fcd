"""Label requests to an open-vocabulary labeller, and use of its results (LDO-SLAM paper, III.B).

A label result arrives later than the keyframe of its request. The result labels the pixels of a
region in that keyframe, so the region's box and mask are stored until then. The result also counts
as a vote for the region's label, as the boxes of the detector do. Later keyframes that observe the
region get the region's label too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from ldo_service.detection.vocabulary import Vocabulary, normalized
from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.training_views import TrainingView
from ldo_service.geometry.boxes import areas, intersections

from .foreground import Foreground, RegionDetections
from .geometric_segmentation import segment_geometry
from .region import RegionLabel, RegionLabelResult, RegionRequest
from .region_proposals import (
    RegionProposal,
    RegionProposalConfig,
    labeled_regions,
    propose_regions,
    regions_of_image,
)
from .region_tracker import RegionTracker
from .region_tracker_config import RegionTrackerConfig


@dataclass(frozen=True, slots=True)
class OpenVocabularyConfig:
    """Settings of the label requests to the open-vocabulary labeller, and of its results."""

    # Choice of the regions of a keyframe that need a label.
    trigger: RegionProposalConfig = field(default_factory=RegionProposalConfig)
    # Tracking of these regions, and the time of their label requests.
    regions: RegionTrackerConfig = field(default_factory=RegionTrackerConfig)
    # Minimum probability of a reliable label in the map. Pixels with such a label need no label
    # request (LDO-SLAM paper, III.B).
    reliable: float = 0.6
    # Minimum confidence of a label result. With 0.5, the recall on the sequence `synthetic:flat` is
    # 7 percentage points lower. Results below 0.3 are rare if the labeller recognizes that a region
    # shows no object.
    min_sure: float = 0.3
    # Labels that are no objects; a region with such a label result stays background.
    structure: tuple[str, ...] = ("background", "wall", "floor", "ceiling")
    # Maximum pending label requests, about 10 kB each; equal to `MAX_WAITING` in
    # `maps.label_queue`.
    max_open: int = 96

    def __post_init__(self) -> None:
        if not (0 <= self.reliable <= 1 and 0 <= self.min_sure <= 1) or self.max_open < 1:
            raise ConfigError(
                named(self, "reliable", "min_sure", "max_open")
                + ": reliable and min_sure must be in [0, 1], and max_open at least 1."
            )


@dataclass(frozen=True, eq=False, slots=True)
class PendingRequest:
    """Label request whose result has not arrived, with the region in the keyframe of the request.

    Attributes:
        box_px: Box of the region in that keyframe, [4], x0 y0 x1 y1, pixels.
        part: Mask of the region in that keyframe.
        label: Label of the detector's box; empty without a box.
        score: Score of the detector's box, 0..1; 0 without a box.
        kind: Kind of the region, see `geometric_segmentation`; empty for the foreground of a box.
    """

    box_px: np.ndarray
    part: Foreground
    label: str
    score: float
    kind: str = ""


class OpenVocabularyLabeling:
    """Label requests for the regions of a map, and the use of the label results.

    Memory is bounded. The same calls give bitwise equal results, also after `unpack`.
    """

    def __init__(
        self, config: OpenVocabularyConfig | None = None, *, is_fused: bool = True
    ) -> None:
        """Create the open-vocabulary labels of a map.

        Args:
            config: Settings.
            is_fused: True: labels of regions are added to the detections of a keyframe. False: they
                are only stored as votes of the regions.
        """
        self.config, self._is_fused = config or OpenVocabularyConfig(), is_fused
        self._regions = RegionTracker(self.config.regions)
        # Pending requests by the ids of region and keyframe, the oldest first.
        self._open: dict[tuple[int, int], PendingRequest] = {}
        self._requests = self._named = self._unnamed = self._unknown = self._overdue = 0
        self._overruled = 0

    # --- label requests ---------------------------------------------------------------------------
    def observe_keyframe(
        self,
        view: TrainingView,
        detections: RegionDetections,
        vocabulary: Vocabulary,
        is_labelled: np.ndarray,
        T_map_keyframe: Mapping[int, np.ndarray],
    ) -> tuple[RegionDetections, list[RegionRequest]]:
        """Add known labels of regions to the detections of a keyframe, and choose label requests.

        Args:
            view: Images and pose of the keyframe.
            detections: Detections of the keyframe.
            vocabulary: Vocabulary of the map.
            is_labelled: Pixels for which the map has a reliable label, [H, W] bool.
            T_map_keyframe: Current poses of all keyframes, [4, 4], by id.

        Returns:
            The detections with labels of regions, and the new label requests.
        """
        config, depth_m, camera = self.config.trigger, view.depth_m, view.camera
        labels = [vocabulary.name(int(label)) for label in detections.labels]
        color = np.asarray(cv2.merge([*view.color]))
        shown = segment_geometry(color, depth_m, camera, config.segments)
        found = regions_of_image(shown, depth_m.shape, config)
        room = [one.part for one in shown if one.kind == "room"]
        proposals = propose_regions(
            *(detections.boxes, labels, detections.confidences),
            *(depth_m, camera, is_labelled, found, room, config),
        )
        named = labeled_regions(detections.boxes, is_labelled, found, config)
        update = self._regions.observe_keyframe(
            view.keyframe, proposals, color, depth_m, camera, T_map_keyframe, named
        )
        for request in update.questions:
            self._remember(request)
        detections = replace(
            detections, parts=match_boxes_to_regions(len(detections.boxes), proposals)
        )
        region_labels = update.region_labels if self._is_fused else []
        labelled = add_region_labels(detections, region_labels, vocabulary, self._boxes_vote)
        return labelled, update.questions

    def _remember(self, request: RegionRequest) -> None:
        region, of = request.region, request.candidate
        self._requests += 1
        pending = PendingRequest(of.box_px, of.part, of.label, of.score, of.kind)
        self._open[region.id, region.keyframe] = pending
        while len(self._open) > self.config.max_open:
            del self._open[next(iter(self._open))]
            self._overdue += 1

    def withdraw(self, region: int, keyframe: int) -> None:
        """Drop a label request that was not sent, and count it as expired."""
        if self._open.pop((region, keyframe), None) is not None:
            self._overdue += 1

    # --- label results ----------------------------------------------------------------------------
    def apply_label_result(
        self, region: int, keyframe: int, answer: RegionLabelResult, vocabulary: Vocabulary
    ) -> RegionDetections | None:
        """Apply a label result, and return the region's labels in the requested keyframe.

        Args:
            region: Id of the region.
            keyframe: Keyframe of the request.
            answer: Label result.
            vocabulary: Vocabulary of the map.

        Returns:
            One box with the labels by the detector and by the labeller. None if the result has no
            label, if no request is pending for the region and keyframe, or if another label has the
            most votes of the region even after the vote of the result.
        """
        pending = self._open.pop((region, keyframe), None)
        if pending is None:
            self._unknown += 1
            return None
        answer = self._filter_answer(answer, pending)
        name, confidence = answer.label, answer.confidence
        before = self._regions.get(region)
        known_as = self._regions.answered(region, answer)
        is_name = bool(name) and confidence > 0
        self._named += is_name
        self._unnamed += not is_name
        if not is_name:
            return None
        if known_as != name:
            self._overruled += 1
            return None
        label_ids = vocabulary.index(name)
        return RegionDetections(
            np.reshape(pending.box_px, (1, 4)).astype(np.float32),
            np.array([vocabulary.index(pending.label) if pending.label else label_ids]),
            np.array([pending.score], np.float32),
            np.array([label_ids]),
            np.array([confidence], np.float32),
            (pending.part,),
            # The Gaussians of a standing object still have the label of the surface below it.
            replaces_labels=pending.kind == "standing"
            and confidence >= self.config.regions.settled
            and before is not None
            and not before.votes
            and not before.label,
        )

    def shown_in(self, region: int) -> tuple[int, ...]:
        """Return the keyframes whose crops are in the label request of a region."""
        return self._regions.shown_in(region)

    def propagated(
        self,
        region: int,
        view: TrainingView,
        vocabulary: Vocabulary,
        T_map_keyframe: Mapping[int, np.ndarray],
    ) -> RegionDetections | None:
        """Propagate the mask and the label of a region into an earlier keyframe.

        Args:
            region: Id of the region.
            view: Images and pose of the earlier keyframe.
            vocabulary: Vocabulary of the map.
            T_map_keyframe: Current poses of all keyframes, [4, 4], by id.

        Returns:
            One box with the label; None if the region has no label or is not visible in the
            keyframe.
        """
        place = view.keyframe, view.depth_m, view.camera, T_map_keyframe
        region_label = self._regions.propagated(region, *place)
        return region_label and add_region_labels(
            RegionDetections.none(), [region_label], vocabulary, self._boxes_vote
        )

    def _filter_answer(
        self, answer: RegionLabelResult, pending: PendingRequest
    ) -> RegionLabelResult:
        """Return a label result without labels that are no objects, see `config.structure`.

        The result has no label if its label is such a name, for example "wall". It also has no
        label if its confidence is below min_sure, unless the region has a box of the detector.
        """
        others = tuple((name, sure) for name, sure in answer.others if self._is_object(name))
        if not self._is_object(answer.label):
            return RegionLabelResult("", answer.confidence)
        is_sure = answer.confidence >= self.config.min_sure or bool(pending.label)
        return replace(answer, others=others) if is_sure else RegionLabelResult("", 0.0)

    @property
    def _boxes_vote(self) -> bool:
        return self.config.regions.boxes_vote

    def _is_object(self, name: str) -> bool:
        return normalized(name) not in self.config.structure

    # --- state ------------------------------------------------------------------------------------
    def adopt(self, other: "OpenVocabularyLabeling") -> None:
        """Replace regions and pending requests by those of another instance; the counters stay."""
        self._regions, self._open = other._regions, other._open

    def pack(self) -> dict[str, Any]:
        """Return regions and pending requests as plain values and arrays, for a checkpoint."""
        return {
            "regions": self._regions.pack(),
            "open": [[*key, *_packed(pending)] for key, pending in self._open.items()],
        }

    @staticmethod
    def unpack(
        packed: Mapping[str, Any],
        config: OpenVocabularyConfig | None = None,
        *,
        is_fused: bool = True,
    ) -> "OpenVocabularyLabeling":
        """Restore an instance from `pack`; `config` and `is_fused` are as in the constructor."""
        out = OpenVocabularyLabeling(config, is_fused=is_fused)
        out._regions = RegionTracker.unpack(packed["regions"], out.config.regions)
        out._open = {
            (region, keyframe): _unpacked(*row) for region, keyframe, *row in packed["open"]
        }
        return out

    def metrics(self) -> dict[str, float]:
        """Return the counters of regions, label requests and label results."""
        return {
            "regions_tracked": len(self._regions),
            "questions": self._requests,
            "label_requests_pending": len(self._open),
            "label_requests_expired": self._overdue,  # Replaced by newer requests, or not sent.
            "answers_named": self._named,
            # Results without a label: no object, or no labeller available.
            "answers_unnamed": self._unnamed,
            # Results with another label than the votes of the region give.
            "label_results_overruled": self._overruled,
            # Results without a pending request: the request was dropped, or the result is repeated.
            "answers_unknown": self._unknown,
        }


def match_boxes_to_regions(
    boxes: int, found: Sequence[RegionProposal]
) -> tuple[Foreground | None, ...]:
    """Return the masks of the regions that belong to the detector's boxes.

    `RegionProposal.number` is the index of a region's box. The mask of a box is the mask of its
    region: the segment that fits the box, or the foreground of the box if no segment fits. A
    segment found by color ("flat") is not used, because it includes the edge of the surface behind
    the object. Its box then has no mask.

    Args:
        boxes: Number of boxes.
        found: Regions of the keyframe, from `propose_regions`.

    Returns:
        The mask of each box; None if the box has no region, or if its region is "flat".
    """
    parts: list[Foreground | None] = [None] * boxes
    for one in found:
        if one.number is not None and one.kind != "flat":
            parts[one.number] = one.part
    return tuple(parts)


def add_region_labels(
    detections: RegionDetections,
    region_labels: Sequence[RegionLabel],
    vocabulary: Vocabulary,
    boxes_vote: bool,
) -> RegionDetections:
    """Add the labels of regions to the detections of a keyframe.

    If a region belongs to a box, the region's label becomes the labeller's label of the box
    (`RegionDetections.open_labels`). If `boxes_vote` is true, the detector's label of the box is
    dropped, because the region's label already includes the vote of the box. A region without a box
    is added as a new box, unless the region is a part of a larger region with the same label.

    Args:
        detections: Detections of the keyframe.
        region_labels: Labels of regions.
        vocabulary: Vocabulary of the map.
        boxes_vote: True if boxes of the detector vote for region labels.
    """
    labels, confidences = detections.open_labels.copy(), detections.open_confidences.copy()
    by_detector, parts = (
        detections.confidences.copy(),
        detections.parts or (None,) * len(detections.boxes),
    )
    for region_label in region_labels:
        if (number := region_label.of.number) is not None:
            labels[number], confidences[number] = (
                vocabulary.index(region_label.label),
                region_label.sure,
            )
            if boxes_vote:
                by_detector[number] = 0  # The region's label contains the vote of the box.
    alone = [
        region_label
        for region_label in region_labels
        if region_label.of.number is None and not _is_part_of_one(region_label, region_labels)
    ]
    label_ids = np.array([vocabulary.index(region_label.label) for region_label in alone], np.int64)
    boxes = np.array([region_label.of.box_px for region_label in alone], np.float32).reshape(-1, 4)
    return RegionDetections(
        np.concatenate([detections.boxes, boxes]),
        np.concatenate([detections.labels, label_ids]),
        np.concatenate([by_detector, np.zeros(len(alone), np.float32)]),
        np.concatenate([labels, label_ids]),
        np.concatenate([confidences, np.array([one.sure for one in alone], np.float32)]),
        (*parts, *[region_label.of.part for region_label in alone]),
    )


def _is_part_of_one(region_label: RegionLabel, region_labels: Sequence[RegionLabel]) -> bool:
    """Return whether over 70 % of a region's box lies in a larger box with the same label."""
    larger = [
        other.of.box_px
        for other in region_labels
        if other.label == region_label.label
        and areas(other.of.box_px) > areas(region_label.of.box_px)
    ]
    shared_px2 = intersections(region_label.of.box_px[None], np.reshape(larger, (-1, 4)))
    return bool(np.any(shared_px2 > 0.7 * areas(region_label.of.box_px)))


def _packed(pending: PendingRequest) -> list[Any]:
    return [pending.box_px, *pending.part.pack(), pending.label, pending.score, pending.kind]


def _unpacked(
    box_px: np.ndarray, place: Sequence[int], bits: np.ndarray, *seen: Any
) -> PendingRequest:
    return PendingRequest(box_px, Foreground.unpack(place, bits), *seen)
