"""Which regions of a keyframe are to be named by an open-vocabulary labeller (paper, III.B).

The paper asks when the best detector is less than 0.6 sure of a region, or gives it no reliable
label. So a candidate is a box of a hesitant detector that no sure box explains; or a region that
depth, creases or colour set apart, see `segments`, which neither a sure box nor the map's labels
explain. What stands on a thing is not explained by the name of that thing. A candidate is followed
from keyframe to keyframe by where it is, see `regions_tracked`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera
from ldo_service.geometry.boxes import ious, non_maximum_suppression

from .foreground import Foreground, ForegroundConfig, foreground, pixels_of, surfaces
from .geometric_segmentation import GeometricSegmentationConfig, Segment

_ORDER = ("flat", "apart", "standing", "convex")  # of regions alike, the first is kept


@dataclass(frozen=True, slots=True)
class RegionProposalConfig:
    sure: float = 0.6  # of a detector that nobody needs to help (III.B)
    same_iou: float = 0.5  # with a sure box: the hesitant one is of the same thing
    fits_iou: float = 0.6  # of a hesitant box and a region: the box's thing is the region
    alike_iou: float = 0.7  # of two regions' boxes: one of them is enough
    explained: float = 0.5  # share of an object's pixels that have a name already
    min_side_px: int = 24  # smaller ones show a labeller nothing
    max_share: float = 0.5  # of the image: larger ones are rooms, not objects
    min_fill: float = 0.25  # of its box: what fills less is a frame around something
    most: int = 32  # candidates of a keyframe, the largest first
    foreground: ForegroundConfig = field(default_factory=ForegroundConfig)
    segments: GeometricSegmentationConfig = field(default_factory=GeometricSegmentationConfig)

    def __post_init__(self) -> None:
        shares = self.sure, self.same_iou, self.fits_iou, self.alike_iou, self.explained
        shares = (*shares, self.max_share, self.min_fill)
        if not (min(shares) >= 0 and max(shares) <= 1):
            raise ConfigError(
                named(
                    self,
                    "sure",
                    "same_iou",
                    "fits_iou",
                    "alike_iou",
                    "explained",
                    "max_share",
                    "min_fill",
                )
                + ": shares and scores must be within 0..1."
            )
        if min(self.min_side_px, self.most) < 1:
            raise ConfigError(
                named(self, "min_side_px", "most") + ": sides and counts must be at least 1."
            )


@dataclass(frozen=True, eq=False, slots=True)
class RegionProposal:
    """A region that nobody has a reliable name for, or that the detector is sure of.

    box_px [4], x0 y0 x1 y1; part, what of the box it is; number, label and score of the detector's
    box, if it is one; kind of the segment, if it is one
    """

    box_px: np.ndarray
    part: Foreground
    label: str = ""
    score: float = 0.0
    number: int | None = None
    kind: str = ""


def propose_regions(
    boxes_px: np.ndarray,
    labels: Sequence[str],
    scores: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    is_labelled: np.ndarray,
    found: Sequence[RegionProposal],
    room: Sequence[Foreground],
    config: RegionProposalConfig,
) -> list[RegionProposal]:
    """Regions of a keyframe that a labeller should see, and those that the detector is sure of, to
    be followed; the largest first.

    boxes_px, labels, scores  [M, 4], M, [M] of the detector
    depth_m                   [H, W], 0 where it is missing
    is_labelled               [H, W] bool: the map has a reliable name for what this pixel shows
    found                     its regions, as `regions_of_image` finds them
    room                      planes of the room, see `segments`

    The same arguments give the same candidates.
    """
    asked, is_taken = _boxed(boxes_px, labels, scores, depth_m, camera, found, room, config)
    is_sure = np.asarray(scores) >= config.sure
    explained = is_labelled | _painted(boxes_px[is_sure], depth_m.shape)
    asked += [
        one
        for one, is_asked in zip(found, is_taken, strict=True)
        if not is_asked
        and (one.kind == "standing" or _share(explained, one.part) < config.explained)
    ]
    worth = [
        one
        for one in asked
        if one.score >= config.sure or _is_worth_a_look(one, depth_m.shape, config)
    ]
    size = {id(one): np.count_nonzero(one.part.mask) for one in worth}
    # a sure box is no question: it gives way where there is no room for both
    kept = sorted(worth, key=lambda c: (c.score >= config.sure, -size[id(c)]))[: config.most]
    return sorted(kept, key=lambda c: -size[id(c)])


def _boxed(
    boxes_px: np.ndarray,
    labels: Sequence[str],
    scores: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    found: Sequence[RegionProposal],
    room: Sequence[Foreground],
    config: RegionProposalConfig,
) -> tuple[list[RegionProposal], list[bool]]:
    """Boxes of a detector: each is the region that fits it best, else its foreground without the
    room, if that leaves enough to show. And which regions these are."""
    asked, is_taken, pieces = [], [False] * len(found), None
    regions_px = _boxes(found)
    for i in distinct_boxes(boxes_px, scores, config):
        label, score = labels[i], float(scores[i])
        fits = np.where(is_taken, 0, ious(regions_px, boxes_px[[i]])[:, 0])
        best = int(np.argmax(fits)) if len(fits) else -1
        if best >= 0 and fits[best] >= config.fits_iou:
            is_taken[best] = True
            asked.append(replace(found[best], label=label, score=score, number=i))
            continue
        pieces = pieces or surfaces(depth_m, camera, config.foreground)
        part = foreground(boxes_px[i], depth_m, pieces, camera, config.foreground)
        whole = RegionProposal(boxes_px[i], part, label, score, i)
        cut = replace(whole, part=remove_structure(part, room, config.foreground.min_inside))
        asked.append(cut if _is_worth_a_look(cut, depth_m.shape, config) else whole)
    return asked, is_taken


def remove_structure(part: Foreground, room: Sequence[Foreground], inside: float) -> Foreground:
    """Without those planes of the room that mostly go on outside of it: a wall between the leaves
    of a plant, a floor between the legs of a table. Where that is most of it, as of a clock on its
    wall, it stays whole. `inside`: share of a plane within the box, to be a part of the thing.

    >>> plant, wall = np.ones((2, 4), bool), np.zeros((6, 8), bool)
    >>> wall[:, 3:] = True
    >>> remove_structure(Foreground(2, 1, plant), [Foreground(0, 0, wall)], 0.5).mask[0].tolist()
    [True, True, False, False]
    """
    mask = part.mask.copy()
    for plane in room:
        here = plane.mask[pixels_of(part.box_px, plane.mask.shape)]
        rows, columns = here.shape
        if np.count_nonzero(here) < inside * np.count_nonzero(plane.mask):
            mask[:rows, :columns] &= ~here
    is_most_left = 2 * np.count_nonzero(mask) >= np.count_nonzero(part.mask)
    return Foreground(part.row, part.column, mask) if is_most_left else part


def labeled_regions(
    boxes_px: np.ndarray,
    is_labelled: np.ndarray,
    found: Sequence[RegionProposal],
    config: RegionProposalConfig,
) -> list[RegionProposal]:
    """Those of the regions `found` that the map has a reliable name for, is_labelled [H, W] bool,
    and no box [M, 4] is drawn about; but for what stands on a thing, which is a candidate."""
    return [
        one
        for one in found
        if one.kind != "standing"
        and _share(is_labelled, one.part) >= config.explained
        and np.all(ious(boxes_px, one.box_px[None]) < config.same_iou)
    ]


def regions_of_image(
    found: Sequence[Segment], shape: tuple[int, ...], config: RegionProposalConfig
) -> list[RegionProposal]:
    """The segments that a labeller could tell from an image [H, W], each once. What stands on a
    thing is no part of it."""
    out: list[RegionProposal] = []
    for kind in _ORDER:
        for segment in found:
            one = RegionProposal(segment.part.box_px, segment.part, kind=segment.kind)
            if segment.kind != kind or not _is_worth_a_look(one, shape, config):
                continue
            if np.all(ious(_boxes(out), one.box_px[None]) < config.alike_iou):
                out.append(one)
    stands = np.any([one.part.image(shape) for one in out if one.kind == "standing"], axis=0)
    return [_without(one, stands) if one.kind == "apart" and stands.any() else one for one in out]


def _without(one: RegionProposal, others: np.ndarray) -> RegionProposal:
    """Its part but for the pixels of others [H, W] bool."""
    part, (height, width) = one.part, one.part.mask.shape
    here = others[part.row : part.row + height, part.column : part.column + width]
    return replace(one, part=Foreground(part.row, part.column, part.mask & ~here))


def distinct_boxes(
    boxes_px: np.ndarray, scores: np.ndarray, config: RegionProposalConfig
) -> list[int]:
    """Of the same thing the best of them.

    >>> boxes = np.array([[0, 0, 10, 10], [1, 0, 10, 10], [20, 0, 30, 10.0]])
    >>> distinct_boxes(boxes, np.array([0.9, 0.4, 0.5]), RegionProposalConfig())
    [0, 2]
    """
    of_any_class = np.zeros(len(boxes_px), int)
    return non_maximum_suppression(boxes_px, scores, of_any_class, config.same_iou).tolist()


def _is_worth_a_look(
    candidate: RegionProposal, shape: tuple[int, ...], config: RegionProposalConfig
) -> bool:
    width, height = candidate.box_px[2:] - candidate.box_px[:2]
    size_px = np.count_nonzero(candidate.part.mask)
    is_object = size_px <= config.max_share * shape[0] * shape[1]
    is_filled = size_px >= config.min_fill * width * height
    return bool(is_object and is_filled and min(width, height) >= config.min_side_px)


def _share(explained: np.ndarray, part: Foreground) -> float:
    height, width = part.mask.shape
    here = explained[part.row : part.row + height, part.column : part.column + width]
    return float(here[part.mask].mean()) if part.mask.any() else 1.0


def _painted(boxes_px: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    image = np.zeros(shape, bool)
    for x0, y0, x1, y1 in np.round(boxes_px).astype(int).clip(0):
        image[y0 : y1 + 1, x0 : x1 + 1] = True
    return image


def _boxes(found: Sequence[RegionProposal]) -> np.ndarray:
    """[M, 4]"""
    return np.array([one.box_px for one in found], float).reshape(-1, 4)
