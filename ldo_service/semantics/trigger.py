"""Which regions of a keyframe are to be named by an open-vocabulary labeller (paper, III.B).

The paper asks when the best detector is less than 0.6 sure of a region, or gives it no reliable
label. So a candidate is a box of a hesitant detector that no sure box explains; or an object that
depth sets apart from walls and floors, which neither a sure box nor the map's labels explain. A
candidate is followed from keyframe to keyframe by where it is, see `regions_to_name`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera

from .foreground import Foreground, ForegroundConfig, Surfaces, foreground

_3X3 = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class TriggerConfig:
    sure: float = 0.6  # of a detector that nobody needs to help (III.B)
    same_iou: float = 0.5  # with a sure box: the hesitant one is of the same thing
    explained: float = 0.5  # share of an object's pixels that have a name already
    min_side_px: int = 24  # smaller ones show a labeller nothing
    max_share: float = 0.25  # of the image: larger ones are rooms, not objects
    # Of the image: a surface as large is wall, floor or ceiling; and then, for what stands on it, a
    # table top.
    structure_shares: tuple[float, ...] = (0.06, 0.01)
    edge_px: int = 6  # of such a surface: where `surfaces` has no normal, 4 px and a blur
    opening_px: int = 5  # what is thinner is the edge between two walls
    min_fill: float = 0.25  # of its box: what fills less is a frame around something
    most: int = 16  # candidates of a keyframe, the largest first
    foreground: ForegroundConfig = field(default_factory=ForegroundConfig)

    def __post_init__(self) -> None:
        shares = self.sure, self.same_iou, self.explained, self.max_share
        shares = (*shares, self.min_fill, *self.structure_shares)
        if not (min(shares) >= 0 and max(shares) <= 1):
            raise ConfigError(f"{self}: shares and scores must be within 0..1.")
        if min(self.min_side_px, self.opening_px, self.most) < 1:
            raise ConfigError(f"{self}: sides and counts must be at least 1.")


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """A region that nobody has a reliable name for.

    box_px [4], x0 y0 x1 y1; part, what of the box it is; number, label and score of the detector's
    box, if it is one
    """

    box_px: np.ndarray
    part: Foreground
    label: str = ""
    score: float = 0.0
    number: int | None = None


def candidates(
    boxes_px: np.ndarray,
    labels: Sequence[str],
    scores: np.ndarray,
    depth_m: np.ndarray,
    found: Surfaces,
    camera: Camera,
    is_labelled: np.ndarray,
    apart: Sequence[Candidate],
    config: TriggerConfig,
) -> list[Candidate]:
    """Regions of a keyframe that a labeller should see, the largest first.

    boxes_px, labels, scores  [M, 4], M, [M] of the detector
    depth_m, found            [H, W], 0 where it is missing, and its surfaces
    is_labelled               [H, W] bool: the map has a reliable name for what this pixel shows
    apart                     its objects, as `standing_apart` finds them

    The same arguments give the same candidates.
    """
    is_sure = np.asarray(scores) >= config.sure
    hesitant = hesitant_boxes(boxes_px, scores, config)
    asked = [
        Candidate(
            boxes_px[i],
            foreground(boxes_px[i], depth_m, found, camera, config.foreground),
            labels[i],
            float(scores[i]),
            i,
        )
        for i in hesitant
    ]
    explained = is_labelled | _painted(boxes_px[is_sure], depth_m.shape)
    for candidate in asked:
        explained = explained | candidate.part.image(depth_m.shape)
    unexplained = [one for one in apart if _share(explained, one.part) < config.explained]
    asked += [one for one in unexplained if _is_new(one, [a.box_px for a in asked], config)]
    worth = [c for c in asked if _is_worth_a_look(c, depth_m.shape, config)]
    return sorted(worth, key=lambda c: -np.count_nonzero(c.part.mask))[: config.most]


def named_objects(
    boxes_px: np.ndarray,
    is_labelled: np.ndarray,
    apart: Sequence[Candidate],
    config: TriggerConfig,
) -> list[Candidate]:
    """Those of the objects `apart` that the map has a reliable name for, is_labelled [H, W] bool,
    and no box [M, 4] is drawn about."""
    return [
        one
        for one in apart
        if _share(is_labelled, one.part) >= config.explained
        and _is_new(one, list(boxes_px), config)
    ]


def standing_apart(depth_m: np.ndarray, found: Surfaces, config: TriggerConfig) -> list[Candidate]:
    """Objects that depth [H, W] sets apart from structure, each once. What stands on one is no part
    of it."""
    out: list[Candidate] = []
    for share in config.structure_shares:
        parts = depth_objects(depth_m, found, share, config)
        known = [one.box_px for one in out]
        finer = [
            one
            for one in (Candidate(_box(part), part) for part in parts)
            if _is_worth_a_look(one, depth_m.shape, config) and _is_new(one, known, config)
        ]
        stands = np.any([one.part.image(depth_m.shape) for one in finer], axis=0) if finer else None
        out = [one if stands is None else _without(one, stands) for one in out] + finer
    return out


def _without(one: Candidate, others: np.ndarray) -> Candidate:
    """Its part but for the pixels of others [H, W] bool."""
    part, (height, width) = one.part, one.part.mask.shape
    here = others[part.row : part.row + height, part.column : part.column + width]
    return replace(one, part=Foreground(part.row, part.column, part.mask & ~here))


def _is_new(one: Candidate, boxes_px: Sequence[np.ndarray], config: TriggerConfig) -> bool:
    return all(_iou(one.box_px, box_px) < config.same_iou for box_px in boxes_px)


def hesitant_boxes(boxes_px: np.ndarray, scores: np.ndarray, config: TriggerConfig) -> list[int]:
    """Those that the detector is not sure of, and of the same thing the best of them.

    >>> boxes = np.array([[0, 0, 10, 10], [1, 0, 10, 10], [20, 0, 30, 10.0]])
    >>> hesitant_boxes(boxes, np.array([0.9, 0.4, 0.5]), TriggerConfig())
    [2]
    """
    kept: list[int] = []
    for i in np.argsort(-np.asarray(scores), kind="stable"):
        if all(_iou(boxes_px[i], boxes_px[k]) < config.same_iou for k in kept):
            kept.append(int(i))
    return [i for i in kept if scores[i] < config.sure]


def depth_objects(
    depth_m: np.ndarray, found: Surfaces, structure_share: float, config: TriggerConfig
) -> list[Foreground]:
    """What stands apart in depth once surfaces over this share of the image are taken away."""
    is_structure = found.sizes > structure_share * depth_m.size
    is_structure[0] = False  # edges
    joined = _joined(depth_m, config.foreground.max_gap)
    structure = _with_edges(
        is_structure[found.labels], joined & (found.labels == 0), config.edge_px
    )
    side = np.ones((config.opening_px, config.opening_px), np.uint8)
    apart = cv2.morphologyEx((joined & ~structure).astype(np.uint8), cv2.MORPH_OPEN, side)
    return list(_components(apart))


def _joined(depth_m: np.ndarray, max_gap: float) -> np.ndarray:
    """Measured, and without a step of depth to a neighbour."""
    inverse = np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-6), 0).astype(np.float32)
    low = cv2.erode(inverse, _3X3)
    return (low > 0) & (cv2.dilate(inverse, _3X3) <= (1 + max_gap) * low)


def _with_edges(structure: np.ndarray, edges: np.ndarray, grow_px: int) -> np.ndarray:
    """Surfaces end some pixels before their edges do, because normals are taken across pixels."""
    for _ in range(grow_px):
        structure = structure | (edges & (cv2.dilate(structure.astype(np.uint8), _3X3) > 0))
    return structure


def _components(mask: np.ndarray) -> Iterator[Foreground]:
    count, parts, boxes, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    for part in range(1, count):
        column, row, width, height, _area = (int(value) for value in boxes[part])
        window = np.asarray(parts)[row : row + height, column : column + width]
        yield Foreground(row, column, window == part)


def _is_worth_a_look(candidate: Candidate, shape: tuple[int, ...], config: TriggerConfig) -> bool:
    width, height = candidate.box_px[2:] - candidate.box_px[:2]
    size_px = np.count_nonzero(candidate.part.mask)
    is_object = size_px <= config.max_share * shape[0] * shape[1]
    is_filled = size_px >= config.min_fill * width * height
    return bool(is_object and is_filled and min(width, height) >= config.min_side_px)


def _box(part: Foreground) -> np.ndarray:
    height, width = part.mask.shape
    return np.array(
        [part.column - 0.5, part.row - 0.5, part.column + width - 0.5, part.row + height - 0.5]
    )


def _share(explained: np.ndarray, part: Foreground) -> float:
    height, width = part.mask.shape
    here = explained[part.row : part.row + height, part.column : part.column + width]
    return float(here[part.mask].mean()) if part.mask.any() else 1.0


def _painted(boxes_px: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    image = np.zeros(shape, bool)
    for x0, y0, x1, y1 in np.round(boxes_px).astype(int).clip(0):
        image[y0 : y1 + 1, x0 : x1 + 1] = True
    return image


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    both = float(np.prod(np.maximum(sides, 0)))
    return both / (float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2])) - both)
