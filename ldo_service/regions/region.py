"""One image region, followed over keyframes: its masks, views and votes for names."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ldo_service.geometry import Camera

from .foreground import Foreground
from .region_proposals import RegionProposal
from .region_views import RegionView

MAX_POINTS = 96  # of a sighting, 12 bytes each


Votes = tuple[tuple[str, float, float], ...]  # name, sum of its votes, the surest of them


def with_vote(votes: Votes, name: str, sure: float, weight: float = 1.0) -> Votes:
    """What is twice as sure counts four times. Of the demo's boxes that are 0.3 sure a third are
    right, of those that are 0.6 sure all but few.

    >>> votes = with_vote((("tv", 0.25, 0.5),), "tv", 0.6)
    >>> with_vote(votes, "oven", 0.5, weight=4)
    (('tv', 0.61, 0.6), ('oven', 1.0, 0.5))
    """
    return _added(votes, ((name, weight * sure**2, sure),)) if name else votes


def with_box(votes: Votes, name: str, sure: float, most: float) -> Votes:
    """As above, up to `most` in all: a box comes with every keyframe, and says the same again.

    >>> with_box(with_box((), "tv", 0.6, 0.4), "tv", 0.5, 0.4)
    (('tv', 0.4, 0.6),)
    """
    if not name or most <= 0:
        return votes
    had = next((total for one, total, _ in votes if one == name), 0.0)
    return _added(votes, ((name, min(sure**2, max(most - had, 0.0)), sure),))


def with_votes_of(votes: Votes, others: Votes, share: float) -> Votes:
    """With those of another region, of which 0..1 this is a `share`.

    >>> with_votes_of((("clock", 1.0, 0.5),), (("radiator", 2.0, 0.8), ("clock", 0.5, 0.4)), 0.5)
    (('clock', 1.25, 0.5), ('radiator', 1.0, 0.4))
    """
    return _added(votes, tuple((name, share * total, share * most) for name, total, most in others))


def winning_label(votes: Votes, least: float) -> tuple[str, float]:
    """What most speaks for, and how sure: as the surest was, by the share of all votes that are for
    it; nothing where the sum is less than `least`.

    >>> winning_label((("tv", 0.6, 0.5), ("oven", 0.4, 0.6)), 0.35)
    ('tv', 0.3)
    """
    name, total, most = max(votes, key=lambda vote: vote[1], default=("", 0.0, 0.0))
    if total == 0 or total < least:
        return "", 0.0
    return name, most * total / sum(one for _, one, _ in votes)


def _added(votes: Votes, more: Votes) -> Votes:
    sums = {name: (total, most) for name, total, most in votes}
    for name, total, most in more:
        before, surest = sums.get(name, (0.0, 0.0))
        sums[name] = before + total, max(surest, most)
    return tuple((name, *both) for name, both in sums.items())


Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False, slots=True)
class RegionLabelResult:
    """What a labeller takes a region for, 0..1 `sure`; no label: it is no object, or who knows.
    `others`: what else it may be, and how sure."""

    label: str
    confidence: float
    others: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class RegionObservation:
    """What a keyframe showed of a region, and points [P, 3] float32 of its surface in the camera's
    frame."""

    keyframe: int
    candidate: RegionProposal
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
    shape: RegionObservation
    seen: int = 0
    best: RegionObservation | None = None
    views: tuple[RegionView, ...] = ()
    label: str = ""
    score: float = 0.0
    votes: Votes = ()
    questions: int = 0
    quality: float = 0.0
    answer: RegionLabelResult | None = None
    is_supported: bool = False

    def view_quality_gain(self) -> float:
        """How much better its views are than when it was asked about."""
        return sum(view.quality for view in self.views) - self.quality


def observe_region(
    keyframe: int, candidate: RegionProposal, depth_m: np.ndarray, camera: Camera
) -> RegionObservation | None:
    """None where depth is missing."""
    part = candidate.part
    rows, columns = np.nonzero(part.mask)
    rows, columns = rows + part.row, columns + part.column
    is_known = depth_m[rows, columns] > 0
    rows, columns = rows[is_known], columns[is_known]
    if len(rows) == 0:
        return None
    few = _spread(rows, columns)
    rows, columns = rows[few], columns[few]
    p_camera = camera.points_at(columns, rows, depth_m[rows, columns]).astype(np.float32)
    return RegionObservation(keyframe, candidate, p_camera)


def _spread(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Which of these pixels [N] to keep, MOST_POINTS at most: those on a grid, or every so many of
    what is too thin for it. Every so many of a rectangle would lie on a few lines."""
    step = max(1, int(np.sqrt(len(rows) / MAX_POINTS)))
    while True:
        on_grid = (rows % step == step // 2) & (columns % step == step // 2)
        if np.count_nonzero(on_grid) <= MAX_POINTS:
            break
        step += 1
    most = min(len(rows), MAX_POINTS)
    if 2 * np.count_nonzero(on_grid) >= most:
        return np.flatnonzero(on_grid)
    return np.linspace(0, len(rows) - 1, most).astype(int)


def merge_observation(region: Region, seen: RegionObservation, most_boxes: float) -> Region:
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
        is_supported=region.is_supported or said.kind == "standing",
    )


def pack(region: Region) -> dict[str, Any]:
    views = [{name: getattr(view, name) for name in RegionView.__slots__} for view in region.views]
    plain = {name: getattr(region, name) for name in Region.__slots__}
    answer = region.answer and [
        getattr(region.answer, name) for name in RegionLabelResult.__slots__
    ]
    best, shape = region.best and _packed_sighting(region.best), _packed_sighting(region.shape)
    return {**plain, "shape": shape, "best": best, "views": views, "answer": answer}


def unpack(row: Mapping[str, Any]) -> Region:
    views = tuple(RegionView(**{**view, "box_px": tuple(view["box_px"])}) for view in row["views"])
    changed = {
        "box_px": tuple(row["box_px"]),
        "votes": tuple(tuple(vote) for vote in row["votes"]),
        "shape": _unpacked_sighting(*row["shape"]),
        "best": row["best"] and _unpacked_sighting(*row["best"]),
        "answer": row["answer"] and RegionLabelResult(*row["answer"]),
    }
    return Region(**{**row, **changed, "views": views})


def _packed_sighting(seen: RegionObservation) -> list[Any]:
    """Without the number that its box had in its keyframe: nobody asks for it any more."""
    of = seen.candidate
    said = of.label, of.score, of.kind
    return [seen.keyframe, seen.p_camera, of.box_px, *said, *of.part.pack()]


def _unpacked_sighting(
    keyframe: int, p_camera: np.ndarray, box_px: np.ndarray, *said: Any
) -> RegionObservation:
    label, score, kind, *part = said
    of = RegionProposal(box_px, Foreground.unpack(*part), label, score, None, kind)
    return RegionObservation(keyframe, of, p_camera)
