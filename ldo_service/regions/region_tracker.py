"""Region tracks: regions over keyframes, with label requests and votes for their labels.

Two observations show the same region if most of the visible points of each observation lie in the
mask of the other observation (see `region_matching`). A view is the crop of an image around the
region. A region stores its best views and its votes for labels, which come from the detector's
boxes and from label results. The label of the region is the label with the most votes.

An object may be segmented differently in each keyframe, so several regions may show the same
object. To decide the label of a region, the votes of overlapping labelled regions are therefore
added, weighted by the overlap. If an object stands on another one, the votes of the regions of the
two objects are not added to each other.

The tracker requests a label for a region when several keyframes in a row show no better view. The
request contains the best views. Most regions show only parts or shadows of objects. The number of
requests is therefore limited, and regions with the best views come first.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ldo_service.geometry import Camera

from .region import (
    Region,
    RegionLabel,
    RegionLabelResult,
    RegionObservation,
    RegionRequest,
    RegionUpdate,
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
from .region_tracker_config import RegionTrackerConfig
from .region_views import RegionView, region_view


class RegionTracker:
    """Region tracks over keyframes.

    Memory is bounded. The same keyframes give the same label requests.
    """

    def __init__(self, config: RegionTrackerConfig | None = None) -> None:
        self.config = config or RegionTrackerConfig()
        self._regions: dict[int, Region] = {}  # Keys are ids; the latest observed is last.
        self._next_id = 0
        self._allowed = 0.0  # Number of label requests that are allowed now.

    def __len__(self) -> int:
        return len(self._regions)

    def get(self, region: int) -> Region | None:
        """Return a region, or None if it was dropped."""
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
        """Track the region proposals of a keyframe.

        Args:
            keyframe: Id of the keyframe.
            found: Region proposals of the keyframe.
            color: Color image, [H, W, 3] uint8 RGB.
            depth_m: Depth, [H, W], meters; 0 where unknown.
            camera: Intrinsics of both images.
            T_map_keyframe: Current poses of this keyframe and of the keyframes with earlier
                observations, [4, 4], by id.
            named: Regions that have a reliable label in the map. They are only matched with known
                labelled regions; they create no new region and no label request.

        Returns:
            New label requests, and the labels of the keyframe's regions.
        """
        config, observed, taken = self.config, list[tuple[int, RegionProposal]](), set[int]()
        regions, place = [*self._regions.values()], (keyframe, depth_m, camera, T_map_keyframe)
        known = RegionMatcher(regions, *place, config.max_gap_m, config.min_points)
        for candidate in found:
            observation = observe_region(keyframe, candidate, depth_m, camera)
            if observation is None:
                continue
            region = self._same(observation, known, taken) or self._new(observation)
            taken.add(region.id)
            region = merge_observation(region, observation, config.max_box_votes)
            if candidate.score < config.settled:
                args = keyframe, color, depth_m, camera, candidate.box_px, candidate.part
                view = region_view(*args, config.view, self._min_quality(region))
                region = self._with_view(region, observation, view)
            self._keep(region)
            observed.append((region.id, candidate))
        for candidate in named:
            observation = observe_region(keyframe, candidate, depth_m, camera)
            region = observation and self._same(observation, known, taken)
            if observation and region and self._label_of(region)[0]:
                taken.add(region.id)
                self._keep(merge_observation(region, observation, config.max_box_votes))
                observed.append((region.id, candidate))
        observed += self._propagated(known, taken)
        region_labels = self._region_labels(observed, known)
        questions = self._label_requests(keyframe, T_map_keyframe)
        self._forget()
        return RegionUpdate(questions, region_labels)

    def _same(
        self, observation: RegionObservation, known: RegionMatcher, taken: Collection[int]
    ) -> Region | None:
        """Return the known region that matches an observation, or None."""
        same = known.same(observation, self.config.overlap, taken)
        return None if same is None else self._regions[same]

    def _propagated(
        self, known: RegionMatcher, taken: Collection[int]
    ) -> list[tuple[int, RegionProposal]]:
        """Propagate the masks of visible labelled regions that matched no observation.

        Args:
            known: Matcher with the points of the known regions in the keyframe.
            taken: Ids of the regions that matched an observation.

        Returns:
            Ids of the regions, each with its mask in the keyframe.
        """
        found: list[tuple[int, RegionProposal]] = []
        for number in known.seen():
            region = self._regions[number]
            label, sure = self._label_of(region)
            if number in taken or not label or sure < self.config.min_propagation_confidence:
                continue
            if len(found) == self.config.max_propagated:
                break
            part = known.propagated(number)
            if part is not None:
                self._keep(region)
                found.append((number, RegionProposal(part.box_px, part)))
        return found

    def _region_labels(
        self, shown: Sequence[tuple[int, RegionProposal]], known: RegionMatcher
    ) -> list[RegionLabel]:
        """Return the labels of the keyframe's regions that have a label result.

        The votes of overlapping regions are added to each region's own votes. Regions without a
        label result are omitted, so that their boxes keep the labels of the detector.

        Args:
            shown: Ids of the regions in the keyframe, each with its box and mask there.
            known: Matcher with the points of the known regions in the keyframe.
        """
        regions = [(self._regions[number], of) for number, of in shown]
        named = [(region, of) for region, of in regions if self._label_of(region)[0]]
        overlaps = known.overlaps([(region.id, of.part) for region, of in named])
        region_labels = []
        for (region, of), row in zip(named, overlaps, strict=True):
            votes: Votes = ()
            for (other, _), share in zip(named, row.tolist(), strict=True):
                if share > 0 and other.is_supported == region.is_supported:
                    votes = with_votes_of(votes, other.votes, share)
            label, sure = winning_label(votes, self.config.min_votes)
            region_labels.append(RegionLabel(of, label, sure))
        return region_labels

    def shown_in(self, region: int) -> tuple[int, ...]:
        """Return the keyframes from which the tracker has a view of a region.

        The result is empty if the region was dropped.
        """
        known = self._regions.get(region)
        return tuple(view.keyframe for view in known.views) if known else ()

    def propagated(
        self,
        region: int,
        keyframe: int,
        depth_m: np.ndarray,
        camera: Camera,
        T_map_keyframe: Mapping[int, np.ndarray],
    ) -> RegionLabel | None:
        """Propagate the mask and the label of a region into an earlier keyframe.

        Args:
            region: Id of the region.
            keyframe: Id of the earlier keyframe.
            depth_m: Depth of that keyframe, [H, W], meters; 0 where unknown.
            camera: Intrinsics of all keyframes.
            T_map_keyframe: Current poses of all keyframes, [4, 4], by id.

        Returns:
            The mask and the label in the keyframe. None if the region has no label or is not
            visible there.
        """
        known, config = self._regions.get(region), self.config
        label, sure = self._label_of(known) if known else ("", 0.0)
        if known is None or not label:
            return None
        place = keyframe, depth_m, camera, T_map_keyframe
        seen = RegionMatcher([known], *place, config.max_gap_m, config.min_points)
        part = seen.propagated(region) if [*seen.seen()] else None
        return part and RegionLabel(RegionProposal(part.box_px, part), label, sure)

    def _label_requests(
        self, now: int, T_map_keyframe: Mapping[int, np.ndarray]
    ) -> list[RegionRequest]:
        """Return label requests for the regions that need a label now, up to the allowed number.

        Regions whose view quality increased most since their last request come first. The increase
        is weighted by the region's size and kind (see `_priority`).

        Args:
            now: Id of the current keyframe.
            T_map_keyframe: Current poses of the keyframes, [4, 4], by id.
        """
        config = self.config
        self._allowed = min(self._allowed + config.per_keyframe, float(config.at_once))
        due = [r for r in self._regions.values() if self._is_due(r, now, T_map_keyframe)]
        due.sort(key=lambda region: -region.view_quality_gain() * _priority(region))
        requests = [self._request(region) for region in due[: int(self._allowed)]]
        self._allowed -= len(requests)
        return requests

    def _request(self, region: Region) -> RegionRequest:
        """Create a label request with the best observation of a region.

        The region counts the request. At its first request, the observation in the request becomes
        `Region.shape`, with which later observations are compared.
        """
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
        """Store a region, and mark it as the most recently observed one."""
        self._regions.pop(region.id, None)
        self._regions[region.id] = region

    def _label_of(self, region: Region) -> tuple[str, float]:
        """Return label and confidence of a region; ("", 0) if the region has no label result."""
        return self.name(region) if region.answer and region.answer.label else ("", 0.0)

    def name(self, region: Region) -> tuple[str, float]:
        """Return the label that a region's own votes give, and its confidence, 0..1.

        The result is ("", 0) if there are too few votes.
        """
        return winning_label(region.votes, self.config.min_votes)

    def answered(self, region: int, answer: RegionLabelResult) -> str:
        """Add a label result to the votes of a region, and return the label with the most votes.

        A result with a confidence of at least `settled` prevents further label requests. If the
        region was dropped, the label of the result is returned.
        """
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
        """Create a region from its first observation."""
        self._next_id += 1
        return Region(self._next_id - 1, seen.keyframe, seen.box_px, seen)

    def _min_quality(self, region: Region) -> float:
        """Return the minimum quality of a new view that a region would store, 0..1.

        If the region has `config.views` views, a new view must be better than the worst of them.
        """
        config, views = self.config, region.views
        if len(views) < config.views:
            return config.min_quality
        return max(config.min_quality, float(np.nextafter(views[-1].quality, np.inf)))

    def _with_view(
        self, region: Region, observation: RegionObservation, view: RegionView | None
    ) -> Region:
        """Return the region with a view added; unchanged if there is no view."""
        if view is None:
            return region
        views = sorted((*region.views, view), key=lambda view: -view.quality)
        best = observation if views[0] is view else region.best
        return replace(region, best=best, views=tuple(views[: self.config.views]))

    def _is_due(self, region: Region, now: int, T_map_keyframe: Mapping[int, np.ndarray]) -> bool:
        """Return whether a label request for a region should be made now."""
        if self._is_settled(region) or region.questions >= self.config.max_requests:
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
        """Return whether a detection or label result of a region has a high confidence."""
        return (
            max(region.score, region.answer.confidence if region.answer else 0)
            >= self.config.settled
        )

    def _forget(self) -> None:
        """Drop the regions observed longest ago, so that at most `config.most` remain."""
        while len(self._regions) > self.config.most:
            del self._regions[next(iter(self._regions))]

    def pack(self) -> dict[str, Any]:
        """Return the tracks as plain values and arrays, for a checkpoint."""
        regions = [pack(region) for region in self._regions.values()]
        return {"next_id": self._next_id, "allowed": self._allowed, "regions": regions}

    @staticmethod
    def unpack(packed: dict[str, Any], config: RegionTrackerConfig) -> "RegionTracker":
        """Restore the tracks from `pack`."""
        out = RegionTracker(config)
        out._next_id, out._allowed = packed["next_id"], packed["allowed"]
        out._regions = {row["id"]: unpack(row) for row in packed["regions"]}
        return out


def _priority(region: Region) -> float:
    """Return the priority of a region's label request, by the region's size and kind.

    Large regions have a higher priority, because they are rarely shadows or parts of objects.
    Convex regions have a lower one.
    """
    assert region.best is not None
    of = region.best.candidate
    factor = 0.3 if of.kind == "convex" else 1.0
    return factor * float(np.sqrt(np.count_nonzero(of.part.mask)))
