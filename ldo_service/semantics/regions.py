"""What is remembered of regions that nobody has a name for, and as plain values for a state."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ldo_service.geometry import Camera

from .foreground import Foreground
from .region_views import RegionView
from .trigger import Candidate

Box = tuple[float, float, float, float]


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
class Sighting:
    """What a keyframe showed of a region: its middle [3] in the camera's frame, and how large."""

    keyframe: int
    candidate: Candidate
    p_camera: np.ndarray
    size_m: float

    @property
    def box_px(self) -> Box:
        x0, y0, x1, y1 = (float(value) for value in self.candidate.box_px)
        return x0, y0, x1, y1


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """What is known of a region.

    keyframe, box_px, p_camera, size_m  newest sighting: its middle [3] in that keyframe's camera
    seen            keyframes that showed it
    best            the sighting that shows most of it
    views           the best, the best first
    label, score    of the surest detector so far
    questions       asked so far; `quality` of the views, summed, when it was asked last
    answer          the surest
    """

    id: int
    keyframe: int
    box_px: Box
    p_camera: np.ndarray
    size_m: float
    seen: int = 0
    best: Sighting | None = None
    views: tuple[RegionView, ...] = ()
    label: str = ""
    score: float = 0.0
    questions: int = 0
    quality: float = 0.0
    answer: Answer | None = None

    def gained(self) -> float:
        """How much better its views are than when it was asked about."""
        return sum(view.quality for view in self.views) - self.quality


def sighting_of(
    keyframe: int, candidate: Candidate, depth_m: np.ndarray, camera: Camera
) -> Sighting | None:
    """None where depth is missing."""
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
    return Sighting(keyframe, candidate, z_m * ray, size_m)


def moved(region: Region, seen: Sighting) -> Region:
    """With its newest place, and the surer of two opinions."""
    surer = max(region, seen.candidate, key=lambda one: one.score)
    return replace(
        region,
        keyframe=seen.keyframe,
        box_px=seen.box_px,
        p_camera=seen.p_camera,
        size_m=seen.size_m,
        label=surer.label,
        score=surer.score,
        seen=region.seen + 1,
    )


def in_map(
    region: Region | Answer | Sighting, T_map_keyframe: Mapping[int, np.ndarray]
) -> np.ndarray:
    T = T_map_keyframe[region.keyframe]
    return T[:3, :3] @ region.p_camera + T[:3, 3]


def packed(region: Region) -> dict[str, Any]:
    views = [{name: getattr(view, name) for name in RegionView.__slots__} for view in region.views]
    plain = {name: getattr(region, name) for name in Region.__slots__}
    answer = region.answer and [getattr(region.answer, name) for name in Answer.__slots__]
    best = region.best and _packed_sighting(region.best)
    place = region.p_camera.tolist()
    return {**plain, "p_camera": place, "best": best, "views": views, "answer": answer}


def unpacked(row: Mapping[str, Any]) -> Region:
    views = tuple(RegionView(**{**view, "box_px": tuple(view["box_px"])}) for view in row["views"])
    changed = {"box_px": tuple(row["box_px"]), "p_camera": np.array(row["p_camera"])}
    answer = row["answer"] and Answer(*row["answer"])
    best = row["best"] and _unpacked_sighting(*row["best"])
    return Region(**{**row, **changed, "best": best, "views": views, "answer": answer})


def _packed_sighting(seen: Sighting) -> list[Any]:
    """Without the number that its box had in its keyframe: nobody asks for it any more."""
    of = seen.candidate
    said = of.label, of.score, of.kind
    return [seen.keyframe, seen.p_camera, seen.size_m, of.box_px, *said, *of.part.packed]


def _unpacked_sighting(
    keyframe: int, p_camera: np.ndarray, size_m: float, box_px: np.ndarray, *said: Any
) -> Sighting:
    label, score, kind, *part = said
    of = Candidate(box_px, Foreground.unpacked(*part), label, score, None, kind)
    return Sighting(keyframe, of, p_camera, size_m)
