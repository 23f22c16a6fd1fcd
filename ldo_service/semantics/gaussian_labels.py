"""Label distributions of the Gaussians over time, and their consistency among neighbors."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.model import new_labels as new_labels
from ldo_service.kernels import _labels

BACKGROUND, OTHER = 0, 1  # what every vocabulary begins with
MAX_LABELS = 256  # C_max (III.B)
SLOTS = 5  # L (III.B)
NOT_SEEN, MISS = -2, -1  # in place of a label that was observed
ROW = np.dtype(
    [
        ("weights", "<f4", SLOTS),
        ("evidence", "<f4"),  # sum of the weights of all observations, those of long ago faded
        ("extent_mm", "<u2"),  # of the object that the Gaussian was last seen as a part of
        ("misses", "u1"),  # keyframes since then that expected it to be one
        ("ids", "u1", SLOTS),
    ]
)


@dataclass(frozen=True, slots=True)
class ConsistencyConfig:
    sigma_m: float = 0.05  # sigma_cons (III.A)
    radius_m: float = 0.15  # three sigma: beyond, a weight is below 2e-4
    rate: float = 0.1  # of the step, 0..1: 1 - lambda (III.A), as of one observation

    def __post_init__(self) -> None:
        if not (self.sigma_m > 0 and self.radius_m > 0 and 0 <= self.rate <= 1):
            raise ConfigError(
                named(self, "sigma_m", "radius_m", "rate")
                + ": lengths must be positive, rate in 0..1."
            )


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Before the step, summed over the Gaussians: with k_ij = w_ij exp(-|mu_i - mu_j|^2 / sigma^2)

    literal   sum k_ij [s_i != s_j], as printed; it has no gradient
    expected  sum k_ij (1 - p_i . p_j), which the step makes smaller
    """

    literal: float
    expected: float


def smooth_labels(
    rows: np.ndarray,
    labels: np.ndarray,
    indices: np.ndarray,
    config: ConsistencyConfig,
    *,
    threads: int = 1,
) -> Disagreement:
    """A step of the Gaussians `indices` [V] (uint32, ascending) towards their neighbours among
    them, in place.

        p_i <- (1 - rate K_i) p_i + rate sum_j k_ij p_j,  K_i = sum_j k_ij,  w_ij = 1 / |N_i|

    which is along the gradient of the expected disagreement, sum_j k_ij p_j, and keeps a
    distribution. Neighbours: of the first eight Gaussians in the same voxel of two sigma, and the
    first ones of the voxels around it, sixteen together, those within radius_m.

    rows [N, 16] of the map; labels [N, 32]. All read what was before the step. Raises ValueError
    for arrays that do not fit. Bitwise equal for any number of threads.

    Two Gaussians 5 cm apart, a chair (2) and a wall: k = exp(-1), p = 0.1 k = 0.037 apart.

    >>> from .gaussian_labels import distribution, fields, new_labels
    >>> rows, labels = np.zeros((2, 16), np.float32), new_labels(2)
    >>> rows[1, 0] = 0.05
    >>> fields(labels)["weights"][0, 0], fields(labels)["ids"][0, 0] = 1, 2
    >>> loss = smooth_labels(rows, labels, np.arange(2, dtype=np.uint32), ConsistencyConfig())
    >>> round(loss.literal, 3), round(loss.expected, 3)  # both see each other: 2 exp(-1)
    (0.736, 0.736)
    >>> distribution(labels, 3).astype(float).round(3).tolist()
    [[0.037, 0.0, 0.963], [0.963, 0.0, 0.037]]
    """
    lengths = config.sigma_m, config.radius_m
    return Disagreement(*_labels.agree(rows, labels, indices, *lengths, config.rate, threads))


@dataclass(frozen=True, slots=True)
class LabelConfig:
    """Constants of `corrected` were given by a study with voxels on one floor of a Replica
    apartment; usual_extent_m and hold_back were chosen on the same frames, with two detectors."""

    ema: Literal["paper", "corrected"] = "corrected"
    keep: float = 0.9  # lambda (III.A)
    miss_limit: int = 5  # keyframes, N_miss (III.A), of `paper`
    # Of `corrected`: a miss is evidence for background, where the detector should have seen it.
    miss_weight: float = 0.3  # of a detection: its confidence
    least_px: float = 40.0  # side of an object's box that the detector should see
    usual_extent_m: float = 0.5  # of an object nobody has seen yet
    hold_back: float = 1.0  # 0..1, of uncertain observations of settled Gaussians

    def __post_init__(self) -> None:
        if self.ema not in ("paper", "corrected"):
            raise ConfigError(f"ema={self.ema!r} must be 'paper' or 'corrected'.")
        if not (0 <= self.keep < 1 and 0 <= self.miss_weight <= 1 and 0 <= self.hold_back <= 1):
            raise ConfigError(
                named(self, "keep", "miss_weight", "hold_back")
                + ": keep in [0, 1), miss_weight and hold_back in 0..1."
            )
        if not (1 <= self.miss_limit <= 255 and self.least_px >= 0 and self.usual_extent_m >= 0):
            raise ConfigError(
                named(self, "miss_limit", "least_px", "usual_extent_m")
                + ": miss_limit in 1..255, lengths not negative."
            )


@dataclass(frozen=True, eq=False, slots=True)
class Observations:
    """What a keyframe says of V Gaussians.

    indices     [V] uint32, ascending: their rows
    labels      [V] int16, or MISS: seen, and in no region; or NOT_SEEN
    confidences [V] float32, 0..1, of labels
    extents_m   [V] float32: of a label how large its object is, of a miss how large an object must
                be to be missed
    """

    indices: np.ndarray
    labels: np.ndarray
    confidences: np.ndarray
    extents_m: np.ndarray


def fields(labels: np.ndarray) -> np.ndarray:
    """Rows [N, 32] as records [N] of `ROW`, without a copy."""
    return labels.view(ROW)[:, 0]


def observe(
    labels: np.ndarray, seen: Observations, config: LabelConfig, *, threads: int = 1
) -> None:
    """Fold a keyframe into rows [N, 32], in place.

    A label s makes p <- (1 - a) p + a onehot(s). With `paper` a = 1 - keep, so that 0.9 needs seven
    sightings to flip a label; misses are counted, and miss_limit in a row make background of it.
    With `corrected` the mean of all observations is weighted as the average fades: with
    w = confidence, W <- keep W + w, and a = w / W: the first sighting counts whole. A miss is an
    observation of background with w = miss_weight, if the object it was seen as, or one of
    usual_extent_m, would appear at least least_px large.

    Uncertain observations of settled Gaussians are held back: the step of `paper`, and w, have the
    factor 1 - hold_back exp(-2 H) (1 - confidence), with the entropy H of p, once p has a label.

    >>> labels, config = new_labels(1), LabelConfig(hold_back=0)
    >>> def see(label, confidence, config):
    ...     one = [np.array([x], t) for x, t in ((0, "u4"), (label, "i2"), (confidence, "f4"))]
    ...     observe(labels, Observations(*one, np.ones(1, np.float32)), config)
    ...     return distribution(labels, 4)[0].astype(float).round(3).tolist()
    >>> see(2, 0.6, config)  # W = 0.6, a = 1
    [0.0, 0.0, 1.0, 0.0]
    >>> see(3, 0.46, config)  # W = 0.54 + 0.46, a = 0.46
    [0.0, 0.0, 0.54, 0.46]
    >>> see(MISS, 0, config)  # W = 0.9 + 0.3, a = 0.25
    [0.25, 0.0, 0.405, 0.345]
    >>> see(2, 0.6, LabelConfig(ema="paper", hold_back=0))  # 0.9 p + 0.1
    [0.225, 0.0, 0.464, 0.31]

    Held back, of a Gaussian that is settled, H = 0: 0.5 counts as 0.5 (1 - (1 - 0.5)).

    >>> labels = new_labels(1)
    >>> see(2, 0.6, LabelConfig())  # nothing to hold on to: W = 0.6
    [0.0, 0.0, 1.0, 0.0]
    >>> see(3, 0.5, LabelConfig())  # w = 0.25, W = 0.54 + 0.25, a = 0.316
    [0.0, 0.0, 0.684, 0.316]

    Raises ValueError for arrays that do not fit. Bitwise equal for any number of threads.
    Paper, III.A; ALGORITHMS, Semantics on Gaussians.
    """
    _labels.update(
        labels,
        seen.indices,
        seen.labels,
        seen.confidences,
        seen.extents_m,
        config.ema == "corrected",
        config.keep,
        config.miss_weight,
        config.miss_limit,
        config.usual_extent_m,
        config.hold_back,
        threads,
    )


def clear_background(labels: np.ndarray, indices: np.ndarray) -> None:
    """Take background, and the evidence for it, out of rows `indices` [V] of labels [N, 32], in
    place: what else they were seen as stays, in proportion.

    >>> labels = new_labels(1)
    >>> row = fields(labels)
    >>> row["weights"][0, 0], row["evidence"] = 0.25, 2
    >>> clear_background(labels, np.array([0]))
    >>> row["weights"][0, 0].item(), row["evidence"].item()
    (1.0, 0.5)
    """
    rows = fields(labels)
    weights = rows["weights"][indices]
    named = weights.sum(axis=1)
    rows["weights"][indices] = weights / np.where(named > 0, named, 1)[:, None]
    rows["evidence"][indices] *= named


def reset_labels(labels: np.ndarray, indices: np.ndarray) -> None:
    """Make rows `indices` [V] of labels [N, 32] as never seen, in place."""
    labels[indices] = 0


def background(labels: np.ndarray) -> np.ndarray:
    """[N] float32, the share of background."""
    return np.maximum(1 - fields(labels)["weights"].sum(axis=1), 0)


def top_labels(labels: np.ndarray) -> np.ndarray:
    """[N] uint8, the likeliest label; background where no other has more."""
    rows = fields(labels)
    return np.where(rows["weights"][:, 0] > background(labels), rows["ids"][:, 0], BACKGROUND)


def distribution(labels: np.ndarray, classes: int = MAX_LABELS) -> np.ndarray:
    """[N, classes] float32, dense: rows sum to one. Raises ValueError where a label is beyond."""
    rows = fields(labels)
    used = rows["weights"] > 0
    if np.any(rows["ids"][used] >= classes):
        raise ValueError(f"labels go up to {rows['ids'][used].max()}, beyond {classes} classes.")
    out = np.zeros((len(labels), classes), np.float32)
    out[:, BACKGROUND] = background(labels)
    which = np.nonzero(used)
    out[which[0], rows["ids"][which]] = rows["weights"][which]
    return out


def entropy(labels: np.ndarray) -> np.ndarray:
    """[N] float32, H = -sum p log p (III.A), in nats.

    >>> labels = new_labels(1)
    >>> fields(labels)["weights"][0, 0] = 0.5
    >>> round(float(entropy(labels)[0]), 4)  # log 2
    0.6931
    """
    p = np.concatenate([fields(labels)["weights"], background(labels)[:, None]], axis=1)
    return -np.sum(p * np.log(np.where(p > 0, p, 1)), axis=1)
