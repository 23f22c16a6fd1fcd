"""Detections as labelled 3D points, and the landmarks that they form in a subgraph.

Conventions: `ldo_service.geometry`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3
from ldo_service.regions.foreground import ForegroundConfig, foreground, surfaces
from ldo_service.semantics.distributions import dense, divergence, entropy, sparse
from ldo_service.semantics.gaussian_labels import MAX_LABELS, OTHER

LAYOUT_WORDS = 512  # Number of bins to which pairs of labels with their distance are hashed.
DISTANCE_BIN_M = 0.5  # Bin width of the distances; a distance counts in its two nearest bins.
# Labels below this index, background and `other`, are ignored: they do not describe a place.
HIDDEN_NAMES = OTHER + 1


@dataclass(frozen=True, slots=True)
class LandmarkConfig:
    """Parameters of landmarks: objects of a subgraph, each merged from several detections."""

    foreground: ForegroundConfig = field(default_factory=ForegroundConfig)
    # Detections with the same label belong to one object if their distance is below this limit.
    # It is half the width of a chair.
    same_m: float = 0.4
    # Maximum KL divergence of the label distributions of two matching landmarks, in both
    # directions, nats (LDO-SLAM paper, III.C).
    max_divergence: float = 0.3
    # Maximum distance of two matching landmarks after alignment by the pose between the subgraphs.
    # It is large because the boxes may show different sides of an object.
    reach_m: float = 0.25
    # Minimum landmarks that agree with a pose; three determine a pose but do not confirm it.
    min_inliers: int = 4
    iterations: int = 200  # Iterations of RANSAC.

    def __post_init__(self) -> None:
        if min(self.same_m, self.reach_m, self.max_divergence) <= 0:
            raise ConfigError(
                named(self, "same_m", "max_divergence", "reach_m") + " must be positive."
            )
        if self.min_inliers < 4 or self.iterations < 1:
            raise ConfigError(
                named(self, "min_inliers", "iterations")
                + ": min_inliers must be at least 4, iterations at least 1."
            )


@dataclass(frozen=True, eq=False, slots=True)
class DetectionPoints:
    """Detections in one keyframe as labelled 3D points.

    Attributes:
        labels: Label indices, [K] uint8.
        scores: Scores 0..1, [K] float32.
        p_camera: Points in camera coordinates, [K, 3] float32, meters; NaN where no depth was
            measured.
    """

    labels: np.ndarray
    scores: np.ndarray
    p_camera: np.ndarray

    @staticmethod
    def none() -> "DetectionPoints":
        """Return an instance without detections."""
        nowhere = np.zeros((0, 3), np.float32)
        return DetectionPoints(np.zeros(0, np.uint8), np.zeros(0, np.float32), nowhere)

    def histogram(self) -> np.ndarray:
        """Return the summed scores of each label, [256] float32; 0 for background and `other`."""
        counts = np.bincount(self.labels, self.scores, MAX_LABELS).astype(np.float32)
        counts[:HIDDEN_NAMES] = 0
        return counts


def locate_detections(
    labels: np.ndarray,
    scores: np.ndarray,
    boxes: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    config: LandmarkConfig,
) -> DetectionPoints:
    """Locate detections in 3D: each point is the median of the foreground pixels in the box.

    Args:
        labels: Label indices, [K].
        scores: Scores 0..1, [K].
        boxes: Corners x0, y0, x1, y1 in pixels of the depth image, [K, 4].
        depth_m: Depth, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the depth image.
        config: Parameters of the landmarks.
    """
    if not len(labels):
        return DetectionPoints.none()
    pieces = surfaces(depth_m, camera, config.foreground)
    p_camera = np.full((len(labels), 3), np.nan, np.float32)
    for k, box in enumerate(boxes):
        mask = foreground(box, depth_m, pieces, camera, config.foreground).image(depth_m.shape)
        if mask.any():
            v, u = np.nonzero(mask)
            z = float(np.median(depth_m[mask]))
            p_camera[k] = camera.points_at(float(np.median(u)), float(np.median(v)), z)
    return DetectionPoints(labels.astype(np.uint8), scores.astype(np.float32), p_camera)


@dataclass(frozen=True, eq=False, slots=True)
class SubgraphLandmarks:
    """Landmarks of a subgraph.

    Attributes:
        p_odom: Positions of the landmarks in the odometry frame of the submap, [K, 3], meters.
        labels: The eight likeliest labels of each landmark, [K, 8] uint8.
        weights: Probabilities of these labels, [K, 8] float32.
    """

    p_odom: np.ndarray
    labels: np.ndarray
    weights: np.ndarray

    def __len__(self) -> int:
        return len(self.p_odom)

    @property
    def distributions(self) -> np.ndarray:
        """Dense label distributions of the K landmarks, [K, 256] float64."""
        return dense(self.labels, self.weights)

    @property
    def names(self) -> np.ndarray:
        """Likeliest label of each landmark, [K] int64; background and `other` are ignored."""
        best = np.where(self.labels < HIDDEN_NAMES, -1, self.weights).argmax(axis=1)
        return self.labels[np.arange(len(self)), best].astype(np.int64)

    def pack(self) -> dict[str, Any]:
        """Return a dictionary of the arrays by attribute name."""
        return {"p_odom": self.p_odom, "labels": self.labels, "weights": self.weights}


def cluster_landmarks(
    seen: Sequence[DetectionPoints], T_odom_camera: Sequence[np.ndarray], config: LandmarkConfig
) -> SubgraphLandmarks:
    """Merge the detections of a subgraph's keyframes into landmarks, one per object.

    The position and the label distribution of a landmark are means over its detections. Each
    detection counts as a distribution with two entries: the label has the detection's score as
    probability, and `other` has the rest.

    Args:
        seen: Detections of each keyframe.
        T_odom_camera: Pose [4, 4] of each keyframe in the odometry frame of the submap.
        config: Parameters of the landmarks.
    """
    places: list[np.ndarray] = []  # Sums of the points.
    masses: list[np.ndarray] = []
    counts: list[int] = []
    names: list[int] = []
    for sightings, T in zip(seen, T_odom_camera, strict=True):
        rows = zip(sightings.labels, sightings.scores, sightings.p_camera, strict=True)
        for label, score, p_camera in rows:
            if label < HIDDEN_NAMES or not np.isfinite(p_camera).all():
                continue
            p_odom = se3.transform(T, p_camera.astype(float))
            k = _same(p_odom, int(label), places, counts, names, config.same_m)
            if k == len(names):
                places.append(np.zeros(3))
                masses.append(np.zeros(MAX_LABELS))
                counts.append(0)
                names.append(int(label))
            places[k] = places[k] + p_odom
            masses[k][[int(label), OTHER]] += float(score), 1.0 - float(score)
            counts[k] += 1
    total = np.array(counts, float).reshape(-1, 1)
    labels, weights = sparse(np.array(masses).reshape(-1, MAX_LABELS) / total)
    return SubgraphLandmarks(np.array(places).reshape(-1, 3) / total, labels, weights)


def _same(
    p_odom: np.ndarray,
    label: int,
    places: Sequence[np.ndarray],
    counts: Sequence[int],
    names: Sequence[int],
    limit_m: float,
) -> int:
    """Return the index of the nearest landmark with a label.

    If no landmark with the label is within `limit_m`, return the number of landmarks.
    """
    gaps_m = [
        float(np.linalg.norm(place / count - p_odom)) if name == label else np.inf
        for place, count, name in zip(places, counts, names, strict=True)
    ]
    nearest = int(np.argmin(gaps_m)) if gaps_m else 0
    return nearest if gaps_m and gaps_m[nearest] < limit_m else len(names)


def layout_histogram(landmarks: SubgraphLandmarks) -> np.ndarray:
    """Return a histogram of landmark pairs by their two labels and their distance, [512] float32.

    Unlike a histogram of labels, this one distinguishes a row of chairs from chairs around a table.
    It contains distances but no directions, so it does not depend on the viewpoint.
    """
    out = np.zeros(LAYOUT_WORDS, np.float32)
    first, second = np.triu_indices(len(landmarks), 1)
    if not len(first):
        return out
    names = landmarks.names
    low, high = np.minimum(names[first], names[second]), np.maximum(names[first], names[second])
    bins = np.linalg.norm(landmarks.p_odom[first] - landmarks.p_odom[second], axis=1)
    bins = bins / DISTANCE_BIN_M
    lower = np.floor(bins).astype(np.int64)
    for step, share in ((lower, 1 - (bins - lower)), (lower + 1, bins - lower)):
        words = ((low * MAX_LABELS + high) * 31 + step) * 0x9E3779B1 % 2**32 % LAYOUT_WORDS
        np.add.at(out, words, share.astype(np.float32))
    return out


@dataclass(frozen=True, eq=False, slots=True)
class LandmarkAgreement:
    """Agreement of the landmarks of two subgraphs after alignment by a relative pose."""

    count: int  # Number of pairs with matching distributions.
    # Number of new landmarks that contradict the pose: old landmarks are near them,
    # but none of these has the same label or a similar distribution.
    contradicted: int
    divergence: float  # Mean KL divergence over the matching pairs, nats.
    entropy: float  # Mean entropy of the landmarks in the matching pairs, nats.


def possible_pairs(
    old: SubgraphLandmarks, new: SubgraphLandmarks, config: LandmarkConfig
) -> np.ndarray:
    """Return the index pairs (old, new) of landmarks with similar label distributions, [M, 2].

    Label distributions are similar if their KL divergence is below `config.max_divergence` in both
    directions. The default, 0.3 nats, comes from section III.C of the LDO-SLAM paper.
    """
    return np.argwhere(_divergences(old, new) < config.max_divergence)


def compare_landmarks(
    old: SubgraphLandmarks, new: SubgraphLandmarks, pairs: np.ndarray, contradicted: int = 0
) -> LandmarkAgreement:
    """Return the agreement of matched landmarks.

    Args:
        old: Landmarks of the old subgraph.
        new: Landmarks of the new subgraph.
        pairs: Index pairs (old, new) of the matched landmarks, [M, 2].
        contradicted: Number of new landmarks that contradict the relative pose; stored in the
            result.
    """
    if not len(pairs):
        return LandmarkAgreement(0, contradicted, 0.0, 0.0)
    gaps = _divergences(old, new)[pairs[:, 0], pairs[:, 1]]
    certain = entropy(old.distributions)[pairs[:, 0]], entropy(new.distributions)[pairs[:, 1]]
    means = (max(float(np.mean(values)), 0.0) for values in (gaps, certain))
    return LandmarkAgreement(len(pairs), contradicted, *means)


def compare_landmarks_at(
    old: SubgraphLandmarks, new: SubgraphLandmarks, T_old_new: np.ndarray, config: LandmarkConfig
) -> LandmarkAgreement:
    """Compare the landmarks that a relative pose brings near each other.

    Args:
        old: Landmarks of the old subgraph.
        new: Landmarks of the new subgraph.
        T_old_new: Transform from the odometry frame of `new` to the odometry frame of `old`,
            [4, 4].
        config: Parameters of the landmarks.
    """
    if not len(old) or not len(new):
        return LandmarkAgreement(0, 0, 0.0, 0.0)
    gaps_m = np.linalg.norm(old.p_odom[:, None] - se3.transform(T_old_new, new.p_odom), axis=2)
    near = gaps_m < config.reach_m
    alike = near & (_divergences(old, new) < config.max_divergence)
    both = np.flatnonzero(alike.any(axis=0))
    nearest = np.where(alike, gaps_m, np.inf)[:, both].argmin(axis=0)
    # The same label with a lower confidence is no contradiction.
    agrees = alike | (near & (old.names[:, None] == new.names))
    contradicted = int(np.count_nonzero(near.any(axis=0) & ~agrees.any(axis=0)))
    return compare_landmarks(old, new, np.column_stack([nearest, both]), contradicted)


def _divergences(a: SubgraphLandmarks, b: SubgraphLandmarks) -> np.ndarray:
    """Return the larger KL divergence of both directions for each landmark pair, [K, L], nats."""
    p, q = a.distributions[:, None], b.distributions[None]
    return np.maximum(divergence(p, q), divergence(q, p))
