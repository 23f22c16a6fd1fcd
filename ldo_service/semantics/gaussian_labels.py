"""Label distributions of Gaussians: update by observations, and smoothing among neighbors."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.model import new_labels as new_labels
from ldo_service.kernels import _labels

BACKGROUND, OTHER = 0, 1  # The first two labels of every vocabulary.
MAX_LABELS = 256  # Maximum labels of a map: C_max (LDO-SLAM paper, III.B).
SLOTS = 5  # Labels stored per Gaussian: L (LDO-SLAM paper, III.B).
NOT_SEEN, MISS = -2, -1  # Values in place of an observed label; see `Observations`.
# Label row of one Gaussian, 32 bytes; all zero if the Gaussian was never observed.
ROW = np.dtype(
    [
        # Probabilities of the labels `ids`, the highest first; background has the rest.
        ("weights", "<f4", SLOTS),
        ("evidence", "<f4"),  # Sum of the weights of all observations, decayed with age.
        # Size of the object at the last observation of a label; 0 before the first.
        ("extent_mm", "<u2"),
        ("misses", "u1"),  # Misses since that observation.
        ("ids", "u1", SLOTS),
    ]
)


@dataclass(frozen=True, slots=True)
class ConsistencyConfig:
    """Settings for smoothing the label distributions of neighboring Gaussians."""

    # Scale of the distance in the weight of a neighbor: sigma_cons (LDO-SLAM paper, III.A).
    sigma_m: float = 0.05
    # Maximum distance of neighbors: three sigma. Farther Gaussians would have weights below 2e-4.
    radius_m: float = 0.15
    # Step size, 0..1. The default equals 1 - lambda, the step of the label update in the
    # LDO-SLAM paper, III.A.
    rate: float = 0.1

    def __post_init__(self) -> None:
        if not (self.sigma_m > 0 and self.radius_m > 0 and 0 <= self.rate <= 1):
            raise ConfigError(
                named(self, "sigma_m", "radius_m", "rate")
                + ": sigma_m and radius_m must be positive, rate in [0, 1]."
            )


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Label disagreement of neighbors before the smoothing step, summed over all Gaussians.

    Gaussian i has the center mu_i, the label distribution p_i, the likeliest label s_i and the set
    of neighbors N_i. The weight of a neighbor j of i is

        k_ij = w_ij exp(-|mu_i - mu_j|^2 / sigma_m^2),  w_ij = 1 / |N_i|

    Attributes:
        literal: sum_ij k_ij [s_i != s_j], as in the LDO-SLAM paper, III.A. This sum has no
            gradient.
        expected: sum_ij k_ij (1 - p_i . p_j). The smoothing step reduces this sum.
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
    """Move the label distributions of the Gaussians `indices` towards those of their neighbors.

    The label rows change in place. With k_ij as in `Disagreement`, the step is

        p_i <- (1 - rate K_i) p_i + rate sum_j k_ij p_j,  K_i = sum_j k_ij

    All p on the right are from before the step. The vector sum_j k_ij p_j is the negative gradient
    of the expected disagreement. The new p_i is again a distribution.

    Neighbors are Gaussians in `indices` at a distance of at most radius_m. Each Gaussian has at
    most sixteen candidates: up to eight from its own voxel, and the others from the surrounding
    voxels. A voxel has a side of 2 sigma_m. The result is bitwise equal for any number of threads.

    Args:
        rows: Gaussians of the map, [N, 16], see `gaussians.rows`.
        labels: Label rows of the Gaussians, [N, 32] uint8, see `ROW`.
        indices: Numbers of the rows to smooth, [V] uint32, ascending.
        config: Settings of the smoothing.
        threads: Number of threads.

    Returns:
        The disagreement before the step.

    Raises:
        ValueError: An array has a wrong shape or type.

    Example: two Gaussians are 5 cm apart. One is a chair (label 2), the other is background. With
    sigma_m = 0.05, k is exp(-1). With rate = 0.1, the step moves a probability of 0.1 k = 0.037.

    >>> from .gaussian_labels import distribution, fields, new_labels
    >>> rows, labels = np.zeros((2, 16), np.float32), new_labels(2)
    >>> rows[1, 0] = 0.05
    >>> fields(labels)["weights"][0, 0], fields(labels)["ids"][0, 0] = 1, 2
    >>> loss = smooth_labels(rows, labels, np.arange(2, dtype=np.uint32), ConsistencyConfig())
    >>> round(loss.literal, 3), round(loss.expected, 3)  # Each is the other's neighbor: 2 exp(-1).
    (0.736, 0.736)
    >>> distribution(labels, 3).astype(float).round(3).tolist()
    [[0.037, 0.0, 0.963], [0.963, 0.0, 0.037]]
    """
    lengths = config.sigma_m, config.radius_m
    return Disagreement(*_labels.agree(rows, labels, indices, *lengths, config.rate, threads))


@dataclass(frozen=True, slots=True)
class LabelConfig:
    """Settings of the label update with each observation.

    The constants of the rule `corrected` were tuned on frames from one floor of a Replica
    apartment, with voxels in place of Gaussians. usual_extent_m and hold_back were tuned on the
    same frames, with the detections of two detectors.
    """

    ema: Literal["paper", "corrected"] = "corrected"  # Rule of the update; see `observe`.
    # Factor by which each new observation reduces the weight of earlier ones: lambda
    # (LDO-SLAM paper, III.A).
    keep: float = 0.9
    # Number of misses in a row that turn a Gaussian into background by the rule `paper`: N_miss
    # (LDO-SLAM paper, III.A). A miss is a keyframe that shows the Gaussian, but no region at the
    # Gaussian.
    miss_limit: int = 5
    # A miss with `corrected` is evidence for background if the object would appear large enough for
    # the detector to find it. The next three settings define this.
    miss_weight: float = 0.3  # Weight of a miss; the weight of a detection is its confidence.
    min_px: float = 40.0  # Minimum side (pixels) of an object's box for a miss to count.
    # Assumed size of a Gaussian's object while no label of the Gaussian has been observed.
    usual_extent_m: float = 0.5
    # Damping, 0..1, of low-confidence observations of low-entropy Gaussians; 0: no damping.
    hold_back: float = 1.0

    def __post_init__(self) -> None:
        if self.ema not in ("paper", "corrected"):
            raise ConfigError(f"LabelConfig.ema={self.ema!r} must be 'paper' or 'corrected'.")
        if not (0 <= self.keep < 1 and 0 <= self.miss_weight <= 1 and 0 <= self.hold_back <= 1):
            raise ConfigError(
                named(self, "keep", "miss_weight", "hold_back")
                + ": keep must be in [0, 1), miss_weight and hold_back in [0, 1]."
            )
        if not (1 <= self.miss_limit <= 255 and self.min_px >= 0 and self.usual_extent_m >= 0):
            raise ConfigError(
                named(self, "miss_limit", "min_px", "usual_extent_m")
                + ": miss_limit must be in 1..255, min_px and usual_extent_m not negative."
            )


@dataclass(frozen=True, eq=False, slots=True)
class Observations:
    """Observations of V Gaussians in a keyframe.

    Attributes:
        indices: Row numbers of the Gaussians in the map, [V] uint32, ascending.
        labels: Observed labels, [V] int16. The value MISS means that the Gaussian is visible, but
            in no region. NOT_SEEN means that nothing was observed.
        confidences: Confidences of the labels, [V] float32, 0..1.
        extents_m: Size of the object with the observed label, [V] float32, meters. For a miss, this
            is the minimum size of objects for which the miss counts.
    """

    indices: np.ndarray
    labels: np.ndarray
    confidences: np.ndarray
    extents_m: np.ndarray


def fields(labels: np.ndarray) -> np.ndarray:
    """Return label rows, [N, 32] uint8, as an array view of N records of type `ROW`."""
    return labels.view(ROW)[:, 0]


def observe(
    labels: np.ndarray, seen: Observations, config: LabelConfig, *, threads: int = 1
) -> None:
    """Update label rows, [N, 32] uint8, in place by the observations of a keyframe.

    Each Gaussian has a label distribution p. An observation of label s changes p to

        p <- (1 - a) p + a onehot(s)

    The setting `ema` selects the rule for the step size a:

    - `paper`: a = 1 - keep. With keep = 0.9, seven observations in a row change the likeliest
      label. After miss_limit misses in a row, the Gaussian becomes background.
    - `corrected`: a = w / W. The weight w of an observation is its confidence. W is the sum of all
      weights, which decay with age: W <- keep W + w. The first observation thus has a = 1. A miss
      is an observation of background with w = miss_weight. It counts only if the Gaussian's object
      would appear at least min_px large. The size of the object is from the last observation of a
      label; before the first one, it is usual_extent_m.

    Observations with low confidence have less effect on Gaussians whose p has a low entropy H
    (nats). For this, a (rule `paper`) or w (rule `corrected`) is multiplied by the factor
    1 - hold_back exp(-2 H) (1 - confidence). The factor is 1 while p is background only.

    The result is bitwise equal for any number of threads. See the LDO-SLAM paper, III.A.

    Raises:
        ValueError: An array has a wrong shape or type.

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

    With hold_back = 1 and H = 0, a confidence of 0.5 gives w = 0.5 (1 - (1 - 0.5)) = 0.25.

    >>> labels = new_labels(1)
    >>> see(2, 0.6, LabelConfig())  # No label yet, so the factor is 1: W = 0.6.
    [0.0, 0.0, 1.0, 0.0]
    >>> see(3, 0.5, LabelConfig())  # w = 0.25, W = 0.54 + 0.25, a = 0.316
    [0.0, 0.0, 0.684, 0.316]
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
    """Set the probability of background to zero in rows `indices` [V] of labels [N, 32], in place.

    The other probabilities are scaled to a sum of one. The field `evidence` is multiplied by the
    sum that they had before.

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
    """Clear rows `indices` [V] of labels [N, 32], in place, to the state before any observation."""
    labels[indices] = 0


def background(labels: np.ndarray) -> np.ndarray:
    """Return the probability of background, [N] float32, in each of N label rows, [N, 32]."""
    weights = fields(labels)["weights"]
    total = weights[:, 0] + weights[:, 1]  # Three times faster than `sum(axis=1)`, and equal.
    for slot in range(2, SLOTS):
        total += weights[:, slot]
    return np.maximum(1 - total, 0)


def top_labels(labels: np.ndarray) -> np.ndarray:
    """Return the likeliest label, [N] uint8, of each of N label rows, [N, 32].

    If background is as likely as the likeliest other label, the result is background.
    """
    rows = fields(labels)
    return np.where(rows["weights"][:, 0] > background(labels), rows["ids"][:, 0], BACKGROUND)


def count_labelled(labels: np.ndarray) -> int:
    """Return the number of label rows, [N, 32], whose likeliest label is not background."""
    return int(np.count_nonzero(fields(labels)["weights"][:, 0] > background(labels)))


def distribution(labels: np.ndarray, classes: int = MAX_LABELS) -> np.ndarray:
    """Convert label rows to dense distributions, which have a probability for each label.

    Args:
        labels: Label rows, [N, 32] uint8.
        classes: Number of labels of each distribution.

    Returns:
        The distributions, [N, classes] float32; each row sums to one.

    Raises:
        ValueError: A label number is not below `classes`.
    """
    rows = fields(labels)
    used = rows["weights"] > 0
    if np.any(rows["ids"][used] >= classes):
        raise ValueError(
            f"label number {rows['ids'][used].max()} must be below {classes}, the value of classes."
        )
    out = np.zeros((len(labels), classes), np.float32)
    out[:, BACKGROUND] = background(labels)
    which = np.nonzero(used)
    out[which[0], rows["ids"][which]] = rows["weights"][which]
    return out


def entropy(labels: np.ndarray) -> np.ndarray:
    """Return the entropy H = -sum p log p of each of N label rows, [N, 32], in nats, [N].

    >>> labels = new_labels(1)
    >>> fields(labels)["weights"][0, 0] = 0.5
    >>> round(float(entropy(labels)[0]), 4)  # log 2
    0.6931
    """
    p = np.concatenate([fields(labels)["weights"], background(labels)[:, None]], axis=1)
    return -np.sum(p * np.log(np.where(p > 0, p, 1)), axis=1)
