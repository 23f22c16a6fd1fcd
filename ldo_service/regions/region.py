"""Region track: an image region over keyframes, with its masks, views, votes and labels."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ldo_service.geometry import Camera

from .foreground import Foreground
from .region_proposals import RegionProposal
from .region_views import RegionView

MAX_POINTS = 96  # Maximum points per observation, 12 bytes each.


# Votes of a region, one entry per label: label, sum of its votes, highest confidence of a vote.
Votes = tuple[tuple[str, float, float], ...]


def with_vote(votes: Votes, name: str, sure: float, weight: float = 1.0) -> Votes:
    """Add a vote for the label `name`; with an empty name, nothing is added.

    The value of the vote is `weight` times the square of the confidence `sure`, 0..1. The square is
    used because boxes with high scores are right far more often. In the frames of `ldo demo`,
    nearly all boxes with a score of 0.6 are right, but only a third of those with a score of 0.3.

    Votes are tuples (label, sum of its votes, highest confidence of a vote).

    >>> votes = with_vote((("tv", 0.25, 0.5),), "tv", 0.6)
    >>> with_vote(votes, "oven", 0.5, weight=4)
    (('tv', 0.61, 0.6), ('oven', 1.0, 0.5))
    """
    return _added(votes, ((name, weight * sure**2, sure),)) if name else votes


def with_box(votes: Votes, name: str, sure: float, most: float) -> Votes:
    """Add the vote of a detector's box for a label; boxes raise the label's sum to at most `most`.

    The limit exists because the detector finds the same box again in each keyframe, so boxes alone
    could outweigh a result of the labeller. The vote is the square of the score, cut at the limit.

    Args:
        votes: Earlier votes: tuples (label, sum of its votes, highest confidence of a vote).
        name: Label of the box; if empty, nothing is added.
        sure: Score of the box, 0..1.
        most: Maximum sum of the votes for the label; at a larger sum, the box adds nothing.

    Example: with the limit 0.4, a box with a score of 0.6 adds 0.36. The next box has a score of
    0.5. Its vote of 0.25 is cut to 0.04, so that the sum is 0.4.

    >>> with_box(with_box((), "tv", 0.6, 0.4), "tv", 0.5, 0.4)
    (('tv', 0.4, 0.6),)
    """
    if not name or most <= 0:
        return votes
    had = next((total for one, total, _ in votes if one == name), 0.0)
    return _added(votes, ((name, min(sure**2, max(most - had, 0.0)), sure),))


def with_votes_of(votes: Votes, others: Votes, share: float) -> Votes:
    """Add the votes of another region.

    The sums and confidences of the other region are first multiplied by `share`, 0..1. Sums of the
    same label are then added, and the larger confidence is used.

    >>> with_votes_of((("clock", 1.0, 0.5),), (("radiator", 2.0, 0.8), ("clock", 0.5, 0.4)), 0.5)
    (('clock', 1.25, 0.5), ('radiator', 1.0, 0.4))
    """
    return _added(votes, tuple((name, share * total, share * most) for name, total, most in others))


def winning_label(votes: Votes, least: float) -> tuple[str, float]:
    """Return the label with the largest sum of votes, and its confidence.

    Each entry of `votes` has a label, the sum of its votes, and the highest confidence of one of
    these votes. The returned confidence is the winning label's highest confidence, times the
    label's fraction of all votes. The result is ("", 0) if the largest sum is below `least`.

    >>> winning_label((("tv", 0.6, 0.5), ("oven", 0.4, 0.6)), 0.35)
    ('tv', 0.3)
    """
    name, total, most = max(votes, key=lambda vote: vote[1], default=("", 0.0, 0.0))
    if total == 0 or total < least:
        return "", 0.0
    return name, most * total / sum(one for _, one, _ in votes)


def _added(votes: Votes, more: Votes) -> Votes:
    """Add two sets of votes label by label; the higher confidence of each label is kept."""
    sums = {name: (total, most) for name, total, most in votes}
    for name, total, most in more:
        before, surest = sums.get(name, (0.0, 0.0))
        sums[name] = before + total, max(surest, most)
    return tuple((name, *both) for name, both in sums.items())


Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False, slots=True)
class RegionLabelResult:
    """Label result of a labeller for a region.

    Attributes:
        label: Label; empty if the region shows no object or the labeller has no label for it.
        confidence: Confidence of the label, 0..1.
        others: Alternative labels and their confidences, 0..1.
    """

    label: str
    confidence: float
    others: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class RegionObservation:
    """Observation of a region in a keyframe.

    Attributes:
        keyframe: Id of the keyframe.
        candidate: Box, mask and label of the region in the keyframe.
        p_camera: Points on the surface of the region, in the keyframe's camera frame, [P, 3]
            float32, meters.
    """

    keyframe: int
    candidate: RegionProposal
    p_camera: np.ndarray

    @property
    def box_px(self) -> Box:
        """Box of the observation as x0, y0, x1, y1, pixels."""
        x0, y0, x1, y1 = (float(value) for value in self.candidate.box_px)
        return x0, y0, x1, y1

    @property
    def size_px(self) -> int:
        """Number of pixels of the mask."""
        return int(np.count_nonzero(self.candidate.part.mask))

    def surface_m2(self, camera: Camera) -> float:
        """Return the visible area in m^2, assuming that the surface faces the camera."""
        if not len(self.p_camera):
            return 0.0
        depth_m = float(np.median(self.p_camera[:, 2]))
        return self.size_px * depth_m**2 / (camera.fx * camera.fy)


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """Region track over keyframes.

    Attributes:
        id: Id of the region.
        keyframe: Keyframe of the newest observation.
        box_px: Box of the newest observation, x0 y0 x1 y1, pixels.
        shape: Observation with which later observations are compared. Before the first label
            request, this is the largest observation; later, it is the observation in that request.
        seen: Number of keyframes that observed the region.
        best: Observation with the best view; None without a view.
        views: Best views, the best first.
        label: Label of the detector's box with the highest score; empty without a box.
        score: Score of the box with the highest score, 0..1; 0 without a box.
        votes: Votes for each label.
        questions: Number of label requests so far.
        quality: Summed quality of the views at the last label request; 0 before any request.
        answer: Label result with the highest confidence, without its alternative labels; None
            before any label result.
        is_supported: True if the region stood on another object in any keyframe. The region is then
            a separate object and not a part of the other object.
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

    def surface_m2(self, camera: Camera | None) -> float:
        """Return the area in the best view in m^2, assuming that the surface faces the camera.

        The area is 0 without a view, or if the camera of the view is unknown.
        """
        return self.best.surface_m2(camera) if self.best and camera else 0.0

    def view_quality_gain(self) -> float:
        """Return the gain in summed view quality since the last label request."""
        return sum(view.quality for view in self.views) - self.quality


@dataclass(frozen=True, eq=False, slots=True)
class RegionRequest:
    """Label request for a region, with its best observation."""

    region: Region
    candidate: RegionProposal


@dataclass(frozen=True, eq=False, slots=True)
class RegionLabel:
    """Label of a region in a keyframe."""

    of: RegionProposal  # Box and mask of the region in the keyframe.
    label: str
    sure: float  # Confidence of the label, 0..1.


@dataclass(frozen=True, eq=False, slots=True)
class RegionUpdate:
    """Result of tracking the regions of a keyframe."""

    questions: list[RegionRequest]  # New label requests.
    region_labels: list[RegionLabel]  # Labels of the keyframe's regions.


def observe_region(
    keyframe: int, candidate: RegionProposal, depth_m: np.ndarray, camera: Camera
) -> RegionObservation | None:
    """Create the observation of a region in a keyframe, with points on the region's surface.

    Args:
        keyframe: Id of the keyframe.
        candidate: Region in the keyframe.
        depth_m: Depth, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the depth.

    Returns:
        The observation; None if no pixel of the region has depth.
    """
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
    """Select at most MAX_POINTS of a region's pixels, spread evenly over the region.

    The selected pixels lie on a square grid. If the region is too thin for a grid, every n-th pixel
    is selected instead. In other regions, every n-th pixel could lie on a few lines only.

    Args:
        rows: Rows of the region's pixels, [N].
        columns: Columns of the pixels, [N].

    Returns:
        Indices of the selected pixels.
    """
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


def merge_observation(region: Region, seen: RegionObservation, max_box_votes: float) -> Region:
    """Return a region with an observation added; the views of the region do not change.

    Args:
        region: The region.
        seen: The observation.
        max_box_votes: Maximum vote sum that a label can reach by boxes alone, see `with_box`.
    """
    proposal = seen.candidate
    surer = max(region, proposal, key=lambda one: one.score)
    is_larger = region.questions == 0 and seen.size_px > region.shape.size_px
    return replace(
        region,
        keyframe=seen.keyframe,
        box_px=seen.box_px,
        shape=seen if is_larger else region.shape,
        label=surer.label,
        score=surer.score,
        votes=with_box(region.votes, proposal.label, proposal.score, max_box_votes),
        seen=region.seen + 1,
        is_supported=region.is_supported or proposal.kind == "standing",
    )


def pack(region: Region) -> dict[str, Any]:
    """Return a region as plain values and arrays for a checkpoint."""
    views = [{name: getattr(view, name) for name in RegionView.__slots__} for view in region.views]
    plain = {name: getattr(region, name) for name in Region.__slots__}
    answer = region.answer and [
        getattr(region.answer, name) for name in RegionLabelResult.__slots__
    ]
    best, shape = (
        region.best and _packed_observation(region.best),
        _packed_observation(region.shape),
    )
    return {**plain, "shape": shape, "best": best, "views": views, "answer": answer}


def unpack(row: Mapping[str, Any]) -> Region:
    """Restore a region from `pack`."""
    views = tuple(RegionView(**{**view, "box_px": tuple(view["box_px"])}) for view in row["views"])
    changed = {
        "box_px": tuple(row["box_px"]),
        "votes": tuple(tuple(vote) for vote in row["votes"]),
        "shape": _unpacked_observation(*row["shape"]),
        "best": row["best"] and _unpacked_observation(*row["best"]),
        "answer": row["answer"] and RegionLabelResult(*row["answer"]),
    }
    return Region(**{**row, **changed, "views": views})


def _packed_observation(seen: RegionObservation) -> list[Any]:
    """Return an observation as a list, for a checkpoint.

    The number of the detector's box is omitted, because only its own keyframe uses it.
    """
    of = seen.candidate
    label_fields = of.label, of.score, of.kind
    return [seen.keyframe, seen.p_camera, of.box_px, *label_fields, *of.part.pack()]


def _unpacked_observation(
    keyframe: int, p_camera: np.ndarray, box_px: np.ndarray, *label_fields: Any
) -> RegionObservation:
    label, score, kind, *part = label_fields
    of = RegionProposal(box_px, Foreground.unpack(*part), label, score, None, kind)
    return RegionObservation(keyframe, of, p_camera)
