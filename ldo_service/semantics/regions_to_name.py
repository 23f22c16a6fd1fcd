"""Regions that nobody has a name for, followed over keyframes until a labeller can be asked.

A region is where it is: two sightings are of the same one when their middles are nearer than half
its size, and they are about as large. Each keeps its best views, and what the labeller said of it.

A region is asked about once, when no better view of it has come for a while, and as it was at its
best. Most regions are no things but parts and shadows of them; so there is a budget, and what has
most to show goes first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera

from .region_views import RegionView, ViewConfig, region_view
from .regions import Answer, Region, Sighting, in_map, moved, packed, sighting_of, unpacked
from .trigger import Candidate


@dataclass(frozen=True, slots=True)
class RegionConfig:
    views: int = 3  # the best, shown to the labeller
    views_first: int = 2  # before it is asked at all: a single glimpse may be a flaw of depth
    patience: int = 3  # keyframes without a better view, before it is asked: one may yet come
    most_questions: int = 3  # about a region
    per_keyframe: float = 0.7  # questions, of all that are due those with most to show: the paper
    # asks on 10-25 % of the frames (IV.B.8); twice as many regions are no things
    at_once: int = 4  # questions saved up while there was nothing to ask
    gain: float = 1.3  # of the views' summed quality, before it is asked again
    settled: float = 0.6  # of an answer that needs no second one
    near: float = 0.5  # of its size, between two sightings of a region
    least_quality: float = 0.02  # of a view: worse ones show a labeller nothing
    alike: float = 0.6  # its size of another sighting's, or the other way round, to be the same:
    # what stands on a table is near its middle
    most: int = 1024  # regions, some 10 kB each; the one not seen for longest is forgotten
    view: ViewConfig = field(default_factory=ViewConfig)

    def __post_init__(self) -> None:
        if min(self.views, self.views_first, self.most_questions, self.most, self.at_once) < 1:
            raise ConfigError(f"{self}: counts must be at least 1.")
        if self.patience < 0 or self.per_keyframe <= 0:
            raise ConfigError(f"{self}: patience at least 0, per_keyframe positive.")
        if not (0 <= self.least_quality <= 1 and 0 <= self.alike <= 1):
            raise ConfigError(f"{self}: least_quality and alike must be within 0..1.")
        if self.views_first > self.views or not (self.gain > 1 and self.near > 0):
            raise ConfigError(f"{self}: views_first at most views, gain over 1, near positive.")


@dataclass(frozen=True, eq=False, slots=True)
class Question:
    """A region to be asked about now, as it was at its best."""

    region: Region
    candidate: Candidate


@dataclass(frozen=True, eq=False, slots=True)
class Opinion:
    """What a labeller said before of a region that is seen again, 0..1 `sure`."""

    of: Candidate
    label: str
    sure: float


@dataclass(frozen=True, eq=False, slots=True)
class Sightings:
    questions: list[Question]
    opinions: list[Opinion]


class RegionsToName:
    """Bounded; the same keyframes give the same questions."""

    def __init__(self, config: RegionConfig | None = None) -> None:
        self.config = config or RegionConfig()
        self._regions: dict[int, Region] = {}  # the one seen last comes last
        self._next_id = 0
        self._allowed = 0.0  # questions

    def __len__(self) -> int:
        return len(self._regions)

    def get(self, region: int) -> Region | None:
        """None when it was forgotten."""
        return self._regions.get(region)

    def see(
        self,
        keyframe: int,
        found: Sequence[Candidate],
        color: np.ndarray,
        depth_m: np.ndarray,
        camera: Camera,
        T_map_keyframe: Mapping[int, np.ndarray],
        named: Sequence[Candidate] = (),
    ) -> Sightings:
        """Take note of a keyframe's candidates: those regions that are to be asked about now, and
        what was said before of those that have an answer.

        color [H, W, 3] uint8 RGB, depth_m [H, W]; T_map_keyframe [4, 4] by keyframe, this one and
        those of earlier sightings, as they are now; `named`: objects that the map has a name for,
        of which nobody is asked.
        """
        opinions: list[Opinion] = []
        taken = set[int]()
        for candidate in found:
            sighting = sighting_of(keyframe, candidate, depth_m, camera)
            if sighting is None:
                continue
            region = self._same(sighting, T_map_keyframe, taken) or self._new(sighting)
            taken.add(region.id)
            args = keyframe, color, depth_m, camera, candidate.box_px, candidate.part
            region = moved(region, sighting)
            region = self._with_view(region, sighting, region_view(*args, self.config.view))
            self._keep(region)
            opinions += self._said_of(region, sighting, candidate, T_map_keyframe)
        for candidate in named:
            sighting = sighting_of(keyframe, candidate, depth_m, camera)
            region = sighting and self._same(sighting, T_map_keyframe, taken)
            if sighting and region:
                said = self._said_of(region, sighting, candidate, T_map_keyframe)
                if said:
                    taken.add(region.id)
                    self._keep(moved(region, sighting))
                opinions += said
        questions = self._questions(keyframe, T_map_keyframe)
        self._forget()
        return Sightings(questions, opinions)

    def _questions(self, now: int, T_map_keyframe: Mapping[int, np.ndarray]) -> list[Question]:
        """About the regions that are due, those with most to show first, as many as are allowed."""
        config = self.config
        self._allowed = min(self._allowed + config.per_keyframe, float(config.at_once))
        due = [r for r in self._regions.values() if self._is_due(r, now, T_map_keyframe)]
        due.sort(key=lambda region: -region.gained() * _worth(region))
        asked = [self._asked(region) for region in due[: int(self._allowed)]]
        self._allowed -= len(asked)
        return asked

    def _asked(self, region: Region) -> Question:
        quality = sum(view.quality for view in region.views)
        region = replace(region, questions=region.questions + 1, quality=quality)
        self._regions[region.id] = region
        best = region.best
        assert best is not None
        shown = {name: getattr(best, name) for name in ("keyframe", "p_camera", "size_m")}
        return Question(replace(region, box_px=best.box_px, **shown), best.candidate)

    def _keep(self, region: Region) -> None:
        """As the one seen last."""
        self._regions.pop(region.id, None)
        self._regions[region.id] = region

    def _said_of(
        self,
        region: Region,
        sighting: Sighting,
        candidate: Candidate,
        T_map_keyframe: Mapping[int, np.ndarray],
    ) -> list[Opinion]:
        """The answer, where what is seen now is where that spoke of, and about as large: what
        stands on a table is near enough to be the same region, and no table."""
        answer = region.answer
        if answer is None or not answer.label or answer.keyframe not in T_map_keyframe:
            return []
        small, large = sorted((answer.size_m, sighting.size_m))
        gap_m = np.linalg.norm(in_map(answer, T_map_keyframe) - in_map(sighting, T_map_keyframe))
        is_it = small >= self.config.alike * large and gap_m < self.config.near * small
        return [Opinion(candidate, answer.label, answer.sure)] if is_it else []

    def answered(self, region: int, answer: Answer) -> None:
        """The labeller has spoken of it; a confident answer needs no second one."""
        known = self._regions.get(region)
        if known is not None and answer.sure > (known.answer.sure if known.answer else 0):
            self._regions[region] = replace(known, answer=answer)

    def _same(
        self, sighting: Sighting, T_map_keyframe: Mapping[int, np.ndarray], taken: set[int]
    ) -> Region | None:
        """The nearest region that is near enough."""
        there = [
            region
            for region in self._regions.values()
            if region.id not in taken and region.keyframe in T_map_keyframe
        ]
        if not there:
            return None
        sizes_m = np.array([region.size_m for region in there])
        p_map = np.array([in_map(region, T_map_keyframe) for region in there])
        gaps_m = np.linalg.norm(p_map - in_map(sighting, T_map_keyframe), axis=1)
        small = np.minimum(sizes_m, sighting.size_m)
        is_alike = small >= self.config.alike * np.maximum(sizes_m, sighting.size_m)
        shares = np.where(is_alike, gaps_m / np.maximum(small, 1e-9), np.inf)
        best = int(shares.argmin())
        return there[best] if shares[best] < self.config.near else None

    def _new(self, seen: Sighting) -> Region:
        self._next_id += 1
        return Region(self._next_id - 1, seen.keyframe, seen.box_px, seen.p_camera, seen.size_m)

    def _with_view(self, region: Region, sighting: Sighting, view: RegionView) -> Region:
        if view.quality < self.config.least_quality:
            return region
        views = sorted((*region.views, view), key=lambda view: -view.quality)
        best = sighting if views[0] is view else region.best
        return replace(region, best=best, views=tuple(views[: self.config.views]))

    def _is_due(self, region: Region, now: int, T_map_keyframe: Mapping[int, np.ndarray]) -> bool:
        is_settled = region.answer is not None and region.answer.sure >= self.config.settled
        if is_settled or region.questions >= self.config.most_questions:
            return False
        best = region.best
        if best is None or best.keyframe not in T_map_keyframe:
            return False
        if len(region.views) < self.config.views_first:
            return False
        is_still = now - best.keyframe >= self.config.patience
        is_better = region.gained() >= (self.config.gain - 1) * region.quality
        return is_still and (region.questions == 0 or is_better)

    def _forget(self) -> None:
        while len(self._regions) > self.config.most:
            del self._regions[next(iter(self._regions))]

    @property
    def packed(self) -> dict[str, Any]:
        """Plain values, bytes and lists, for a state."""
        regions = [packed(region) for region in self._regions.values()]
        return {"next_id": self._next_id, "allowed": self._allowed, "regions": regions}

    @staticmethod
    def unpacked(packed: dict[str, Any], config: RegionConfig) -> "RegionsToName":
        """As it was."""
        out = RegionsToName(config)
        out._next_id, out._allowed = packed["next_id"], packed["allowed"]
        out._regions = {row["id"]: unpacked(row) for row in packed["regions"]}
        return out


def _worth(region: Region) -> float:
    """What is large is rarely a shadow or a part."""
    assert region.best is not None
    of = region.best.candidate
    factor = 0.3 if of.kind == "convex" else 1.0
    return factor * float(np.sqrt(np.count_nonzero(of.part.mask)))
