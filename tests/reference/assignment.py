"""NumPy reference implementation of `assign_gaussians`, in float64, for boxes and masks."""

from collections.abc import Sequence

import numpy as np

from ldo_service.geometry import Camera
from ldo_service.semantics.label_assignment import HIDDEN, UNMATCHED, Assignment, AssignmentConfig

from .render import project


def assign_reference(
    rows: np.ndarray,
    camera: Camera,
    T_camera_map: np.ndarray,
    depth_m: np.ndarray,
    boxes: np.ndarray,
    scores: np.ndarray,
    masks: Sequence[np.ndarray] | None,
    config: AssignmentConfig,
) -> Assignment:
    """Match all rows with regions.

    Args:
        rows: Gaussians of the map, [N, 16].
        camera: Camera of the depth image.
        T_camera_map: Transform from the map to the camera, [4, 4].
        depth_m: Depth, [H, W], meters; 0 where not measured.
        boxes: Boxes x0 y0 x1 y1, [M, 4], pixels.
        scores: Scores of the boxes, [M].
        masks: One mask [H, W] bool per box; None assigns by the boxes.
        config: Rule and thresholds.
    """
    means, covariances, z = project(rows.astype(float), camera, T_camera_map)
    half = 2 * np.sqrt(covariances[:, [0, 1], [0, 1]])
    far = np.array([camera.width, camera.height]) - 0.5
    low, high = np.clip(means - half, -0.5, far), np.clip(means + half, -0.5, far)
    expected = _expected(means, z, depth_m, config)
    regions = np.where(expected, UNMATCHED, HIDDEN).astype(np.int32)
    overlaps, best = np.zeros(len(rows)), np.zeros(len(rows))
    for j, (box, score) in enumerate(zip(boxes, scores, strict=True)):
        for i in np.flatnonzero(expected):
            mask = None if masks is None else masks[j]
            overlap = _overlap(low[i], high[i], means[i], box, mask, config.rule)
            if overlap > config.min_overlap and overlap * score > best[i]:
                regions[i], overlaps[i], best[i] = j, overlap, overlap * score
    return Assignment(regions, overlaps, z)


def _expected(
    means: np.ndarray, z: np.ndarray, depth_m: np.ndarray, config: AssignmentConfig
) -> np.ndarray:
    """Return the Gaussians [N] bool in the image and on the surface measured there."""
    height, width = depth_m.shape
    inside = np.all((means >= -0.5) & (means < [width - 0.5, height - 0.5]), axis=1) & (z >= 0.05)
    column, row = np.floor(np.where(inside[:, None], means, 0) + 0.5).astype(int).T
    measured_m = depth_m[row, column]
    behind_m = z - measured_m
    is_near = behind_m < config.max_depth_gap_m
    if config.depth_test == "two_sided":
        is_near &= behind_m > -config.max_depth_gap_m
    return inside & (measured_m > 0) & is_near


def _overlap(
    low: np.ndarray,
    high: np.ndarray,
    center: np.ndarray,
    box: np.ndarray,
    mask: np.ndarray | None,
    rule: str,
) -> float:
    """Return the overlap of the splat box `low`..`high` with a region, by the rule."""
    if mask is None:
        holds = bool(np.all(center >= box[:2]) and np.all(center < box[2:]))
        shared = np.prod(np.maximum(np.minimum(high, box[2:]) - np.maximum(low, box[:2]), 0))
        area = np.prod(box[2:] - box[:2])
    else:
        column, row = np.floor(center + 0.5).astype(int)
        holds = bool(mask[row, column])
        columns, rows = (
            np.clip(np.minimum(high[k], at + 0.5) - np.maximum(low[k], at - 0.5), 0, 1)
            for k, at in ((0, np.arange(mask.shape[1])), (1, np.arange(mask.shape[0])))
        )
        shared, area = rows @ mask @ columns, np.count_nonzero(mask)
    splat = np.prod(high - low)
    if rule == "iou":
        return float(shared / (splat + area - shared))
    return float(shared / splat) if holds else 0.0
