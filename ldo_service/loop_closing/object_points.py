"""What a detector saw in a few keyframes, as points that have names. `ldo_service.geometry`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3
from ldo_service.regions.foreground import ForegroundConfig, foreground, surfaces
from ldo_service.semantics.distributions import dense, divergence, entropy, sparse
from ldo_service.semantics.gaussian_labels import MAX_LABELS, OTHER

LAYOUT_WORDS = 512  # pairs of names and their distances are spread over so many
DISTANCE_BIN_M = 0.5  # of the distances; each counts in the two bins that it lies between
HIDDEN_NAMES = OTHER + 1  # background and other say nothing of a place


@dataclass(frozen=True, slots=True)
class LandmarkConfig:
    foreground: ForegroundConfig = field(default_factory=ForegroundConfig)
    same_m: float = 0.4  # sightings of one name nearer to each other are of one thing: half a chair
    max_divergence: float = 0.3  # nats, either way, of landmarks that may be one (III.C)
    reach_m: float = 0.25  # how far matched landmarks may be apart: boxes show another side
    min_inliers: int = 4  # three points fix a pose and confirm nothing
    iterations: int = 200  # of RANSAC

    def __post_init__(self) -> None:
        if min(self.same_m, self.reach_m, self.max_divergence) <= 0:
            raise ConfigError(
                named(self, "same_m", "max_divergence", "reach_m")
                + ": same_m, reach_m and max_divergence must be positive."
            )
        if self.min_inliers < 4 or self.iterations < 1:
            raise ConfigError(
                named(self, "min_inliers", "iterations")
                + ": min_inliers must be at least 4, iterations at least 1."
            )


@dataclass(frozen=True, eq=False, slots=True)
class DetectionPoints:
    """What was detected in one keyframe: labels [K] uint8, scores [K] float32, 0..1, and p_camera
    [K, 3] float32 m, NaN where no depth was measured."""

    labels: np.ndarray
    scores: np.ndarray
    p_camera: np.ndarray

    @staticmethod
    def none() -> "DetectionPoints":
        nowhere = np.zeros((0, 3), np.float32)
        return DetectionPoints(np.zeros(0, np.uint8), np.zeros(0, np.float32), nowhere)

    def histogram(self) -> np.ndarray:
        """[C] float32: the scores of each name, added up."""
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
    """Boxes [K, 4] (x0 y0 x1 y1, px) in a depth image [H, W]: where their foreground is, in the
    median."""
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
    """Points [K, 3] m in the odometry frame of a submap, with what they are: sparse distributions,
    labels [K, 8] uint8 and weights [K, 8] float32."""

    p_odom: np.ndarray
    labels: np.ndarray
    weights: np.ndarray

    def __len__(self) -> int:
        return len(self.p_odom)

    @property
    def distributions(self) -> np.ndarray:
        """[K, C] float64."""
        return dense(self.labels, self.weights)

    @property
    def names(self) -> np.ndarray:
        """[K] int64: what each was called, however unsure the detector was."""
        said = np.where(self.labels < HIDDEN_NAMES, -1, self.weights).argmax(axis=1)
        return self.labels[np.arange(len(self)), said].astype(np.int64)

    def pack(self) -> dict[str, Any]:
        return {"p_odom": self.p_odom, "labels": self.labels, "weights": self.weights}


def cluster_landmarks(
    seen: Sequence[DetectionPoints], T_odom_camera: Sequence[np.ndarray], config: LandmarkConfig
) -> SubgraphLandmarks:
    """The sightings of a few keyframes, those of one thing taken together.

    A landmark's distribution is the mean over its sightings, each the score on its name and the
    rest on `other`; its place is the mean.
    """
    places: list[np.ndarray] = []  # sums
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
    """The nearest landmark of that name; the number of all where none is near."""
    gaps_m = [
        float(np.linalg.norm(place / count - p_odom)) if name == label else np.inf
        for place, count, name in zip(places, counts, names, strict=True)
    ]
    nearest = int(np.argmin(gaps_m)) if gaps_m else 0
    return nearest if gaps_m and gaps_m[nearest] < limit_m else len(names)


def layout_histogram(landmarks: SubgraphLandmarks) -> np.ndarray:
    """[512] float32: which two names are how far apart, for each pair of landmarks.

    Unlike the names alone it tells a row of chairs from chairs about a table; it knows no
    directions, so that it is the same from every side.
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
    """How well landmarks of two subgraphs go together that lie in one place."""

    count: int  # that are of one kind
    contradicted: int  # of the new ones, those where only things of other names were
    divergence: float  # nats, mean over those of one kind
    entropy: float  # nats, likewise, of both


def possible_pairs(
    old: SubgraphLandmarks, new: SubgraphLandmarks, config: LandmarkConfig
) -> np.ndarray:
    """Indices [M, 2] of landmarks that may be one: KL below 0.3 nats both ways (III.C)."""
    return np.argwhere(_divergences(old, new) < config.max_divergence)


def compare_landmarks(
    old: SubgraphLandmarks, new: SubgraphLandmarks, pairs: np.ndarray, contradicted: int = 0
) -> LandmarkAgreement:
    """What is recorded of pairs [M, 2]."""
    if not len(pairs):
        return LandmarkAgreement(0, contradicted, 0.0, 0.0)
    gaps = _divergences(old, new)[pairs[:, 0], pairs[:, 1]]
    certain = entropy(old.distributions)[pairs[:, 0]], entropy(new.distributions)[pairs[:, 1]]
    means = (max(float(np.mean(values)), 0.0) for values in (gaps, certain))
    return LandmarkAgreement(len(pairs), contradicted, *means)


def compare_landmarks_at(
    old: SubgraphLandmarks, new: SubgraphLandmarks, T_old_new: np.ndarray, config: LandmarkConfig
) -> LandmarkAgreement:
    """The landmarks that a motion between the two odometry frames [4, 4] brings together."""
    if not len(old) or not len(new):
        return LandmarkAgreement(0, 0, 0.0, 0.0)
    gaps_m = np.linalg.norm(old.p_odom[:, None] - se3.transform(T_old_new, new.p_odom), axis=2)
    near = gaps_m < config.reach_m
    alike = near & (_divergences(old, new) < config.max_divergence)
    both = np.flatnonzero(alike.any(axis=0))
    nearest = np.where(alike, gaps_m, np.inf)[:, both].argmin(axis=0)
    # one name, said with less confidence, is no other thing
    agrees = alike | (near & (old.names[:, None] == new.names))
    contradicted = int(np.count_nonzero(near.any(axis=0) & ~agrees.any(axis=0)))
    return compare_landmarks(old, new, np.column_stack([nearest, both]), contradicted)


def _divergences(a: SubgraphLandmarks, b: SubgraphLandmarks) -> np.ndarray:
    """[K, L] nats, the larger of both ways."""
    p, q = a.distributions[:, None], b.distributions[None]
    return np.maximum(divergence(p, q), divergence(q, p))
