"""Regions that nobody has a name for, followed over keyframes until a labeller can be asked.

Two sightings are of the same region when most of what each shows of the other lies in it (see
`region_matching`). Each keeps its best views, and what was said of it: it has the name that most
speaks for, be it the detector's boxes or the labeller's answers. A thing is set apart now in one
way, now in another; so of regions that have an answer, what speaks for the name of one counts for
those that overlap it, by how much they do. What stands on a thing, and the thing, tell nothing of
each other.

A region is asked about once, when no better view of it has come for a while, and as it was at its
best. Most regions are no things but parts and shadows of them; so there is a budget, and what has
most to show goes first.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera

from .region import (
    Region,
    RegionLabelResult,
    RegionObservation,
    Votes,
    merge_observation,
    observe_region,
    pack,
    unpack,
    winning_label,
    with_vote,
    with_votes_of,
)
from .region_matching import RegionMatcher
from .region_proposals import RegionProposal
from .region_views import RegionView, ViewConfig, region_view

MAX_VIEWS = 8  # of a region, that a request has room for


@dataclass(frozen=True, slots=True)
class RegionTrackerConfig:
    views: int = 5  # the best, shown to the labeller
    views_first: int = 2  # before it is asked at all: a single glimpse may be a flaw of depth
    patience: int = 3  # keyframes without a better view, before it is asked: one may yet come
    most_questions: int = 3  # about a region
    per_keyframe: float = 2.5  # questions, of all that are due those with most to show: half are
    # about no things. The paper asks on 10-25 % of the frames (IV.B.8); the flat, 1.0
    at_once: int = 4  # questions saved up while there was nothing to ask
    gain: float = 1.3  # of the views' summed quality, before it is asked again
    settled: float = 0.6  # of an answer that needs no second one
    answer_weight: float = 4.0  # of an answer, which saw several views, beside a box's; all boxes
    # of a name together count as one that is certain
    boxes_vote: bool = True  # or what boxes say is weighed Gaussian by Gaussian (III.B), and a
    # region is what the labeller says alone; regions of a state keep the votes they had
    least_votes: float = 0.35  # to have a name: a sure box, or four that are 0.3 sure
    least_carried: float = 0.5  # sure of its name, to be told where nothing sets a region apart
    most_carried: int = 32  # names of a keyframe told so: as many as it has candidates
    overlap: float = 0.6  # of what two sightings show of each other, to be of the same region
    max_gap_m: float = 0.1  # of depth, from a point to what is seen there (delta_z, III.A)
    least_points: int = 12  # that one sees of the other
    least_quality: float = 0.02  # of a view: worse ones show a labeller nothing
    most: int = 1024  # regions, some 50 kB each: five pictures of 5 kB, two masks of 12; the
    # one not seen for longest is forgotten
    view: ViewConfig = field(default_factory=ViewConfig)

    def __post_init__(self) -> None:
        counts = self.views, self.views_first, self.most_questions, self.most, self.at_once
        if min(*counts, self.most_carried) < 1:
            raise ConfigError(
                named(
                    self,
                    "views",
                    "views_first",
                    "most_questions",
                    "at_once",
                    "most_carried",
                    "most",
                )
                + ": counts must be at least 1."
            )
        if self.patience < 0 or self.per_keyframe <= 0:
            raise ConfigError(
                named(self, "patience", "per_keyframe")
                + ": patience at least 0, per_keyframe positive."
            )
        if not (0 <= self.least_quality <= 1 and 0 <= self.least_carried <= 1):
            raise ConfigError(
                named(self, "least_carried", "least_quality")
                + ": least_quality and least_carried must be within 0..1."
            )
        if self.views_first > self.views or not self.gain > 1:
            raise ConfigError(
                named(self, "views", "views_first", "gain")
                + ": views_first at most views, gain over 1."
            )
        if self.views > MAX_VIEWS:
            raise ConfigError(f"views={self.views}: a labeller is shown up to {MAX_VIEWS}.")
        if not (0 < self.overlap <= 1 and self.max_gap_m > 0 and self.least_points >= 1):
            raise ConfigError(
                named(self, "overlap", "max_gap_m", "least_points")
                + ": overlap within 0..1, max_gap_m positive, least_points at least 1."
            )
        if not (self.answer_weight > 0 and self.least_votes >= 0):
            raise ConfigError(
                named(self, "answer_weight", "least_votes")
                + ": answer_weight positive, least_votes not negative."
            )

    @property
    def most_boxes(self) -> float:
        """What all boxes of a name may speak for it, at most."""
        return self.answer_weight if self.boxes_vote else 0.0


@dataclass(frozen=True, eq=False, slots=True)
class RegionRequest:
    """A region to be asked about now, as it was at its best."""

    region: Region
    candidate: RegionProposal


@dataclass(frozen=True, eq=False, slots=True)
class RegionLabel:
    """What is known of a region that is seen again, after a labeller has spoken, 0..1 `sure`."""

    of: RegionProposal
    label: str
    sure: float


@dataclass(frozen=True, eq=False, slots=True)
class RegionUpdate:
    questions: list[RegionRequest]
    opinions: list[RegionLabel]


class RegionTracker:
    """Bounded; the same keyframes give the same questions."""

    def __init__(self, config: RegionTrackerConfig | None = None) -> None:
        self.config = config or RegionTrackerConfig()
        self._regions: dict[int, Region] = {}  # the one seen last comes last
        self._next_id = 0
        self._allowed = 0.0  # questions

    def __len__(self) -> int:
        return len(self._regions)

    def get(self, region: int) -> Region | None:
        """None when it was forgotten."""
        return self._regions.get(region)

    def observe_keyframe(
        self,
        keyframe: int,
        found: Sequence[RegionProposal],
        color: np.ndarray,
        depth_m: np.ndarray,
        camera: Camera,
        T_map_keyframe: Mapping[int, np.ndarray],
        named: Sequence[RegionProposal] = (),
    ) -> RegionUpdate:
        """Take note of a keyframe's candidates: those regions that are to be asked about now, and
        what was said before of those that have an answer.

        color [H, W, 3] uint8 RGB, depth_m [H, W]; T_map_keyframe [4, 4] by keyframe, this one and
        those of earlier sightings, as they are now; `named`: objects that the map has a name for,
        of which nobody is asked.
        """
        config, told, taken = self.config, list[tuple[int, RegionProposal]](), set[int]()
        regions, place = [*self._regions.values()], (keyframe, depth_m, camera, T_map_keyframe)
        known = RegionMatcher(regions, *place, config.max_gap_m, config.least_points)
        for candidate in found:
            sighting = observe_region(keyframe, candidate, depth_m, camera)
            if sighting is None:
                continue
            region = self._same(sighting, known, taken) or self._new(sighting)
            taken.add(region.id)
            region = merge_observation(region, sighting, config.most_boxes)
            if candidate.score < config.settled:
                args = keyframe, color, depth_m, camera, candidate.box_px, candidate.part
                region = self._with_view(region, sighting, region_view(*args, config.view))
            self._keep(region)
            told.append((region.id, candidate))
        for candidate in named:
            sighting = observe_region(keyframe, candidate, depth_m, camera)
            region = sighting and self._same(sighting, known, taken)
            if sighting and region and self._label_of(region)[0]:
                taken.add(region.id)
                self._keep(merge_observation(region, sighting, config.most_boxes))
                told.append((region.id, candidate))
        told += self._propagated(known, taken)
        opinions = self._opinions(told, known)
        questions = self._questions(keyframe, T_map_keyframe)
        self._forget()
        return RegionUpdate(questions, opinions)

    def _same(
        self, sighting: RegionObservation, known: RegionMatcher, taken: Collection[int]
    ) -> Region | None:
        same = known.same(sighting, self.config.overlap, taken)
        return None if same is None else self._regions[same]

    def _propagated(
        self, known: RegionMatcher, taken: Collection[int]
    ) -> list[tuple[int, RegionProposal]]:
        """Regions that have a name and are seen, and were not set apart."""
        found: list[tuple[int, RegionProposal]] = []
        for number in known.seen():
            region = self._regions[number]
            label, sure = self._label_of(region)
            if number in taken or not label or sure < self.config.least_carried:
                continue
            if len(found) == self.config.most_carried:
                break
            part = known.carried(number)
            if part is not None:
                self._keep(region)
                found.append((number, RegionProposal(part.box_px, part)))
        return found

    def _opinions(
        self, shown: Sequence[tuple[int, RegionProposal]], known: RegionMatcher
    ) -> list[RegionLabel]:
        """What is to be said of those that a labeller has given a name: boxes alone are told
        anyway, where they are."""
        regions = [(self._regions[number], of) for number, of in shown]
        named = [(region, of) for region, of in regions if self._label_of(region)[0]]
        overlaps = known.overlaps([(region.id, of.part) for region, of in named])
        opinions = []
        for (region, of), row in zip(named, overlaps, strict=True):
            votes: Votes = ()
            for (other, _), share in zip(named, row.tolist(), strict=True):
                if share > 0 and other.is_supported == region.is_supported:
                    votes = with_votes_of(votes, other.votes, share)
            label, sure = winning_label(votes, self.config.least_votes)
            opinions.append(RegionLabel(of, label, sure))
        return opinions

    def shown_in(self, region: int) -> tuple[int, ...]:
        """The keyframes of the best views of a region, which a labeller is shown."""
        known = self._regions.get(region)
        return tuple(view.keyframe for view in known.views) if known else ()

    def carried(
        self,
        region: int,
        keyframe: int,
        depth_m: np.ndarray,
        camera: Camera,
        T_map_keyframe: Mapping[int, np.ndarray],
    ) -> RegionLabel | None:
        """The name of a region, and what an earlier keyframe shows of it; None where it has none,
        or is not seen. Arguments as for `observe_keyframe`."""
        known, config = self._regions.get(region), self.config
        label, sure = self._label_of(known) if known else ("", 0.0)
        if known is None or not label:
            return None
        place = keyframe, depth_m, camera, T_map_keyframe
        seen = RegionMatcher([known], *place, config.max_gap_m, config.least_points)
        part = seen.carried(region) if [*seen.seen()] else None
        return part and RegionLabel(RegionProposal(part.box_px, part), label, sure)

    def _questions(self, now: int, T_map_keyframe: Mapping[int, np.ndarray]) -> list[RegionRequest]:
        """About the regions that are due, those with most to show first, as many as are allowed."""
        config = self.config
        self._allowed = min(self._allowed + config.per_keyframe, float(config.at_once))
        due = [r for r in self._regions.values() if self._is_due(r, now, T_map_keyframe)]
        due.sort(key=lambda region: -region.view_quality_gain() * _worth(region))
        asked = [self._asked(region) for region in due[: int(self._allowed)]]
        self._allowed -= len(asked)
        return asked

    def _asked(self, region: Region) -> RegionRequest:
        quality = sum(view.quality for view in region.views)
        shape = region.best if region.best and region.questions == 0 else region.shape
        region = replace(region, questions=region.questions + 1, quality=quality, shape=shape)
        self._regions[region.id] = region
        best = region.best
        assert best is not None
        return RegionRequest(
            replace(region, keyframe=best.keyframe, box_px=best.box_px), best.candidate
        )

    def _keep(self, region: Region) -> None:
        """As the one seen last."""
        self._regions.pop(region.id, None)
        self._regions[region.id] = region

    def _label_of(self, region: Region) -> tuple[str, float]:
        """Its name, where a labeller has given it one."""
        return self.name(region) if region.answer and region.answer.label else ("", 0.0)

    def name(self, region: Region) -> tuple[str, float]:
        """By its own votes, and how sure; nothing where little speaks for it."""
        return winning_label(region.votes, self.config.least_votes)

    def answered(self, region: int, answer: RegionLabelResult) -> str:
        """The labeller has spoken of it; its name now. A confident answer needs no second one."""
        known = self._regions.get(region)
        if known is None:
            return answer.label
        votes = known.votes
        for label, sure in ((answer.label, answer.confidence), *answer.others):
            votes = with_vote(votes, label, sure, self.config.answer_weight)
        is_surer = answer.confidence > (known.answer.confidence if known.answer else 0)
        surest = replace(answer, others=()) if is_surer else known.answer
        known = replace(known, votes=votes, answer=surest)
        self._regions[region] = known
        return self.name(known)[0]

    def _new(self, seen: RegionObservation) -> Region:
        self._next_id += 1
        return Region(self._next_id - 1, seen.keyframe, seen.box_px, seen)

    def _with_view(self, region: Region, sighting: RegionObservation, view: RegionView) -> Region:
        if view.quality < self.config.least_quality:
            return region
        views = sorted((*region.views, view), key=lambda view: -view.quality)
        best = sighting if views[0] is view else region.best
        return replace(region, best=best, views=tuple(views[: self.config.views]))

    def _is_due(self, region: Region, now: int, T_map_keyframe: Mapping[int, np.ndarray]) -> bool:
        if self._is_settled(region) or region.questions >= self.config.most_questions:
            return False
        best = region.best
        if best is None or best.keyframe not in T_map_keyframe:
            return False
        if len(region.views) < self.config.views_first:
            return False
        is_still = now - best.keyframe >= self.config.patience
        is_better = region.view_quality_gain() >= (self.config.gain - 1) * region.quality
        return is_still and (region.questions == 0 or is_better)

    def _is_settled(self, region: Region) -> bool:
        """Somebody was sure of it."""
        return (
            max(region.score, region.answer.confidence if region.answer else 0)
            >= self.config.settled
        )

    def _forget(self) -> None:
        while len(self._regions) > self.config.most:
            del self._regions[next(iter(self._regions))]

    def pack(self) -> dict[str, Any]:
        """Plain values, bytes and lists, for a state."""
        regions = [pack(region) for region in self._regions.values()]
        return {"next_id": self._next_id, "allowed": self._allowed, "regions": regions}

    @staticmethod
    def unpack(packed: dict[str, Any], config: RegionTrackerConfig) -> "RegionTracker":
        """As it was."""
        out = RegionTracker(config)
        out._next_id, out._allowed = packed["next_id"], packed["allowed"]
        out._regions = {row["id"]: unpack(row) for row in packed["regions"]}
        return out


def _worth(region: Region) -> float:
    """What is large is rarely a shadow or a part."""
    assert region.best is not None
    of = region.best.candidate
    factor = 0.3 if of.kind == "convex" else 1.0
    return factor * float(np.sqrt(np.count_nonzero(of.part.mask)))
