"""What an open-vocabulary labeller is asked, and what its answers are about (paper, III.B).

An answer comes late. It speaks of the pixels that a keyframe showed of a region, so these are kept
until then; and it stays with the region, as a vote for its name beside those of the detector's
boxes: where a later keyframe shows that again, it still has the name.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.detection.vocabulary import Vocabulary, normalized
from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.training_views import TrainingView
from ldo_service.geometry.boxes import areas, intersections

from .foreground import Foreground, RegionDetections
from .geometric_segmentation import segment_geometry
from .region import RegionLabelResult
from .region_proposals import (
    RegionProposal,
    RegionProposalConfig,
    labeled_regions,
    propose_regions,
    regions_of_image,
)
from .region_tracker import RegionLabel, RegionRequest, RegionTracker, RegionTrackerConfig


@dataclass(frozen=True, slots=True)
class OpenVocabularyConfig:
    trigger: RegionProposalConfig = field(default_factory=RegionProposalConfig)
    regions: RegionTrackerConfig = field(default_factory=RegionTrackerConfig)
    reliable: float = 0.6  # probability of a label, for which nobody needs to be asked (III.B)
    least_sure: float = 0.3  # of an answer: with 0.5 the flat's recall is 7 points less, and of
    # labellers that tell what is no thing little else is below
    structure: tuple[str, ...] = ("background", "wall", "floor", "ceiling")  # no objects, whoever
    # says so: they stay background
    most_open: int = 96  # questions without an answer, some 10 kB each: the labeller has 32 regions
    # waiting, and may be asked three times about each

    def __post_init__(self) -> None:
        if not (0 <= self.reliable <= 1 and 0 <= self.least_sure <= 1) or self.most_open < 1:
            raise ConfigError(
                named(self, "reliable", "least_sure", "most_open")
                + ": reliable must be within 0..1, most_open at least 1."
            )


@dataclass(frozen=True, eq=False, slots=True)
class PendingRequest:
    """What a question was about: a part of a box in a keyframe, the detector's word on it, and the
    kind of the region."""

    box_px: np.ndarray
    part: Foreground
    label: str
    score: float
    kind: str = ""


class OpenVocabularyLabeling:
    """Chooses what to ask, and knows what was asked. Bounded; the same calls give the same bits,
    also after `unpack`."""

    def __init__(
        self, config: OpenVocabularyConfig | None = None, *, is_heard: bool = True
    ) -> None:
        """`is_heard`: names are claimed; else they are learnt, and boxes stay as they are."""
        self.config, self._is_heard = config or OpenVocabularyConfig(), is_heard
        self._regions = RegionTracker(self.config.regions)
        self._open: dict[
            tuple[int, int], PendingRequest
        ] = {}  # by region and keyframe, the oldest first
        self._questions = self._named = self._unnamed = self._unknown = self._overdue = 0
        self._outvoted = 0

    # --- questions --------------------------------------------------------------------------------
    def observe_keyframe(
        self,
        view: TrainingView,
        claims: RegionDetections,
        vocabulary: Vocabulary,
        is_labelled: np.ndarray,
        T_map_keyframe: Mapping[int, np.ndarray],
    ) -> tuple[RegionDetections, list[RegionRequest]]:
        """The detector's claims of a keyframe with what is known of its regions, and what is to be
        asked about them now.

        is_labelled [H, W] bool: the map has a reliable name for this pixel
        T_map_keyframe: where all keyframes are now
        """
        config, depth_m, camera = self.config.trigger, view.depth_m, view.camera
        labels = [vocabulary.name(int(label)) for label in claims.labels]
        color = np.ascontiguousarray(view.color.transpose(1, 2, 0))
        shown = segment_geometry(color, depth_m, camera, config.segments)
        found = regions_of_image(shown, depth_m.shape, config)
        room = [one.part for one in shown if one.kind == "room"]
        doubtful = propose_regions(
            *(claims.boxes, labels, claims.confidences),
            *(depth_m, camera, is_labelled, found, room, config),
        )
        named = labeled_regions(claims.boxes, is_labelled, found, config)
        sightings = self._regions.observe_keyframe(
            view.keyframe, doubtful, color, depth_m, camera, T_map_keyframe, named
        )
        for question in sightings.questions:
            self._remember(question)
        claims = replace(claims, parts=match_boxes_to_regions(len(claims.boxes), doubtful))
        opinions = sightings.opinions if self._is_heard else []
        told = add_region_labels(claims, opinions, vocabulary, self._boxes_vote)
        return told, sightings.questions

    def _remember(self, question: RegionRequest) -> None:
        region, of = question.region, question.candidate
        self._questions += 1
        asked = PendingRequest(of.box_px, of.part, of.label, of.score, of.kind)
        self._open[region.id, region.keyframe] = asked
        while len(self._open) > self.config.most_open:
            del self._open[next(iter(self._open))]
            self._overdue += 1

    # --- answers ----------------------------------------------------------------------------------
    def apply_label_result(
        self, region: int, keyframe: int, answer: RegionLabelResult, vocabulary: Vocabulary
    ) -> RegionDetections | None:
        """What the labeller claims of that keyframe, with what the detector said of the same part.
        None where it names nothing, or nobody asked."""
        asked = self._open.pop((region, keyframe), None)
        if asked is None:
            self._unknown += 1
            return None
        answer = self._filter_answer(answer, asked)
        name, confidence = answer.label, answer.confidence
        before = self._regions.get(region)
        known_as = self._regions.answered(region, answer)
        is_name = bool(name) and confidence > 0
        self._named += is_name
        self._unnamed += not is_name
        if not is_name:
            return None
        if known_as != name:
            self._outvoted += 1
            return None
        said = vocabulary.index(name)
        return RegionDetections(
            np.reshape(asked.box_px, (1, 4)).astype(np.float32),
            np.array([vocabulary.index(asked.label) if asked.label else said]),
            np.array([asked.score], np.float32),
            np.array([said]),
            np.array([confidence], np.float32),
            (asked.part,),
            # until now it was a part of what it stands on, for all that was said
            replaces_labels=asked.kind == "standing"
            and confidence >= self.config.regions.settled
            and before is not None
            and not before.votes
            and not before.label,
        )

    def shown_in(self, region: int) -> tuple[int, ...]:
        """The keyframes whose views of a region the labeller was shown; see `RegionTracker`."""
        return self._regions.shown_in(region)

    def carried(
        self,
        region: int,
        view: TrainingView,
        vocabulary: Vocabulary,
        T_map_keyframe: Mapping[int, np.ndarray],
    ) -> RegionDetections | None:
        """What a region is, as an earlier keyframe shows it; None where it has no name, or is not
        seen."""
        place = view.keyframe, view.depth_m, view.camera, T_map_keyframe
        opinion = self._regions.carried(region, *place)
        return opinion and add_region_labels(
            RegionDetections.none(), [opinion], vocabulary, self._boxes_vote
        )

    def _filter_answer(self, answer: RegionLabelResult, asked: PendingRequest) -> RegionLabelResult:
        """Without a label that is no object's, or is told too unsurely of what no box is about."""
        others = tuple((name, sure) for name, sure in answer.others if self._is_object(name))
        if not self._is_object(answer.label):
            return RegionLabelResult("", answer.confidence)
        is_sure = answer.confidence >= self.config.least_sure or bool(asked.label)
        return replace(answer, others=others) if is_sure else RegionLabelResult("", 0.0)

    @property
    def _boxes_vote(self) -> bool:
        return self.config.regions.boxes_vote

    def _is_object(self, name: str) -> bool:
        return normalized(name) not in self.config.structure

    # --- state ------------------------------------------------------------------------------------
    def pack(self) -> dict[str, Any]:
        """Plain values and arrays, for a state."""
        return {
            "regions": self._regions.pack(),
            "open": [[*key, *_packed(asked)] for key, asked in self._open.items()],
        }

    @staticmethod
    def unpack(
        packed: Mapping[str, Any],
        config: OpenVocabularyConfig | None = None,
        *,
        is_heard: bool = True,
    ) -> "OpenVocabularyLabeling":
        """As it was."""
        out = OpenVocabularyLabeling(config, is_heard=is_heard)
        out._regions = RegionTracker.unpack(packed["regions"], out.config.regions)
        out._open = {
            (region, keyframe): _unpacked(*row) for region, keyframe, *row in packed["open"]
        }
        return out

    def metrics(self) -> dict[str, float]:
        return {
            "regions_tracked": len(self._regions),
            "questions": self._questions,
            "label_requests_pending": len(self._open),
            "label_requests_expired": self._overdue,  # given up for newer ones
            "answers_named": self._named,
            "answers_unnamed": self._unnamed,  # no opinion, or nobody could look
            "label_results_overruled": self._outvoted,  # boxes of the region say otherwise
            "answers_unknown": self._unknown,  # to questions given up, or said again
        }


def match_boxes_to_regions(
    boxes: int, found: Sequence[RegionProposal]
) -> tuple[Foreground | None, ...]:
    """Of each box of the detector the thing that depth and creases set apart there, or what of it
    is no room, or None where nobody looked. What colour sets apart has the rim of what it lies
    on."""
    parts: list[Foreground | None] = [None] * boxes
    for one in found:
        if one.number is not None and one.kind != "flat":
            parts[one.number] = one.part
    return tuple(parts)


def add_region_labels(
    claims: RegionDetections,
    opinions: Sequence[RegionLabel],
    vocabulary: Vocabulary,
    boxes_vote: bool,
) -> RegionDetections:
    """Claims of a detector with the names of the same regions: of other regions alone, of a box of
    the detector beside its label, or in place of it where it has a vote in the name."""
    labels, confidences = claims.open_labels.copy(), claims.open_confidences.copy()
    by_detector, parts = claims.confidences.copy(), claims.parts or (None,) * len(claims.boxes)
    for opinion in opinions:
        if (number := opinion.of.number) is not None:
            labels[number], confidences[number] = vocabulary.index(opinion.label), opinion.sure
            if boxes_vote:
                by_detector[number] = 0  # its word is a part of the opinion
    alone = [
        opinion
        for opinion in opinions
        if opinion.of.number is None and not _is_part_of_one(opinion, opinions)
    ]
    said = np.array([vocabulary.index(opinion.label) for opinion in alone], np.int64)
    boxes = np.array([opinion.of.box_px for opinion in alone], np.float32).reshape(-1, 4)
    return RegionDetections(
        np.concatenate([claims.boxes, boxes]),
        np.concatenate([claims.labels, said]),
        np.concatenate([by_detector, np.zeros(len(alone), np.float32)]),
        np.concatenate([labels, said]),
        np.concatenate([confidences, np.array([one.sure for one in alone], np.float32)]),
        (*parts, *[opinion.of.part for opinion in alone]),
    )


def _is_part_of_one(opinion: RegionLabel, opinions: Sequence[RegionLabel]) -> bool:
    """Most of its box lies in that of a larger region of the same name: one thing, not two."""
    larger = [
        other.of.box_px
        for other in opinions
        if other.label == opinion.label and areas(other.of.box_px) > areas(opinion.of.box_px)
    ]
    shared_px2 = intersections(opinion.of.box_px[None], np.reshape(larger, (-1, 4)))
    return bool(np.any(shared_px2 > 0.7 * areas(opinion.of.box_px)))


def _packed(asked: PendingRequest) -> list[Any]:
    return [asked.box_px, *asked.part.pack(), asked.label, asked.score, asked.kind]


def _unpacked(
    box_px: np.ndarray, place: Sequence[int], bits: np.ndarray, *seen: Any
) -> PendingRequest:
    return PendingRequest(box_px, Foreground.unpack(place, bits), *seen)
