"""Fusion of a keyframe's regions into the labels of the map.

A region may have a label by the detector and a label by the labeller. The module fuses both into
one label (LDO-SLAM paper, III.B). It also renders the labels of the map as label images.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.renderer import Rendering, render
from ldo_service.gaussians.rows import aligned_rows
from ldo_service.geometry import Camera, se3
from ldo_service.regions.foreground import (
    ForegroundConfig,
    NestingConfig,
    RegionDetections,
    foreground,
    surfaces,
    without_nested,
)

from .gaussian_labels import (
    BACKGROUND,
    MISS,
    NOT_SEEN,
    ConsistencyConfig,
    Disagreement,
    LabelConfig,
    Observations,
    background,
    clear_background,
    fields,
    observe,
    reset_labels,
    smooth_labels,
    top_labels,
)
from .label_assignment import HIDDEN, Assignment, AssignmentConfig, Regions, assign_gaussians


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """Settings of the fusion of detector and labeller; `fuse_confidences` has the formula."""

    # Weight of the detector: by the confidences (adaptive), constant (fixed), or always 1, so that
    # the labeller is ignored (detector).
    rule: Literal["adaptive", "fixed", "detector"] = "adaptive"
    beta: float = 2.0  # Exponent in the formula of `adaptive` (LDO-SLAM paper, III.B).
    epsilon: float = 1e-6  # Term against division by zero with `adaptive` (LDO-SLAM paper, III.B).
    # Weight of the detector with `fixed`, an ablation (LDO-SLAM paper, IV.C).
    fixed_alpha: float = 0.5

    def __post_init__(self) -> None:
        if self.rule not in ("adaptive", "fixed", "detector"):
            raise ConfigError(
                f"FusionConfig.rule={self.rule!r} must be 'adaptive', 'fixed' or 'detector'."
            )
        if not (self.beta > 0 and self.epsilon > 0 and 0 <= self.fixed_alpha <= 1):
            raise ConfigError(
                named(self, "beta", "epsilon", "fixed_alpha")
                + ": beta and epsilon must be positive, fixed_alpha in [0, 1]."
            )


@dataclass(frozen=True, eq=False, slots=True)
class FusedLabels:
    """Fused labels of V Gaussians or regions.

    Attributes:
        labels: Fused labels, [V] int16.
        confidences: Fused confidences, [V] float32, 0..1; SemConf in the LDO-SLAM paper, III.B.
        alpha: Weight of the detector, [V] float32, 0..1.
        by_detector: Contribution of the detector: alpha times its confidence, [V] float32.
    """

    labels: np.ndarray
    confidences: np.ndarray
    alpha: np.ndarray
    by_detector: np.ndarray


def fuse_confidences(
    detector_labels: np.ndarray,
    detector_confidences: np.ndarray,
    overlaps: np.ndarray,
    open_labels: np.ndarray,
    open_confidences: np.ndarray,
    config: FusionConfig,
) -> FusedLabels:
    """Fuse the labels of detector and labeller for V Gaussians or regions.

        r_YOLO = overlap Conf_YOLO,  r_VLM = Conf_VLM
        alpha = r_YOLO^beta / (r_YOLO^beta + r_VLM^beta + epsilon)
        SemConf = alpha Conf_YOLO + (1 - alpha) Conf_VLM

    The label is the detector's if alpha Conf_YOLO >= (1 - alpha) Conf_VLM, else the labeller's.
    Without a label of the labeller, alpha is 1. With the rule `fixed`, alpha is the constant
    `fixed_alpha` wherever both labels exist. With the rule `detector`, the labeller is ignored.

    Args:
        detector_labels: Labels of the detector, [V] int.
        detector_confidences: Conf_YOLO of the detector, [V], 0..1; 0 without a detection.
        overlaps: Overlap of each Gaussian with its region, IoU or coverage, [V], 0..1.
        open_labels: Labels of the labeller, [V] int.
        open_confidences: Conf_VLM of the labeller, [V], 0..1; 0 if the labeller was not invoked or
            gave no label.
        config: Settings of the fusion, with `rule`, `beta`, `epsilon` and `fixed_alpha`.

    Example: a box with Conf_YOLO = 0.8 covers half of a Gaussian, and Conf_VLM is 0.6. Therefore
    r_YOLO = 0.4, r_VLM = 0.6, alpha = 0.16 / (0.16 + 0.36) = 0.308. The labeller's label is used,
    because (1 - alpha) 0.6 = 0.415 is more than alpha 0.8 = 0.246. SemConf is 0.415 + 0.246:

    >>> one = fuse_confidences(*np.array([[7], [0.8], [0.5], [9], [0.6]]), FusionConfig())
    >>> int(one.labels[0]), round(float(one.alpha[0]), 3), round(float(one.confidences[0]), 3)
    (9, 0.308, 0.662)
    """
    confidences = np.asarray(detector_confidences, np.float32)
    open_confidences = np.asarray(open_confidences, np.float32)
    invoked = (open_confidences > 0) & (config.rule != "detector")
    alpha = np.where(invoked, _alpha(overlaps * confidences, open_confidences, config), 1)
    alpha = alpha.astype(np.float32)
    by_detector, by_labeller = alpha * confidences, (1 - alpha) * open_confidences
    labels = np.where(by_detector >= by_labeller, detector_labels, open_labels)
    return FusedLabels(labels.astype(np.int16), by_detector + by_labeller, alpha, by_detector)


def _alpha(r_detector: np.ndarray, r_open: np.ndarray, config: FusionConfig) -> np.ndarray:
    if config.rule != "adaptive":
        return np.full(r_open.shape, config.fixed_alpha)
    ours = r_detector.astype(float) ** config.beta
    return ours / (ours + r_open.astype(float) ** config.beta + config.epsilon)


def reliable_label_mask(labels: np.ndarray, top: np.ndarray, least: float) -> np.ndarray:
    """Return the pixels where the map has a reliable label other than background, [H, W] bool.

    Args:
        labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
        top: Row of the Gaussian that contributes most to each pixel, [H, W]; -1 if there is none.
        least: Minimum probability of the label.
    """
    out = np.zeros(len(labels) + 1, bool)  # The last value is for top = -1.
    out[top] = True
    rows = labels[shown := np.flatnonzero(out[:-1])]
    out[shown] = (fields(rows)["weights"][:, 0] >= least) & (top_labels(rows) != BACKGROUND)
    return out[top] & (top >= 0)


def label_image(
    rows: np.ndarray,
    labels: np.ndarray,
    shown: Rendering,
    camera: Camera,
    T_camera_map: np.ndarray,
    *,
    threads: int = 1,
) -> np.ndarray:
    """Render the labels of the map: at each pixel the label s with the largest sum_i w_i p_i(s).

    w_i is the weight of Gaussian i in the pixel, and p_i(s) is its probability of label s. Of
    labels with equal sums, the label with the lowest index is used. Pixels without Gaussians are
    background. The function renders the map once for every three labels. It is therefore slow, and
    meant for evaluation and pictures.

    Args:
        rows: Gaussians of the map, [N, 16].
        labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
        shown: Rendering of the image with the Gaussians that contribute to it.
        camera: Intrinsics of the image.
        T_camera_map: Transform from the map to the camera, [4, 4].
        threads: Number of threads.

    Returns:
        Labels, [H, W] uint8.
    """
    assert shown.contributions is not None
    made_by = shown.contributions.indices
    visible, label_rows = aligned_rows(len(made_by)), labels[made_by]
    visible[:] = rows[made_by]
    records = fields(label_rows)
    known = np.unique(records["ids"][records["weights"] > 0]).tolist()
    image = np.zeros((camera.height, camera.width), np.uint8)
    largest_sum = np.zeros(image.shape, np.float32)
    for three in (known[k : k + 3] for k in range(0, len(known), 3)):
        visible[:, 11:14] = 0
        for column, label in enumerate(three, 11):
            visible[:, column] = np.sum(records["weights"] * (records["ids"] == label), axis=1)
        sums = render(visible, camera, T_camera_map, threads=threads).color
        for channel, label in enumerate(three):
            image[sums[..., channel] > largest_sum] = label
            largest_sum = np.maximum(largest_sum, sums[..., channel])
    visible[:, 11:14] = background(label_rows)[:, None]
    nothing = render(visible, camera, T_camera_map, threads=threads).color[..., 0]
    return np.where(nothing >= largest_sum, np.uint8(BACKGROUND), image)


@dataclass(frozen=True, slots=True)
class SemanticFusionConfig:
    """Settings for fusing the labels of image regions into the map."""

    # Pixels that a detection labels: the foreground in its box, or the whole box.
    region: Literal["foreground", "box"] = "foreground"
    foreground: ForegroundConfig = field(default_factory=ForegroundConfig)
    nesting: NestingConfig = field(default_factory=NestingConfig)
    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    labels: LabelConfig = field(default_factory=LabelConfig)
    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)

    def __post_init__(self) -> None:
        if self.region not in ("foreground", "box"):
            raise ConfigError(
                f"SemanticFusionConfig.region={self.region!r} must be 'foreground' or 'box'."
            )


@dataclass(frozen=True, eq=False, slots=True)
class FusionResult:
    """Result of fusing the regions of a keyframe into the labels of the map.

    Attributes:
        assigned: Region of each Gaussian.
        seen: Label observations of the Gaussians.
        disagreement: Label disagreement of neighboring Gaussians before labels were smoothed.
    """

    assigned: Assignment
    seen: Observations
    disagreement: Disagreement


def fuse_detections(
    rows: np.ndarray,
    labels: np.ndarray,
    indices: np.ndarray,
    camera: Camera,
    T_map_camera: np.ndarray,
    depth_m: np.ndarray,
    detections: RegionDetections,
    config: SemanticFusionConfig,
    *,
    is_late: bool = False,
    undetectable: np.ndarray | None = None,
    threads: int = 1,
) -> FusionResult:
    """Update the labels [N, 32] of the map with the labels of a keyframe's regions, in place.

    Args:
        rows: Gaussians of the map, [N, 16].
        labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
        indices: Rows of the Gaussians that contribute to the image, [V] uint32, ascending.
        camera: Intrinsics of the keyframe.
        T_map_camera: Pose of the camera, [4, 4].
        depth_m: Measured depth, [H, W], meters.
        detections: Labels of the regions by detector and labeller.
        config: Settings of the fusion.
        is_late: True if the keyframe was fused before, and `detections` has only the regions whose
            labels by the labeller arrived later. Gaussians outside of these regions then count as
            not seen, and not as background. Gaussians for which the fusion chooses the detector's
            label are not updated a second time.
        undetectable: Labels that the detector does not know, [256] bool. Gaussians with such a
            label do not count as background where they are in no region. None: the detector knows
            all labels.
        threads: Number of threads.

    Returns:
        The assignment of the Gaussians, their observations and the label disagreement.

    Raises:
        ValueError: If the shapes or types of the arrays do not fit.
    """
    # Assignment of Gaussians to regions.
    at = camera, T_map_camera, depth_m, detections, config
    where = assign_detections(rows, indices, *at, threads=threads)
    # Observed labels.
    seen = observations(where, indices, camera, detections, config, is_late=is_late)
    if undetectable is not None:
        # The detector cannot miss a label that it does not know: ignore new misses of such labels,
        # and remove the background weight of earlier misses.
        is_undetectable = undetectable[top_labels(labels[indices])] & (seen.labels == MISS)
        seen.labels[is_undetectable] = NOT_SEEN
        is_named = undetectable[np.maximum(seen.labels, 0)] & (seen.labels >= 0)
        clear_background(labels, indices[is_named])
    if detections.replaces_labels and config.region == "foreground":
        reset_labels(labels, indices[seen.labels >= 0])
    observe(labels, seen, config.labels, threads=threads)
    # Consistency with the neighbors.
    touched = indices[seen.labels != NOT_SEEN]
    return FusionResult(
        where, seen, smooth_labels(rows, labels, touched, config.consistency, threads=threads)
    )


def assign_detections(
    rows: np.ndarray,
    indices: np.ndarray,
    camera: Camera,
    T_map_camera: np.ndarray,
    depth_m: np.ndarray,
    detections: RegionDetections,
    config: SemanticFusionConfig,
    *,
    threads: int = 1,
) -> Assignment:
    """Assign each Gaussian that contributes to the image of a keyframe to a region, or to none.

    The arguments are those of `fuse_detections`.
    """
    regions = regions_of(detections, depth_m, camera, config)
    T_camera_map = se3.inverse(T_map_camera)
    return assign_gaussians(
        rows, indices, camera, T_camera_map, depth_m, regions, config.assignment, threads=threads
    )


def regions_of(
    detections: RegionDetections, depth_m: np.ndarray, camera: Camera, config: SemanticFusionConfig
) -> Regions:
    """Return the region of each box.

    By default, the region is the foreground in the box, without smaller regions that are nested in
    the foreground. With the setting `region: box`, the region is the whole box.

    Args:
        detections: Boxes and scores, with foregrounds where they are already known.
        depth_m: Measured depth, [H, W], meters.
        camera: Intrinsics of depth_m.
        config: Settings of the fusion.
    """
    if config.region == "box" or len(detections.boxes) == 0:
        return Regions.of_boxes(np.reshape(detections.boxes, (-1, 4)), detections.scores())
    known = detections.parts or (None,) * len(detections.boxes)
    parts = [part for part in known if part is not None]
    if len(parts) < len(known):
        found = surfaces(depth_m, camera, config.foreground)
        parts = [
            part or foreground(box, depth_m, found, camera, config.foreground)
            for box, part in zip(detections.boxes, known, strict=True)
        ]
    parts = without_nested(parts, detections.scores(), config.nesting)
    return Regions.of_foregrounds(detections.boxes, detections.scores(), parts)


def observations(
    where: Assignment,
    indices: np.ndarray,
    camera: Camera,
    detections: RegionDetections,
    config: SemanticFusionConfig,
    *,
    is_late: bool = False,
) -> Observations:
    """Return the label observations of Gaussians in a keyframe.

    A Gaussian in a region gets the label and confidence of the region. A visible Gaussian that is
    in no region gets the label MISS. The observed extent of the Gaussian's object is the square
    root of the box's area, converted to meters at the depth of the Gaussian.

    Args:
        where: Region of each Gaussian.
        indices: Rows of the Gaussians, [V] uint32, ascending.
        camera: Intrinsics of the keyframe.
        detections: Labels of the regions by detector and labeller.
        config: Settings of the fusion.
        is_late: See `fuse_detections`.
    """
    # The tables below are indexed by `outcome`: hidden, in no region, in region 0, 1, ...
    # The dtype intp avoids a conversion in `take`.
    outcome = np.subtract(where.regions, HIDDEN, dtype=np.intp)
    region_labels = np.where(
        (detections.confidences > 0) & (not is_late), detections.labels, NOT_SEEN
    )
    miss = NOT_SEEN if is_late else MISS
    labels = np.array([NOT_SEEN, miss, *region_labels], np.int16).take(outcome)
    confidences = np.array([0, 0, *detections.confidences], np.float32).take(outcome)
    corners, min_px = np.reshape(detections.boxes, (-1, 2, 2)), config.labels.min_px
    sides_px = np.sqrt(np.prod(corners[:, 1] - corners[:, 0], axis=1))
    # Fuse the two labels per Gaussian in regions that also have a label by the labeller.
    is_fused = np.array([False, False, *(detections.open_confidences > 0)])
    if is_fused.any():
        both = np.flatnonzero(is_fused.take(outcome))
        of = where.regions[both]
        one = fuse_confidences(
            detections.labels.take(of),
            detections.confidences.take(of),
            where.overlaps[both],
            detections.open_labels.take(of),
            detections.open_confidences.take(of),
            config.fusion,
        )
        is_labelled = one.confidences > (2 * one.by_detector if is_late else 0)
        labels[both] = np.where(is_labelled, one.labels, NOT_SEEN)
        confidences[both] = one.confidences
    extents_m = np.fmax(where.depths_m, 0)  # NaN: hidden Gaussians have no extent.
    extents_m /= np.float32(np.sqrt(camera.fx * camera.fy))
    extents_m *= np.array([min_px, min_px, *sides_px], np.float32).take(outcome)
    return Observations(indices, labels, confidences, extents_m)
