"""Probability distributions over the labels of a vocabulary, in dense or sparse form.

A dense distribution has a probability for each of C = 256 labels, [..., C]. A sparse distribution
has the eight labels of highest probability, and counts the rest of the probability as label
`other`. Distributions are stored and published in sparse form.
"""

import numpy as np

from .gaussian_labels import BACKGROUND, MAX_LABELS, OTHER, background, fields

# Labels of a sparse distribution. A Gaussian has five; the mean of several Gaussians has more.
KEPT = 8
FLOOR = 1e-6  # Minimum probability in a divergence, so that divergences are finite.


def mean_distributions(labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the mean label distributions [K, C] float64 of K groups of M Gaussians.

        p_k = sum_m w_km p_km / sum_m w_km

    Gaussian m of group k has the label distribution p_km and the weight w_km. The mean is the label
    distribution of a landmark in the LDO-SLAM paper, III.C.

    Args:
        labels: Label rows of the Gaussians, [K, M, 32] uint8, see `gaussian_labels.ROW`.
        weights: Weights of the Gaussians, [K, M]; 0 where a group has fewer than M Gaussians.

    Returns:
        The means. If all weights of a group are 0, background has probability 1.

    Example: one group of two Gaussians. The first has weight 3 and is certain to have label 2. The
    second has weight 1, and label 2 has a probability of one half.

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
    """Scale each row to a sum of one; in a row of zeros, background gets probability 1."""
    total = p.sum(axis=-1, keepdims=True)
    nothing = np.zeros(p.shape[-1])
    nothing[BACKGROUND] = 1
    return np.where(total > 0, p / np.where(total > 0, total, 1), nothing)


def sparse(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert dense distributions [..., C] to sparse ones.

    Returns:
        The eight labels of highest probability, [..., 8] uint8, and their probabilities, [..., 8]
        float32. The highest probability comes first. Of two labels with equal probability, the
        label with the lower number comes first. If the eight probabilities sum to less than one,
        label `other` has the rest.
    """
    order = np.argsort(-p, axis=-1, kind="stable")[..., :KEPT]
    return order.astype(np.uint8), np.take_along_axis(p, order, axis=-1).astype(np.float32)


def dense(labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Convert sparse distributions to dense ones, [..., C] float64.

    If the probabilities of a distribution sum to less than one, label `other` gets the rest.

    Args:
        labels: Labels, [..., 8] uint8.
        weights: Probabilities of the labels, [..., 8].
    """
    out = np.zeros((*labels.shape[:-1], MAX_LABELS))
    np.put_along_axis(out, labels.astype(np.int64), weights.astype(float), axis=-1)
    out[..., OTHER] += np.maximum(1 - weights.sum(axis=-1, dtype=float), 0)
    return normalized(out)


def divergence(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the divergences KL(p || q) = sum_c p_c log(p_c / q_c) in nats, [...].

    p and q are dense label distributions, [..., C]. Values of q_c below 1e-6 are set to 1e-6.

    >>> couch, both = np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.1, 0.8])
    >>> round(float(divergence(couch, both)), 4)  # log(1 / 0.8)
    0.2231
    >>> round(float(divergence(both, couch)), 2)  # 0.2 log(0.1 / 1e-6) + 0.8 log 0.8
    2.12
    """
    ratio = np.where(p > 0, p, 1) / np.maximum(q, FLOOR)
    return np.sum(p * np.log(ratio), axis=-1)


def entropy(p: np.ndarray) -> np.ndarray:
    """Return the entropies H = -sum_c p_c log p_c of dense distributions p, [..., C].

    The entropies are in nats, [...]. See the LDO-SLAM paper, III.C.
    """
    return -np.sum(p * np.log(np.where(p > 0, p, 1)), axis=-1)


def common_mass(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the common mass of pairs of dense distributions p and q, [..., C].

        mass = sum_c min(p_c, q_c) / min(sum_c p_c, sum_c q_c)

    The sums are over all labels c except background.

    Returns:
        The common mass, [...], 0..1; 0 if background has probability 1 in p or q.
    """
    p, q = p.copy(), q.copy()
    p[..., BACKGROUND] = q[..., BACKGROUND] = 0
    least = np.minimum(p.sum(axis=-1), q.sum(axis=-1))
    common = np.minimum(p, q).sum(axis=-1)
    return np.where(least > 0, common / np.where(least > 0, least, 1), 0)


def names(p: np.ndarray) -> np.ndarray:
    """Return the likeliest label of each distribution, apart from background.

    Args:
        p: Dense distributions, [..., C].

    Returns:
        The labels, [...] uint8.
    """
    p = p.copy()
    p[..., BACKGROUND] = -1
    return np.argmax(p, axis=-1).astype(np.uint8)
