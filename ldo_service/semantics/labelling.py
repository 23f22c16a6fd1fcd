"""What a keyframe's regions make of the labels of the map: one step a line."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3

from .assignment import HIDDEN, Assigned, AssignmentConfig, Regions, assign
from .consistency import ConsistencyConfig, Disagreement, agree
from .foreground import Foreground, ForegroundConfig, foreground, surfaces
from .fusion import FusionConfig, fused
from .labels import (
    MISS,
    NOT_SEEN,
    LabelConfig,
    Observations,
    forget,
    observe,
    top_labels,
    without_misses,
)
from .nesting import NestingConfig, without_nested


@dataclass(frozen=True, slots=True)
class LabellingConfig:
    region: Literal["foreground", "box"] = "foreground"
    foreground: ForegroundConfig = field(default_factory=ForegroundConfig)
    nesting: NestingConfig = field(default_factory=NestingConfig)
    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    labels: LabelConfig = field(default_factory=LabelConfig)
    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)

    def __post_init__(self) -> None:
        if self.region not in ("foreground", "box"):
            raise ConfigError(f"region={self.region!r} must be 'foreground' or 'box'.")


@dataclass(frozen=True, eq=False, slots=True)
class Claims:
    """What is said to be in M boxes of a keyframe.

    boxes                  [M, 4], x0 y0 x1 y1, px, pixel centres at integers
    labels, confidences    [M] of the detector; confidence 0: it says nothing
    open_labels, open_confidences [M] of the open-vocabulary labeller; 0: it was not invoked
    parts                  what of each box it is; None, or none at all: what is found in it
    anew                   what their Gaussians were taken for before was said of another thing
    """

    boxes: np.ndarray
    labels: np.ndarray
    confidences: np.ndarray
    open_labels: np.ndarray
    open_confidences: np.ndarray
    parts: tuple[Foreground | None, ...] = ()
    anew: bool = False

    @classmethod
    def of_detector(
        cls, boxes: np.ndarray, labels: np.ndarray, confidences: np.ndarray
    ) -> "Claims":
        return cls(boxes, labels, confidences, labels, np.zeros(len(boxes), np.float32))

    @classmethod
    def none(cls) -> "Claims":
        return cls.of_detector(np.zeros((0, 4), np.float32), *np.zeros((2, 0), np.float32))

    def where(self, mask: np.ndarray) -> "Claims":
        """Those of a mask [M]."""
        parts = tuple(part for part, is_in in zip(self.parts, mask, strict=False) if is_in)
        return Claims(
            self.boxes[mask],
            self.labels[mask],
            self.confidences[mask],
            self.open_labels[mask],
            self.open_confidences[mask],
            parts,
            self.anew,
        )

    def scores(self) -> np.ndarray:
        """[M], by which regions compete where they overlap."""
        return np.maximum(self.confidences, self.open_confidences)

    def classes(self) -> np.ndarray:
        """[M, 2] labels of detector and labeller, -1 where they say nothing."""
        said = (self.labels, self.confidences), (self.open_labels, self.open_confidences)
        return np.stack([np.where(sure > 0, one.astype(int), -1) for one, sure in said], axis=1)


@dataclass(frozen=True, eq=False, slots=True)
class Labelled:
    assigned: Assigned
    seen: Observations
    disagreement: Disagreement


def label_keyframe(
    rows: np.ndarray,
    labels: np.ndarray,
    indices: np.ndarray,
    camera: Camera,
    T_map_camera: np.ndarray,
    depth_m: np.ndarray,
    claims: Claims,
    config: LabellingConfig,
    *,
    is_late: bool = False,
    spared: np.ndarray | None = None,
    threads: int = 1,
) -> Labelled:
    """Fold what is claimed of a keyframe into the labels [N, 32] of the map, in place.

    rows [N, 16]; indices [V] uint32, the Gaussians that made its image; depth_m [H, W] as it was
    measured. `is_late`: the claims are some of a keyframe that was folded in before, so that what
    they leave out is no miss, and where the detector's word is the heavier one it was counted.
    `spared` [256] bool: labels that the detector does not know, and cannot miss. Raises ValueError
    for arrays that do not fit.
    """
    # which Gaussians are where
    regions = regions_of(claims, depth_m, camera, config)
    T_camera_map = se3.inverse(T_map_camera)
    where = assign(
        rows, indices, camera, T_camera_map, depth_m, regions, config.assignment, threads=threads
    )
    # what they were seen as
    seen = observations(where, indices, camera, claims, config, is_late=is_late)
    if spared is not None:
        # what the detector does not know it could not miss, before or now
        is_spared = spared[top_labels(labels[indices])] & (seen.labels == MISS)
        seen.labels[is_spared] = NOT_SEEN
        is_named = spared[np.maximum(seen.labels, 0)] & (seen.labels >= 0)
        without_misses(labels, indices[is_named])
    if claims.anew and config.region == "foreground":
        forget(labels, indices[seen.labels >= 0])
    observe(labels, seen, config.labels, threads=threads)
    # what their neighbours say
    touched = indices[seen.labels != NOT_SEEN]
    return Labelled(where, seen, agree(rows, labels, touched, config.consistency, threads=threads))


def regions_of(
    claims: Claims, depth_m: np.ndarray, camera: Camera, config: LabellingConfig
) -> Regions:
    """The boxes, or the objects in them, each without those that lie on it."""
    if config.region == "box" or len(claims.boxes) == 0:
        return Regions.of_boxes(np.reshape(claims.boxes, (-1, 4)), claims.scores())
    known = claims.parts or (None,) * len(claims.boxes)
    parts = [part for part in known if part is not None]
    if len(parts) < len(known):
        found = surfaces(depth_m, camera, config.foreground)
        parts = [
            part or foreground(box, depth_m, found, camera, config.foreground)
            for box, part in zip(claims.boxes, known, strict=True)
        ]
    parts = without_nested(parts, claims.scores(), config.nesting)
    return Regions.of_foregrounds(claims.boxes, claims.scores(), parts)


def observations(
    where: Assigned,
    indices: np.ndarray,
    camera: Camera,
    claims: Claims,
    config: LabellingConfig,
    *,
    is_late: bool = False,
) -> Observations:
    """Labels and confidences of the Gaussians that a region got; misses of the others in view. The
    side of an object is that of a square like its box, at the depth of the Gaussian."""
    # by the outcome: hidden, in no region, in region 0, 1, ...
    outcome = np.subtract(where.regions, HIDDEN, dtype=np.intp)  # as `take` would have it
    said = np.where((claims.confidences > 0) & (not is_late), claims.labels, NOT_SEEN)
    miss = NOT_SEEN if is_late else MISS
    labels = np.array([NOT_SEEN, miss, *said], np.int16).take(outcome)
    confidences = np.array([0, 0, *claims.confidences], np.float32).take(outcome)
    corners, least_px = np.reshape(claims.boxes, (-1, 2, 2)), config.labels.least_px
    sides_px = np.sqrt(np.prod(corners[:, 1] - corners[:, 0], axis=1))
    # where a labeller has spoken too, by the Gaussian
    is_fused = np.array([False, False, *(claims.open_confidences > 0)])
    if is_fused.any():
        both = np.flatnonzero(is_fused.take(outcome))
        of = where.regions[both]
        one = fused(
            claims.labels.take(of),
            claims.confidences.take(of),
            where.overlaps[both],
            claims.open_labels.take(of),
            claims.open_confidences.take(of),
            config.fusion,
        )
        is_told = one.confidences > (2 * one.by_detector if is_late else 0)
        labels[both] = np.where(is_told, one.labels, NOT_SEEN)
        confidences[both] = one.confidences
    extents_m = np.fmax(where.depths_m, 0)  # NaN is hidden, and has none
    extents_m /= np.float32(np.sqrt(camera.fx * camera.fy))
    extents_m *= np.array([least_px, least_px, *sides_px], np.float32).take(outcome)
    return Observations(indices, labels, confidences, extents_m)
