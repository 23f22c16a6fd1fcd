"""Region proposals of a keyframe for an open-vocabulary labeller.

The LDO-SLAM paper (III.B) requests a label for a region if the region's best detection has a score
below 0.6 or gives no reliable label. Two kinds of regions are therefore proposed:

- Boxes with a low score that do not show the object of a box with a high score.
- Segments by depth, creases or color (see `geometric_segmentation`) that match no box and whose
  pixels mostly have no reliable label in the map. A segment that stands on a labelled object is
  also proposed, because the label describes the object below the segment.

`region_tracker` follows proposals over keyframes by their positions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera
from ldo_service.geometry.boxes import ious, non_maximum_suppression

from .foreground import Foreground, ForegroundConfig, foreground, pixels_of, surfaces
from .geometric_segmentation import GeometricSegmentationConfig, Segment

_ORDER = ("flat", "apart", "standing", "convex")  # The first kind of similar regions is kept.


@dataclass(frozen=True, slots=True)
class RegionProposalConfig:
    """Settings of the region proposals.

    A region is a possible object in the image of a keyframe: the foreground of a detector's box, or
    a segment, see `geometric_segmentation`.
    """

    # Minimum score of a detection that needs no label request (LDO-SLAM paper, III.B).
    sure: float = 0.6
    # Minimum IoU of two boxes that show the same object; the box with the lower score is dropped.
    same_iou: float = 0.5
    # Minimum IoU of a detector's box and the box of a region that show the same object.
    fits_iou: float = 0.6
    # Minimum IoU of the boxes of two similar regions; only one of them is proposed.
    similar_iou: float = 0.7
    # Minimum fraction of pixels with a reliable label in a region that needs no label request.
    explained: float = 0.5
    min_side_px: int = (
        24  # Minimum side of a region's box; in smaller ones, a labeller sees nothing.
    )
    # Maximum size of a region as a fraction of the image; larger ones are rooms, not objects.
    max_share: float = 0.5
    # Minimum fraction of its box that a region fills; a region that fills less is a frame around
    # another object.
    min_fill: float = 0.25
    most: int = 32  # Maximum proposals of a keyframe; the largest regions are proposed.
    foreground: ForegroundConfig = field(default_factory=ForegroundConfig)
    segments: GeometricSegmentationConfig = field(default_factory=GeometricSegmentationConfig)

    def __post_init__(self) -> None:
        shares = self.sure, self.same_iou, self.fits_iou, self.similar_iou, self.explained
        shares = (*shares, self.max_share, self.min_fill)
        if not (min(shares) >= 0 and max(shares) <= 1):
            raise ConfigError(
                named(
                    self,
                    "sure",
                    "same_iou",
                    "fits_iou",
                    "similar_iou",
                    "explained",
                    "max_share",
                    "min_fill",
                )
                + ": these settings must be in [0, 1]."
            )
        if min(self.min_side_px, self.most) < 1:
            raise ConfigError(named(self, "min_side_px", "most") + ": both must be at least 1.")


@dataclass(frozen=True, eq=False, slots=True)
class RegionProposal:
    """Region without a reliable label, or region of a detector's box with a high score.

    Attributes:
        box_px: Box of the region, [4], x0 y0 x1 y1, pixels.
        part: Mask of the region.
        label: Label of the detector's box; empty without a box.
        score: Score of the detector's box, 0..1; 0 without a box.
        number: Index of the detector's box in the keyframe; None without a box.
        kind: Kind of the segment, see `geometric_segmentation`; empty if the region is the
            foreground of a box.
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
    """Return the regions of a keyframe that need a label, and the regions of high-score boxes.

    The region tracker follows both kinds. The result is deterministic.

    Args:
        boxes_px: Boxes of the detector, [M, 4], x0 y0 x1 y1, pixels.
        labels: Labels of the boxes, M.
        scores: Scores of the boxes, [M], 0..1.
        depth_m: Depth, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the depth.
        is_labelled: Pixels for which the map has a reliable label, [H, W] bool.
        found: Regions of the keyframe from `regions_of_image`.
        room: Structural planes, see `geometric_segmentation`.
        config: Settings.

    Returns:
        At most `config.most` regions, the largest first.
    """
    proposals, is_taken = _boxed(boxes_px, labels, scores, depth_m, camera, found, room, config)
    is_sure = np.asarray(scores) >= config.sure
    explained = is_labelled | _painted(boxes_px[is_sure], depth_m.shape)
    proposals += [
        one
        for one, is_selected in zip(found, is_taken, strict=True)
        if not is_selected
        and (one.kind == "standing" or _share(explained, one.part) < config.explained)
    ]
    worth = [
        one
        for one in proposals
        if one.score >= config.sure or _is_plausible(one, depth_m.shape, config)
    ]
    size = {id(one): np.count_nonzero(one.part.mask) for one in worth}
    # Boxes with a high score need no label request, so they are dropped first.
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
    """Return a proposal for each distinct box, and which of the regions `found` were used for them.

    The arguments are those of `propose_regions`. A proposal has the mask of the region that fits
    the box best. If no region fits, the mask is the foreground of the box; structural planes are
    removed from the foreground if the remainder is large enough.
    """
    proposals, is_taken, pieces = [], [False] * len(found), None
    regions_px = _boxes(found)
    for i in distinct_boxes(boxes_px, scores, config):
        label, score = labels[i], float(scores[i])
        fits = np.where(is_taken, 0, ious(regions_px, boxes_px[[i]])[:, 0])
        best = int(np.argmax(fits)) if len(fits) else -1
        if best >= 0 and fits[best] >= config.fits_iou:
            is_taken[best] = True
            proposals.append(replace(found[best], label=label, score=score, number=i))
            continue
        pieces = pieces or surfaces(depth_m, camera, config.foreground)
        part = foreground(boxes_px[i], depth_m, pieces, camera, config.foreground)
        whole = RegionProposal(boxes_px[i], part, label, score, i)
        cut = replace(whole, part=remove_structure(part, room, config.foreground.min_inside))
        proposals.append(cut if _is_plausible(cut, depth_m.shape, config) else whole)
    return proposals, is_taken


def remove_structure(part: Foreground, room: Sequence[Foreground], inside: float) -> Foreground:
    """Remove from an object's mask the structural planes that lie mostly outside of its box.

    Examples are the wall between the leaves of a plant, and the floor between the legs of a table.
    The mask stays unchanged if most of it would be removed. An example is a clock, whose mask lies
    on the plane of the wall.

    Args:
        part: The mask of the object.
        room: Structural planes.
        inside: Fraction, 0..1. A plane is removed if less than this fraction of it is in the box.

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
    """Return the regions in `found` that have a reliable label in the map and match no box.

    The labeller need not label these regions again. Regions of the kind `standing`, such as a cup
    on a table, are never among them, because the label in the map may be that of the table.

    Args:
        boxes_px: Boxes of the detector, [M, 4], x0 y0 x1 y1, pixels.
        is_labelled: Pixels for which the map has a reliable label, [H, W] bool.
        found: Regions of the keyframe from `regions_of_image`.
        config: Settings.
    """
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
    """Return the segments of an image that a labeller could recognize, without near duplicates.

    A segment of the kind `standing` lies inside a segment of the kind `apart`: for example, a cup
    and the table below it. The pixels of the cup are removed from the mask of the table.

    Args:
        found: Segments of the image, see `geometric_segmentation`.
        shape: Height and width of the image.
        config: Settings.
    """
    out: list[RegionProposal] = []
    for kind in _ORDER:
        for segment in found:
            one = RegionProposal(segment.part.box_px, segment.part, kind=segment.kind)
            if segment.kind != kind or not _is_plausible(one, shape, config):
                continue
            if np.all(ious(_boxes(out), one.box_px[None]) < config.similar_iou):
                out.append(one)
    stands = np.any([one.part.image(shape) for one in out if one.kind == "standing"], axis=0)
    return [_without(one, stands) if one.kind == "apart" and stands.any() else one for one in out]


def _without(one: RegionProposal, others: np.ndarray) -> RegionProposal:
    """Return a region without the pixels `others`, [H, W] bool."""
    part, (height, width) = one.part, one.part.mask.shape
    here = others[part.row : part.row + height, part.column : part.column + width]
    return replace(one, part=Foreground(part.row, part.column, part.mask & ~here))


def distinct_boxes(
    boxes_px: np.ndarray, scores: np.ndarray, config: RegionProposalConfig
) -> list[int]:
    """Return the indices of the boxes that show different objects.

    Of several boxes that show the same object, the one with the highest score is returned. Two
    boxes show the same object if their IoU exceeds `same_iou`.

    >>> boxes = np.array([[0, 0, 10, 10], [1, 0, 10, 10], [20, 0, 30, 10.0]])
    >>> distinct_boxes(boxes, np.array([0.9, 0.4, 0.5]), RegionProposalConfig())
    [0, 2]
    """
    of_any_class = np.zeros(len(boxes_px), int)
    return non_maximum_suppression(boxes_px, scores, of_any_class, config.same_iou).tolist()


def _is_plausible(
    candidate: RegionProposal, shape: tuple[int, ...], config: RegionProposalConfig
) -> bool:
    """Return whether a region has the size of an object and fills enough of its box."""
    width, height = candidate.box_px[2:] - candidate.box_px[:2]
    size_px = np.count_nonzero(candidate.part.mask)
    is_object = size_px <= config.max_share * shape[0] * shape[1]
    is_filled = size_px >= config.min_fill * width * height
    return bool(is_object and is_filled and min(width, height) >= config.min_side_px)


def _share(explained: np.ndarray, part: Foreground) -> float:
    """Return the fraction of a mask's pixels that are true in `explained`; 1 for an empty mask."""
    height, width = part.mask.shape
    here = explained[part.row : part.row + height, part.column : part.column + width]
    return float(here[part.mask].mean()) if part.mask.any() else 1.0


def _painted(boxes_px: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the pixels of an image [H, W] that lie in any of the boxes [M, 4], [H, W] bool."""
    image = np.zeros(shape, bool)
    for x0, y0, x1, y1 in np.round(boxes_px).astype(int).clip(0):
        image[y0 : y1 + 1, x0 : x1 + 1] = True
    return image


def _boxes(found: Sequence[RegionProposal]) -> np.ndarray:
    """Return the boxes of regions, [M, 4]."""
    return np.array([one.box_px for one in found], float).reshape(-1, 4)
