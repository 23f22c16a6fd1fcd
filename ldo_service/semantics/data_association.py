"""Data association between the regions of a keyframe and objects (LDO-SLAM paper, III.C).

Each object is a landmark: a sample of its Gaussians, called members, with their label distribution.
The predicted box of a landmark encloses the members that are not occluded according to the measured
depth. A detector should find the object in about this box. A landmark and a region may be the same
object if

    the IoU of their boxes is at least 0.4,
    the common mass of their label distributions is at least 0.3,
    and the gap between their depth ranges is at most 0.1 m.

Each landmark is matched with at most one such region, and each region with at most one landmark.
The sum of the IoUs of all matched pairs is the largest possible. Before the matching, a region that
shows only a part of an object is merged into the region that shows the whole object.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from ldo_service.geometry import Camera
from ldo_service.geometry.boxes import areas, intersections, ious
from ldo_service.regions.foreground import share_a_class

from .distributions import common_mass, mean_distributions
from .object_landmarks import MEMBERS, NO_MEMBER, reliable_members, rows_of, shuffled, trimmed
from .objects_config import AssociationConfig

PROBES = 128  # Maximum number of a landmark's members that are projected: its first ones.


@dataclass(frozen=True, eq=False, slots=True)
class MapView:
    """Data for the association in one keyframe: map, visible Gaussians, regions and depth.

    Attributes:
        keyframe: Id of the keyframe.
        camera: Intrinsics of the keyframe.
        T_map_camera: Transform from the camera to the map, [4, 4].
        rows: Gaussians of the map, [N, 16], see `gaussians.rows`.
        labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
        ids: Ids of the Gaussians, [N] int64, ascending.
        anchors: Ids of the keyframes that the Gaussians move with, [N] int32.
        indices: Row numbers of the Gaussians visible in the image, [V] uint32, ascending.
        regions: Region of each Gaussian in `indices`, [V] int32; negative if the Gaussian is in no
            region. See `Assignment`.
        boxes: Boxes of the regions, [M, 4], x0 y0 x1 y1, pixels.
        classes: Labels of each region by the detector and the labeller, [M, 2]; -1 if missing.
        depth_m: Measured depth of the keyframe, [H, W] float32, meters; 0 where unknown.
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
            raise ValueError(
                f"labels, ids and anchors must each have {n} rows, one per Gaussian of the map."
            )
        if len(self.regions) != v or (v and not self.indices[-1] < n):
            raise ValueError(
                f"regions has {len(self.regions)} entries, must have {v}, as many as indices. "
                f"The values of indices must be below {n}, the number of Gaussians in the map."
            )
        if v and self.regions.max() >= len(self.boxes):
            raise ValueError(
                f"regions has the value {self.regions.max()}; all values must be below "
                f"{len(self.boxes)}, the number of boxes."
            )
        if len(self.classes) != len(self.boxes):
            raise ValueError(
                f"classes has {len(self.classes)} rows for {len(self.boxes)} regions, must have "
                "one row per region."
            )
        if self.depth_m.shape != size:
            raise ValueError(
                f"depth_m has shape {self.depth_m.shape}, must have {size}, the size of the "
                "camera's images."
            )


@dataclass(frozen=True, eq=False, slots=True)
class RegionStatistics:
    """Statistics of the R regions of a keyframe that have enough Gaussians.

    Attributes:
        numbers: Numbers of the regions within the keyframe, [R], ascending.
        boxes: Boxes of the regions, [R, 4], pixels.
        members: Ids of a sample of the Gaussians of each region, [R, 256], in the order that the
            function `shuffled` defines. Unused entries at the end are NO_MEMBER.
        p_map: Positions of the Gaussians in `members` in the map frame, [R, 256, 3], meters.
        distributions: Mean label distribution of these Gaussians, weighted by opacity, [R, C].
        near_m: Near end of the depth range of these Gaussians, [R], meters.
        far_m: Far end of the depth range of these Gaussians, [R], meters.
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
    """Compute the statistics of the regions of a keyframe.

    The function uses at most `config.max_regions` regions: those with the most Gaussians. Regions
    with fewer than `config.min_gaussians` Gaussians are ignored.
    """
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
    """Return a view where each region inside a larger region is merged into the larger region.

    The Gaussians of each merged region then belong to the larger region. The function
    `find_containing_regions` finds the larger region.
    """
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


def whole_regions(
    view: MapView, T_camera_map: np.ndarray, config: AssociationConfig
) -> tuple[MapView, RegionStatistics]:
    """Merge regions that show parts of one object.

    Returns:
        The view with the merged regions, and their statistics.
    """
    regions = compute_region_statistics(view, T_camera_map, config)
    whole = merge_parts(view, regions, config)
    return whole, regions if whole is view else compute_region_statistics(
        whole, T_camera_map, config
    )


def find_containing_regions(
    boxes: np.ndarray,
    classes: np.ndarray,
    near_m: np.ndarray,
    far_m: np.ndarray,
    config: AssociationConfig,
) -> np.ndarray:
    """Find the region that contains each of M regions of a keyframe.

    Region a contains region b if three conditions hold: the regions share a class; the gap between
    their depth ranges is at most max_depth_gap_m; and a has the larger box, which covers at least
    the fraction part_inside of the box of b. A region whose depth range is unknown gets the depth
    range of the largest region inside it.

    Args:
        boxes: Boxes of the regions, [M, 4], x0 y0 x1 y1, pixels.
        classes: Labels by the detector and by the labeller, [M, 2]; -1 if missing.
        near_m: Near ends of the depth ranges, [M], meters; infinite where unknown.
        far_m: Far ends of the depth ranges, [M], meters; minus infinity where unknown.
        config: Settings of the data association.

    Returns:
        For each region, the number of the largest region that contains it, [M]; its own number if
        there is none. If a contains b and b contains c, c gets the number of a.

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
    for part in by_size:  # Large boxes first, so that a part of a part joins the whole.
        around = np.flatnonzero(is_part[part])
        if len(around):
            whole[part] = whole[around[np.argmax(area[around])]]
    return whole


def _sampled(view: MapView, hit: np.ndarray, counts: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return the map rows of each region's first 256 Gaussians in shuffled order, [R, 256].

    Unused entries of regions with fewer Gaussians are -1. To save time, only about 512 candidates
    are sorted in regions with more than 512 Gaussians.

    Args:
        view: The map and the regions of the keyframe.
        hit: Positions in `view.indices` of the Gaussians that are in a region.
        counts: Number of Gaussians in each region, [M].
        numbers: Numbers of the regions to sample, [R].
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
    """Predicted boxes and visibility of K landmarks in a keyframe.

    Each landmark has members: a sample of its Gaussians. Only reliable members are projected; see
    `reliable_members`.

    Attributes:
        boxes: Boxes of the visible members, [K, 4], x0 y0 x1 y1, pixels. If no member is visible,
            the box encloses the members in front of the measured depth. If all members are
            occluded or out of view, the box is empty (x0 > x1).
        shown: Fraction of the projected members that are visible, [K]: the measured depth at their
            pixel is in the landmark's depth range.
        through: Fraction of the projected members whose surface is gone, [K]: the measured depth at
            their pixel is behind the landmark's depth range.
        near_m: Near end of the members' depth range, [K], meters.
        far_m: Far end of the members' depth range, [K], meters.
        rows: Rows of the members in the map, [K, 256]; -1 where a member is not in memory.
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
    """Predict boxes and visibility of landmarks in a keyframe.

    Each landmark has a sample of its Gaussians, called members. The function projects the members
    that are reliable (see `reliable_members`) and in memory rather than on disk. If a landmark has
    no such member, the function projects its centroid.

    Args:
        table: Landmarks, [K] records of `LANDMARK`.
        view: The map and the depth of the keyframe.
        T_camera_map: Transform from the map to the camera, [4, 4].
        config: Settings of the data association.
    """
    where = rows_of(table["members"], view.ids)
    there = ((where >= 0) & reliable_members(table))[:, :PROBES]
    p_map = np.zeros((*there.shape, 3))
    p_map[there] = view.rows[where[:, :PROBES][there], :3]
    gone = ~there.any(axis=1)
    p_map[gone, 0], there[gone, 0] = table["centroid"][gone], True
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
    """Project points in the camera frame, [..., 3], meters, and read the depth at their pixels.

    Returns:
        Pixels, [..., 2], and measured depth, [...], meters; 0 outside the image.
    """
    z = np.maximum(p_camera[..., 2:], 1e-6)
    px = view.camera.project(np.concatenate([p_camera[..., :2], z], axis=-1))
    size = view.camera.width, view.camera.height
    inside = (p_camera[..., 2] > 0) & np.all((px > -0.5) & (px < np.array(size) - 0.5), axis=-1)
    u, v = np.where(inside[..., None], np.rint(px), 0).astype(int).transpose(2, 0, 1)
    return px, np.where(inside, view.depth_m[v, u], 0)


def depth_gaps_m(
    near_m: np.ndarray, far_m: np.ndarray, others_near_m: np.ndarray, others_far_m: np.ndarray
) -> np.ndarray:
    """Return the gaps between K and R depth ranges, [K, R], meters; negative for an overlap."""
    return np.maximum(near_m[:, None], others_near_m) - np.minimum(far_m[:, None], others_far_m)


@dataclass(frozen=True, eq=False, slots=True)
class AssociationCosts:
    """Pairwise measures for the association of K landmarks with R regions.

    Attributes:
        iou: IoU of each landmark's predicted box with each region's box, [K, R].
        allowed: Pairs that may be the same object, [K, R] bool: their boxes overlap, the gap
            between their depth ranges is at most max_depth_gap_m, and the common mass of their
            label distributions is at least min_shared.
    """

    iou: np.ndarray
    allowed: np.ndarray


def association_costs(
    distributions: np.ndarray,
    predicted: PredictedBoxes,
    regions: RegionStatistics,
    config: AssociationConfig,
) -> AssociationCosts:
    """Compute the association costs of K landmarks (with label distributions) and R regions."""
    iou = ious(predicted.boxes, regions.boxes)
    gap_m = depth_gaps_m(predicted.near_m, predicted.far_m, regions.near_m, regions.far_m)
    allowed = (iou > 0) & (gap_m <= config.max_depth_gap_m)
    k, r = np.nonzero(allowed)
    allowed[k, r] = common_mass(distributions[k], regions.distributions[r]) >= config.min_shared
    return AssociationCosts(iou, allowed)


def associate(
    iou: np.ndarray, allowed: np.ndarray, min_iou: float
) -> tuple[np.ndarray, np.ndarray]:
    """Match K landmarks with R regions so that the sum of the IoUs of matched pairs is largest.

    Each landmark and each region is matched at most once. The result is deterministic.

    Args:
        iou: IoU of each pair, [K, R].
        allowed: Pairs that may be matched, [K, R] bool.
        min_iou: Minimum IoU of a matched pair.

    Returns:
        Numbers of the matched landmarks, ascending, and the number of the region of each.
    """
    gain = np.where(allowed & (iou >= min_iou), iou, 0)
    k, r = linear_sum_assignment(gain, maximize=True)
    paired = gain[k, r] > 0
    return k[paired], r[paired]
