"""What things are, as distributions over the labels of a vocabulary: dense [..., C], C = 256.

Kept and sent they are sparse: the eight heaviest labels; what the others had is on `other`.
"""

import numpy as np

from .gaussian_labels import BACKGROUND, MAX_LABELS, OTHER, background, fields

KEPT = 8  # labels of a sparse distribution: the five of a Gaussian, and those of its neighbours
FLOOR = 1e-6  # of what a distribution holds impossible, so that divergences are finite


def mean_distributions(labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[K, C] float64: means of the distributions of K groups of M Gaussians.

        p_k = sum_m w_km p_km / sum_m w_km

    labels [K, M, 32] uint8, rows of `labels`; weights [K, M], 0 where a group has fewer.
    All on background where all weights are 0. Paper, III.C (landmarks).

    One that is wholly label 2 and weighs 3, and one that is half of it and weighs 1:

    >>> from ldo_service.semantics.gaussian_labels import new_labels
    >>> labels = new_labels(2)
    >>> fields(labels)["ids"][:, 0], fields(labels)["weights"][:, 0] = 2, (1, 0.5)
    >>> mean_distributions(labels[None], np.array([[3.0, 1.0]]))[0, :3].tolist()  # (3 + 0.5) / 4
    [0.125, 0.0, 0.875]
    """
    groups, each = weights.shape
    rows = labels.reshape(groups * each, labels.shape[-1])
    weight = weights.reshape(-1, 1)
    group = np.repeat(np.arange(groups), each)[:, None] * MAX_LABELS
    cells = np.concatenate([group + fields(rows)["ids"], group + BACKGROUND], axis=1)
    mass = np.concatenate([fields(rows)["weights"], background(rows)[:, None]], axis=1) * weight
    sums = np.bincount(cells.ravel(), mass.ravel(), groups * MAX_LABELS)
    return normalized(sums.reshape(groups, MAX_LABELS))


def normalized(p: np.ndarray) -> np.ndarray:
    """Rows that sum to one; all on background where there is nothing."""
    total = p.sum(axis=-1, keepdims=True)
    nothing = np.zeros(p.shape[-1])
    nothing[BACKGROUND] = 1
    return np.where(total > 0, p / np.where(total > 0, total, 1), nothing)


def sparse(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels [..., 8] uint8 and weights [..., 8] float32 of the heaviest, heaviest first; of equals
    the first. What is missing from one belongs to `other`."""
    order = np.argsort(-p, axis=-1, kind="stable")[..., :KEPT]
    return order.astype(np.uint8), np.take_along_axis(p, order, axis=-1).astype(np.float32)


def dense(labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[..., C] float64 of sparse ones, with what they miss on `other`."""
    out = np.zeros((*labels.shape[:-1], MAX_LABELS))
    np.put_along_axis(out, labels.astype(np.int64), weights.astype(float), axis=-1)
    out[..., OTHER] += np.maximum(1 - weights.sum(axis=-1, dtype=float), 0)
    return normalized(out)


def divergence(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """[...], KL(p || q) = sum_c p_c log(p_c / q_c) in nats, of dense [..., C]; q_c at least 1e-6.

    >>> couch, both = np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.1, 0.8])
    >>> round(float(divergence(couch, both)), 4)  # log(1 / 0.8)
    0.2231
    >>> round(float(divergence(both, couch)), 2)  # 0.2 log(0.1 / 1e-6) + 0.8 log 0.8
    2.12
    """
    ratio = np.where(p > 0, p, 1) / np.maximum(q, FLOOR)
    return np.sum(p * np.log(ratio), axis=-1)


def entropy(p: np.ndarray) -> np.ndarray:
    """[...], H = -sum_c p_c log p_c in nats (III.C), of dense [..., C]."""
    return -np.sum(p * np.log(np.where(p > 0, p, 1)), axis=-1)


def common_mass(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """[...], how much two distributions have in common, 0..1, background apart:
    sum_c min(p_c, q_c) over the smaller mass that is not background."""
    p, q = p.copy(), q.copy()
    p[..., BACKGROUND] = q[..., BACKGROUND] = 0
    least = np.minimum(p.sum(axis=-1), q.sum(axis=-1))
    common = np.minimum(p, q).sum(axis=-1)
    return np.where(least > 0, common / np.where(least > 0, least, 1), 0)


def names(p: np.ndarray) -> np.ndarray:
    """[...] uint8, the heaviest label but background."""
    p = p.copy()
    p[..., BACKGROUND] = -1
    return np.argmax(p, axis=-1).astype(np.uint8)
