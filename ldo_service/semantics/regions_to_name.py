"""Regions that nobody has a name for, followed over keyframes until a labeller can be asked.

A region is where it is: two sightings are of the same one when their middles are nearer than half
its size. Each keeps its best views, and what the labeller said of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera

from .region_views import RegionView, ViewConfig, region_view
from .trigger import Candidate


@dataclass(frozen=True, slots=True)
class RegionConfig:
    views: int = 3  # the best, shown to the labeller
    views_first: int = 2  # before it is asked at all: a single glimpse may be a flaw of depth
    most_questions: int = 3  # about a region
    gain: float = 1.3  # of the views' summed quality, before it is asked again
    settled: float = 0.6  # of an answer that needs no second one
    near: float = 0.5  # of its size, between two sightings of a region
    least_quality: float = 0.02  # of a view: worse ones show a labeller nothing
    alike: float = 0.5  # its size of what an answer spoke of, or the other way round, to be that
    most: int = 256  # regions; the one not seen for longest is forgotten
    view: ViewConfig = field(default_factory=ViewConfig)

    def __post_init__(self) -> None:
        if min(self.views, self.views_first, self.most_questions, self.most) < 1:
            raise ConfigError(f"{self}: counts must be at least 1.")
        if not (0 <= self.least_quality <= 1 and 0 <= self.alike <= 1):
            raise ConfigError(f"{self}: least_quality and alike must be within 0..1.")
        if self.views_first > self.views or not (self.gain > 1 and self.near > 0):
            raise ConfigError(f"{self}: views_first at most views, gain over 1, near positive.")


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """What a labeller takes a region for, 0..1 `sure`, and where and how large it was in the
    keyframe it speaks of; no label: it is no object."""

    label: str
    sure: float
    keyframe: int
    p_camera: np.ndarray
    size_m: float


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """What is known of a region.

    keyframe, box_px, p_camera, size_m  newest sighting: its middle [3] in that keyframe's camera
    views           the best, the best first
    label, score    of the surest detector so far
    questions       asked so far; `quality` of the views, summed, when it was asked last
    answer          the surest
    """

    id: int
    keyframe: int
    box_px: tuple[float, float, float, float]
    p_camera: np.ndarray
    size_m: float
    views: tuple[RegionView, ...] = ()
    label: str = ""
    score: float = 0.0
    questions: int = 0
    quality: float = 0.0
    answer: Answer | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Question:
    """A region to be asked about now, and its newest sighting."""

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
        asked: list[Question] = []
        opinions: list[Opinion] = []
        taken = set[int]()
        for candidate in found:
            sighting = _sighting(keyframe, candidate, depth_m, camera)
            if sighting is None:
                continue
            region = self._same(sighting, T_map_keyframe, taken) or self._new(sighting)
            taken.add(region.id)
            args = keyframe, color, depth_m, camera, candidate.box_px, candidate.part
            region = self._with_view(_moved(region, sighting), region_view(*args, self.config.view))
            if self._is_due(region):
                quality = sum(view.quality for view in region.views)
                region = replace(region, questions=region.questions + 1, quality=quality)
                asked.append(Question(region, candidate))
            self._keep(region)
            opinions += self._said_of(region, sighting, candidate, T_map_keyframe)
        for candidate in named:
            sighting = _sighting(keyframe, candidate, depth_m, camera)
            region = sighting and self._same(sighting, T_map_keyframe, taken)
            if sighting and region:
                said = self._said_of(region, sighting, candidate, T_map_keyframe)
                if said:
                    taken.add(region.id)
                    self._keep(_moved(region, sighting))
                opinions += said
        self._forget()
        return Sightings(asked, opinions)

    def _keep(self, region: Region) -> None:
        """As the one seen last."""
        self._regions.pop(region.id, None)
        self._regions[region.id] = region

    def _said_of(
        self,
        region: Region,
        sighting: Region,
        candidate: Candidate,
        T_map_keyframe: Mapping[int, np.ndarray],
    ) -> list[Opinion]:
        """The answer, where what is seen now is where that spoke of, and about as large: what
        stands on a table is near enough to be the same region, and no table."""
        answer = region.answer
        if answer is None or not answer.label or answer.keyframe not in T_map_keyframe:
            return []
        small, large = sorted((answer.size_m, sighting.size_m))
        gap_m = np.linalg.norm(_in_map(answer, T_map_keyframe) - _in_map(sighting, T_map_keyframe))
        is_it = small >= self.config.alike * large and gap_m < self.config.near * small
        return [Opinion(candidate, answer.label, answer.sure)] if is_it else []

    def answered(self, region: int, answer: Answer) -> None:
        """The labeller has spoken of it; a confident answer needs no second one."""
        known = self._regions.get(region)
        if known is not None and answer.sure > (known.answer.sure if known.answer else 0):
            self._regions[region] = replace(known, answer=answer)

    def _same(
        self, sighting: Region, T_map_keyframe: Mapping[int, np.ndarray], taken: set[int]
    ) -> Region | None:
        """The nearest region that is near enough."""
        p_map = _in_map(sighting, T_map_keyframe)
        best, best_share = None, self.config.near
        for region in self._regions.values():
            if region.id in taken or region.keyframe not in T_map_keyframe:
                continue
            gap_m = float(np.linalg.norm(_in_map(region, T_map_keyframe) - p_map))
            share = gap_m / max(region.size_m, sighting.size_m)
            if share < best_share:
                best, best_share = region, share
        return best

    def _new(self, sighting: Region) -> Region:
        self._next_id += 1
        return replace(sighting, id=self._next_id - 1)

    def _with_view(self, region: Region, view: RegionView) -> Region:
        if view.quality < self.config.least_quality:
            return region
        views = sorted((*region.views, view), key=lambda view: -view.quality)
        return replace(region, views=tuple(views[: self.config.views]))

    def _is_due(self, region: Region) -> bool:
        is_settled = region.answer is not None and region.answer.sure >= self.config.settled
        if is_settled or region.questions >= self.config.most_questions:
            return False
        if region.questions == 0:
            return len(region.views) >= self.config.views_first
        return sum(view.quality for view in region.views) >= self.config.gain * region.quality

    def _forget(self) -> None:
        while len(self._regions) > self.config.most:
            del self._regions[next(iter(self._regions))]

    @property
    def packed(self) -> dict[str, Any]:
        """Plain values, bytes and lists, for a state."""
        regions = [_packed(region) for region in self._regions.values()]
        return {"next_id": self._next_id, "regions": regions}

    @staticmethod
    def unpacked(packed: dict[str, Any], config: RegionConfig) -> "RegionsToName":
        """As it was."""
        out = RegionsToName(config)
        out._next_id = packed["next_id"]
        out._regions = {row["id"]: _unpacked(row) for row in packed["regions"]}
        return out


def _packed(region: Region) -> dict[str, Any]:
    views = [{name: getattr(view, name) for name in RegionView.__slots__} for view in region.views]
    plain = {name: getattr(region, name) for name in Region.__slots__}
    answer = region.answer and [getattr(region.answer, name) for name in Answer.__slots__]
    return {**plain, "p_camera": region.p_camera.tolist(), "views": views, "answer": answer}


def _unpacked(row: Mapping[str, Any]) -> Region:
    views = tuple(RegionView(**{**view, "box_px": tuple(view["box_px"])}) for view in row["views"])
    changed = {"box_px": tuple(row["box_px"]), "p_camera": np.array(row["p_camera"])}
    answer = row["answer"] and Answer(*row["answer"])
    return Region(**{**row, **changed, "views": views, "answer": answer})


def _sighting(
    keyframe: int, candidate: Candidate, depth_m: np.ndarray, camera: Camera
) -> Region | None:
    """Without a place among the others yet; None where depth is missing."""
    part = candidate.part
    height, width = part.mask.shape
    window = depth_m[part.row : part.row + height, part.column : part.column + width]
    depths = window[part.mask & (window > 0)]
    if depths.size == 0:
        return None
    z_m = float(np.median(depths))
    rows, columns = np.nonzero(part.mask)
    u, v = part.column + columns.mean(), part.row + rows.mean()
    ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
    x0, y0, x1, y1 = (float(value) for value in candidate.box_px)
    size_m = float(np.sqrt((x1 - x0) * (y1 - y0) / (camera.fx * camera.fy))) * z_m
    box_px = (x0, y0, x1, y1)
    label, score = candidate.label, candidate.score
    return Region(-1, keyframe, box_px, z_m * ray, size_m, label=label, score=score)


def _moved(region: Region, sighting: Region) -> Region:
    """With its newest place, and the surer of two opinions."""
    surer = max(region, sighting, key=lambda one: one.score)
    return replace(
        region,
        keyframe=sighting.keyframe,
        box_px=sighting.box_px,
        p_camera=sighting.p_camera,
        size_m=sighting.size_m,
        label=surer.label,
        score=surer.score,
    )


def _in_map(region: Region | Answer, T_map_keyframe: Mapping[int, np.ndarray]) -> np.ndarray:
    T = T_map_keyframe[region.keyframe]
    return T[:3, :3] @ region.p_camera + T[:3, 3]
