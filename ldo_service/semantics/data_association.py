"""Which landmark of the map is which region of a keyframe (paper, III.C).

The box of a landmark is that of its members in the image, where measured depth does not hide them:
what a detector would draw about what it can see of it. A landmark and a region may be the same if

    IoU of their boxes >= 0.4,  they share a class,  and their depths meet;

of all ways to pair them the one with the largest sum of IoU is taken. Before, regions that show a
part of what another shows are made one with it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera
from ldo_service.geometry.boxes import areas, intersections, ious

from .distributions import common_mass, mean_distributions
from .object_landmarks import MEMBERS, NO_MEMBER, reliable_members, rows_of, shuffled, trimmed

PROBES = 128  # members that are projected: the first when shuffled are a sample of the sample


@dataclass(frozen=True, slots=True)
class AssociationConfig:
    min_iou: float = 0.4  # of the boxes (III.C)
    min_shared: float = 0.3  # of the classes: a cup on a table is in its box, and no table
    max_depth_gap_m: float = 0.1  # between their depths, and of members hidden (delta_z, III.A)
    min_gaussians: int = 8  # of a region: with fewer nothing is known of where it is
    max_regions: int = 64  # per keyframe, those with the most Gaussians: COCO images have 7
    # Detectors box a plant, its crown and its pot. The share of a box in a larger one of its class,
    # at the same depth, to show a part of what that shows; above 1 none does:
    part_inside: float = 0.9

    def __post_init__(self) -> None:
        if not (0 < self.min_iou <= 1 and 0 <= self.min_shared <= 1):
            raise ConfigError(
                named(self, "min_iou", "min_shared")
                + ": min_iou must be in (0, 1], min_shared in 0..1."
            )
        if self.max_depth_gap_m <= 0 or min(self.min_gaussians, self.max_regions) < 1:
            raise ConfigError(
                named(self, "max_depth_gap_m", "min_gaussians", "max_regions")
                + ": max_depth_gap_m positive, counts at least 1."
            )
        if self.part_inside <= 0:
            raise ConfigError(f"part_inside={self.part_inside:g} must be positive.")


@dataclass(frozen=True, eq=False, slots=True)
class MapView:
    """The map, and what a keyframe shows of it.

    rows [N, 16], labels [N, 32], ids [N] int64 ascending, anchors [N] int32: of the map
    indices      [V] uint32, ascending: rows of those that made the image
    regions      [V] int32, region of each, see `Assigned`; negative: none
    boxes        [M, 4] of the regions: x0 y0 x1 y1, px
    classes      [M, 2] what a detector and a labeller say is in them; -1: it says nothing
    depth_m      [H, W] float32, as it was measured
    """

    keyframe: int
    camera: Camera
    T_map_camera: np.ndarray
    rows: np.ndarray
    labels: np.ndarray
    ids: np.ndarray
    anchors: np.ndarray
    indices: np.ndarray
    regions: np.ndarray
    boxes: np.ndarray
    classes: np.ndarray
    depth_m: np.ndarray

    def __post_init__(self) -> None:
        n, v, size = len(self.rows), len(self.indices), (self.camera.height, self.camera.width)
        if not len(self.labels) == len(self.ids) == len(self.anchors) == n:
            raise ValueError(f"labels, ids and anchors must be those of the {n} rows.")
        if len(self.regions) != v or (v and not self.indices[-1] < n):
            raise ValueError(f"{len(self.regions)} regions of {v} Gaussians among {n} rows.")
        if v and self.regions.max() >= len(self.boxes):
            raise ValueError(f"region {self.regions.max()} has none of {len(self.boxes)} boxes.")
        if len(self.classes) != len(self.boxes):
            raise ValueError(f"{len(self.classes)} classes of {len(self.boxes)} regions.")
        if self.depth_m.shape != size:
            raise ValueError(f"depth has shape {self.depth_m.shape}, its camera {size}.")


@dataclass(frozen=True, eq=False, slots=True)
class RegionStatistics:
    """R regions of a keyframe with enough Gaussians.

    numbers       [R] among those of the keyframe, ascending
    boxes         [R, 4] px
    members       [R, 256] ids of a sample of their Gaussians, as `landmarks` keeps them
    p_map         [R, 256, 3] where they are
    distributions [R, C] means of theirs, by opacity
    near_m, far_m [R] depths they lie between
    """

    numbers: np.ndarray
    boxes: np.ndarray
    members: np.ndarray
    p_map: np.ndarray
    distributions: np.ndarray
    near_m: np.ndarray
    far_m: np.ndarray


def compute_region_statistics(
    view: MapView, T_camera_map: np.ndarray, config: AssociationConfig
) -> RegionStatistics:
    """What the regions of a keyframe are made of."""
    hit = np.flatnonzero(view.regions >= 0)
    counts = np.bincount(view.regions[hit], minlength=len(view.boxes))
    numbers = np.sort(np.argsort(-counts, kind="stable")[: config.max_regions])
    numbers = numbers[counts[numbers] >= config.min_gaussians]
    at = _sampled(view, hit, counts, numbers)
    rows = view.rows[np.maximum(at, 0)]
    weights = np.where(at >= 0, 1 / (1 + np.exp(-rows[..., 10].astype(float))), 0)
    p_map = rows[..., :3].astype(float)
    z = p_map @ T_camera_map[2, :3] + T_camera_map[2, 3]
    near_m, far_m = trimmed(z[..., None], at >= 0)
    return RegionStatistics(
        numbers,
        np.asarray(view.boxes, float).reshape(-1, 4)[numbers],
        np.where(at >= 0, view.ids[np.maximum(at, 0)] if len(view.ids) else NO_MEMBER, NO_MEMBER),
        p_map,
        mean_distributions(view.labels[np.maximum(at, 0)], weights),
        near_m[:, 0],
        far_m[:, 0],
    )


def merge_parts(view: MapView, regions: RegionStatistics, config: AssociationConfig) -> MapView:
    """A view in which regions that are parts of another belong to it. That one may have lost all
    of its Gaussians to them: then it is where its largest part is."""
    near_m = np.full(len(view.boxes), np.inf)
    far_m = -near_m
    near_m[regions.numbers], far_m[regions.numbers] = regions.near_m, regions.far_m
    whole = find_containing_regions(
        np.asarray(view.boxes, float), view.classes, near_m, far_m, config
    )
    if np.array_equal(whole, np.arange(len(whole))):
        return view
    is_hit = view.regions >= 0
    numbers = np.where(is_hit, whole[view.regions * is_hit], view.regions)
    return replace(view, regions=numbers.astype(np.int32))


def find_containing_regions(
    boxes: np.ndarray,
    classes: np.ndarray,
    near_m: np.ndarray,
    far_m: np.ndarray,
    config: AssociationConfig,
) -> np.ndarray:
    """[M] which region shows all of what each of M shows a part of; itself where none does. They
    share a class, their depths meet, and one box lies in the other, the largest of all that it
    lies in. Boxes [M, 4], classes [M, 2]; depths [M], infinite where nothing is known.

    >>> plant, crown, pot = [0, 0, 9, 20], [0, 0, 9, 12], [2, 12, 7, 20]
    >>> at_m = np.full(3, 2.0)
    >>> find_containing_regions(np.array([pot, plant, crown]), np.zeros((3, 2)), at_m, at_m,
    ...     AssociationConfig())
    array([1, 1, 1])
    """
    area = areas(boxes)
    common = intersections(boxes, boxes)
    is_part = (common > 0) & (common >= config.part_inside * area[:, None])
    is_part &= area[:, None] < area
    is_part &= share_a_class(classes)
    near_m, far_m = near_m.copy(), far_m.copy()
    by_size = np.argsort(-area, kind="stable")
    for k in np.flatnonzero(np.isinf(near_m)):
        parts = by_size[is_part[by_size, k] & np.isfinite(near_m[by_size])]
        if len(parts):
            near_m[k], far_m[k] = near_m[parts[0]], far_m[parts[0]]
    is_part &= depth_gaps_m(near_m, far_m, near_m, far_m) <= config.max_depth_gap_m
    whole = np.arange(len(area))
    for part in by_size:  # so that a part of a part is one of the whole
        around = np.flatnonzero(is_part[part])
        if len(around):
            whole[part] = whole[around[np.argmax(area[around])]]
    return whole


def share_a_class(classes: np.ndarray) -> np.ndarray:
    """[M, M] bool: which of M things may be of one class, whoever says it of either; [M, 2] what a
    detector and a labeller say, -1 where they say nothing.

    >>> share_a_class(np.array([[3, -1], [-1, 3], [-1, -1]])).astype(int)
    array([[1, 1, 0],
           [1, 1, 0],
           [0, 0, 0]])
    """
    is_same = (classes[:, None, :, None] == classes[:, None]) & (classes >= 0)[:, None]
    return np.any(is_same, axis=(2, 3))


def _sampled(view: MapView, hit: np.ndarray, counts: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Rows [R, 256] of the Gaussians of each region that come first when shuffled; -1 beyond.

    Of regions with more than 512 only that share is sorted that has some 512 of them.
    """
    ordinal = np.full(len(counts), -1)
    ordinal[numbers] = np.arange(len(numbers))
    which, rows = ordinal[view.regions[hit]], view.indices[hit]
    places = shuffled(view.ids[rows])
    last = np.minimum(2 * MEMBERS / np.maximum(counts, 1), 0.999) * 2.0**64
    keep = (which >= 0) & (
        (places <= last.astype(np.uint64)[view.regions[hit]])
        | (counts <= 2 * MEMBERS)[view.regions[hit]]
    )
    which, rows, places = which[keep], rows[keep], places[keep]
    order = np.lexsort((places, which))
    which, rows = which[order], rows[order]
    rank = np.arange(len(which)) - np.searchsorted(which, np.arange(len(numbers)))[which]
    out = np.full((len(numbers), MEMBERS), -1)
    first = rank < MEMBERS
    out[which[first], rank[first]] = rows[first]
    return out


@dataclass(frozen=True, eq=False, slots=True)
class PredictedBoxes:
    """K landmarks as a keyframe should show them.

    boxes         [K, 4] px, of what nothing hides, or of where that should be; empty ones
                  (x0 > x1) where all is hidden
    shown         [K] share of the believed members that are in the image where depth was measured
    through       [K] share of them that depth was measured far behind of: they are not there
    near_m, far_m [K] depths they lie between
    rows          [K, 256] of the members, -1 of those that are not awake
    """

    boxes: np.ndarray
    shown: np.ndarray
    through: np.ndarray
    near_m: np.ndarray
    far_m: np.ndarray
    rows: np.ndarray


def predict_boxes(
    table: np.ndarray, view: MapView, T_camera_map: np.ndarray, config: AssociationConfig
) -> PredictedBoxes:
    """How landmarks [K] appear; of one none of whose members is awake, how its centroid does."""
    where = rows_of(table["members"], view.ids)
    there = ((where >= 0) & reliable_members(table))[:, :PROBES]
    p_map = view.rows[np.maximum(where[:, :PROBES], 0), :3].astype(float)
    gone = ~there.any(axis=1)
    p_map[gone, 0] = table["centroid"][gone]
    there[gone, 0] = True
    p = p_map @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
    near_m, far_m = (ends[:, 0] for ends in trimmed(p[..., 2:], there))
    px, measured_m = _measured(p, view)
    gap_m = config.max_depth_gap_m
    seen = there & (measured_m > 0) & (measured_m >= near_m[:, None] - gap_m)
    through = seen & (measured_m > far_m[:, None] + gap_m)
    shown = seen & ~through
    low, high = trimmed(px, np.where(shown.any(axis=1, keepdims=True), shown, seen))
    count = np.count_nonzero(there, axis=1)
    return PredictedBoxes(
        np.concatenate([low, high], axis=1),
        np.count_nonzero(shown, axis=1) / count,
        np.count_nonzero(through, axis=1) / count,
        near_m,
        far_m,
        where,
    )


def _measured(p_camera: np.ndarray, view: MapView) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [..., 2] of points [..., 3], and the depth [...] there; 0 outside the image."""
    z = np.maximum(p_camera[..., 2:], 1e-6)
    px = view.camera.project(np.concatenate([p_camera[..., :2], z], axis=-1))
    size = view.camera.width, view.camera.height
    inside = (p_camera[..., 2] > 0) & np.all((px > -0.5) & (px < np.array(size) - 0.5), axis=-1)
    u, v = np.where(inside[..., None], np.rint(px), 0).astype(int).transpose(2, 0, 1)
    return px, np.where(inside, view.depth_m[v, u], 0)


def depth_gaps_m(
    near_m: np.ndarray, far_m: np.ndarray, others_near_m: np.ndarray, others_far_m: np.ndarray
) -> np.ndarray:
    """[K, R] between intervals [K] and [R]; negative where they overlap."""
    return np.maximum(near_m[:, None], others_near_m) - np.minimum(far_m[:, None], others_far_m)


@dataclass(frozen=True, eq=False, slots=True)
class AssociationCosts:
    """K landmarks and R regions: iou [K, R], and which may be the same, [K, R] bool: their boxes
    overlap, their depths meet, and they share a class."""

    iou: np.ndarray
    allowed: np.ndarray


def association_costs(
    distributions: np.ndarray,
    looks: PredictedBoxes,
    regions: RegionStatistics,
    config: AssociationConfig,
) -> AssociationCosts:
    """Of landmarks with distributions [K, C]."""
    iou = ious(looks.boxes, regions.boxes)
    gap_m = depth_gaps_m(looks.near_m, looks.far_m, regions.near_m, regions.far_m)
    allowed = (iou > 0) & (gap_m <= config.max_depth_gap_m)
    k, r = np.nonzero(allowed)
    allowed[k, r] = common_mass(distributions[k], regions.distributions[r]) >= config.min_shared
    return AssociationCosts(iou, allowed)


def associate(
    iou: np.ndarray, allowed: np.ndarray, min_iou: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of rows and columns of iou [K, R], rows ascending: of those that are allowed and at
    least min_iou the ones with the largest sum. The same arrays give the same pairs."""
    gain = np.where(allowed & (iou >= min_iou), iou, 0)
    k, r = linear_sum_assignment(gain, maximize=True)
    paired = gain[k, r] > 0
    return k[paired], r[paired]
