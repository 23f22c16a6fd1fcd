"""What is remembered of regions that nobody has a name for, and as plain values for a state."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ldo_service.geometry import Camera

from .foreground import Foreground
from .region_views import RegionView
from .trigger import Candidate
from .votes import Votes, with_box

Box = tuple[float, float, float, float]
MOST_POINTS = 96  # of a sighting, 12 bytes each


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """What a labeller takes a region for, 0..1 `sure`; no label: it is no object, or who knows.
    `others`: what else it may be, and how sure."""

    label: str
    sure: float
    others: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Sighting:
    """What a keyframe showed of a region, and points [P, 3] float32 of its surface in the camera's
    frame."""

    keyframe: int
    candidate: Candidate
    p_camera: np.ndarray

    @property
    def box_px(self) -> Box:
        x0, y0, x1, y1 = (float(value) for value in self.candidate.box_px)
        return x0, y0, x1, y1

    @property
    def size_px(self) -> int:
        return int(np.count_nonzero(self.candidate.part.mask))


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """What is known of a region.

    keyframe, box_px the newest sighting
    seen            keyframes that showed it
    shape           the sighting that others are compared with: the one that was asked about, until
                    then the largest
    best            the sighting that shows most of it
    views           the best, the best first
    label, score    of the surest detector so far
    votes           what speaks for each name
    questions       asked so far; `quality` of the views, summed, when it was asked last
    answer          the surest, without what else it may be
    is_standing     on a thing, as a keyframe showed: it is no part of that
    """

    id: int
    keyframe: int
    box_px: Box
    shape: Sighting
    seen: int = 0
    best: Sighting | None = None
    views: tuple[RegionView, ...] = ()
    label: str = ""
    score: float = 0.0
    votes: Votes = ()
    questions: int = 0
    quality: float = 0.0
    answer: Answer | None = None
    is_standing: bool = False

    def gained(self) -> float:
        """How much better its views are than when it was asked about."""
        return sum(view.quality for view in self.views) - self.quality


def sighting_of(
    keyframe: int, candidate: Candidate, depth_m: np.ndarray, camera: Camera
) -> Sighting | None:
    """None where depth is missing."""
    part = candidate.part
    rows, columns = np.nonzero(part.mask)
    rows, columns = rows + part.row, columns + part.column
    is_known = depth_m[rows, columns] > 0
    rows, columns = rows[is_known], columns[is_known]
    if len(rows) == 0:
        return None
    few = _spread(rows, columns)
    return Sighting(keyframe, candidate, _points(rows[few], columns[few], depth_m, camera))


def _spread(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Which of these pixels [N] to keep, MOST_POINTS at most: those on a grid, or every so many of
    what is too thin for it. Every so many of a rectangle would lie on a few lines."""
    step = max(1, int(np.sqrt(len(rows) / MOST_POINTS)))
    while True:
        on_grid = (rows % step == step // 2) & (columns % step == step // 2)
        if np.count_nonzero(on_grid) <= MOST_POINTS:
            break
        step += 1
    most = min(len(rows), MOST_POINTS)
    if 2 * np.count_nonzero(on_grid) >= most:
        return np.flatnonzero(on_grid)
    return np.linspace(0, len(rows) - 1, most).astype(int)


def _points(
    rows: np.ndarray, columns: np.ndarray, depth_m: np.ndarray, camera: Camera
) -> np.ndarray:
    z = depth_m[rows, columns]
    x, y = (columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z
    return np.stack([x, y, z], axis=1).astype(np.float32)


def seen_again(region: Region, seen: Sighting, most_boxes: float) -> Region:
    """With what is new of it, and the surer of two opinions; `most_boxes` is what all boxes of a
    name may speak for it."""
    said = seen.candidate
    surer = max(region, said, key=lambda one: one.score)
    is_larger = region.questions == 0 and seen.size_px > region.shape.size_px
    return replace(
        region,
        keyframe=seen.keyframe,
        box_px=seen.box_px,
        shape=seen if is_larger else region.shape,
        label=surer.label,
        score=surer.score,
        votes=with_box(region.votes, said.label, said.score, most_boxes),
        seen=region.seen + 1,
        is_standing=region.is_standing or said.kind == "standing",
    )


def packed(region: Region) -> dict[str, Any]:
    views = [{name: getattr(view, name) for name in RegionView.__slots__} for view in region.views]
    plain = {name: getattr(region, name) for name in Region.__slots__}
    answer = region.answer and [getattr(region.answer, name) for name in Answer.__slots__]
    best, shape = region.best and _packed_sighting(region.best), _packed_sighting(region.shape)
    return {**plain, "shape": shape, "best": best, "views": views, "answer": answer}


def unpacked(row: Mapping[str, Any]) -> Region:
    views = tuple(RegionView(**{**view, "box_px": tuple(view["box_px"])}) for view in row["views"])
    changed = {
        "box_px": tuple(row["box_px"]),
        "votes": tuple(tuple(vote) for vote in row["votes"]),
        "shape": _unpacked_sighting(*row["shape"]),
        "best": row["best"] and _unpacked_sighting(*row["best"]),
        "answer": row["answer"] and Answer(*row["answer"]),
    }
    return Region(**{**row, **changed, "views": views})


def _packed_sighting(seen: Sighting) -> list[Any]:
    """Without the number that its box had in its keyframe: nobody asks for it any more."""
    of = seen.candidate
    said = of.label, of.score, of.kind
    return [seen.keyframe, seen.p_camera, of.box_px, *said, *of.part.packed]


def _unpacked_sighting(
    keyframe: int, p_camera: np.ndarray, box_px: np.ndarray, *said: Any
) -> Sighting:
    label, score, kind, *part = said
    of = Candidate(box_px, Foreground.unpacked(*part), label, score, None, kind)
    return Sighting(keyframe, of, p_camera)
