"""Fusion of the observed class distributions of landmarks.

The fusion minimizes the cost G(p) of the class distributions p (see `ldo_service.pose_graph`).
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import wrightomega

# Minimum probability of a class in an observation: a class that an observation does not contain is
# improbable, but not impossible.
FLOOR = 1e-6
# Maximum number of Newton steps; 5 to 15 are usual. The iteration is monotone, so it cannot cycle.
NEWTON_STEPS = 60


@dataclass(frozen=True, slots=True)
class Evidence:
    """Observed class distributions of a landmark, summed over all its observations.

    Observation k has the class distribution q_k and the weight w_k. The cost of a distribution p
    depends on the observations only through the sums W and L:

        sum_k w_k KL(p || q_k) = W sum_c p_c log p_c - sum_c p_c L_c
        W = sum_k w_k,    L = sum_k w_k log q_k
    """

    weight: float  # W.
    log_sum: np.ndarray  # L [C], nats.

    @staticmethod
    def none(classes: int) -> "Evidence":
        """Return the evidence of a landmark without observations, for a number of classes."""
        return Evidence(0.0, np.zeros(classes))

    def with_observed(self, q: np.ndarray, weight: float) -> "Evidence":
        """Return the evidence with one more observation.

        Args:
            q: Distribution [C] that sums to one. Probabilities below 1e-6 are raised to 1e-6.
            weight: Weight w_k of the observation.
        """
        floored = np.maximum(q, FLOOR)
        log_q = np.log(floored / floored.sum())
        return Evidence(self.weight + weight, self.log_sum + weight * log_q)


def fuse_labels(
    evidence: Mapping[int, Evidence],
    covisible: Iterable[tuple[int, int]] = (),
    *,
    lambda_sem: float = 0.5,
    w_sem: float = 0.1,
    start: Mapping[int, np.ndarray] | None = None,
    only: Collection[int] | None = None,
    sweeps: int = 20,
    tolerance: float = 1e-9,
) -> dict[int, np.ndarray]:
    """Return the fused class distribution p_l [C] of every landmark l, in the order of their ids.

    The distributions minimize this sum:

        lambda sum_lk w_k KL(p_l || q_lk)
        + w_sem / 2 sum_ij (KL(p_i || p_j) + KL(p_j || p_i)) [argmax p_i = argmax p_j]

    The observation of landmark l in keyframe k has the class distribution q_lk and the weight w_k.
    The bracket is 1 if both landmarks have the same likeliest class, else 0. The method is
    Gauss-Seidel (LDO-SLAM paper, III.C): each sweep minimizes over one landmark after the other, in
    the order of their ids. Just before the minimization over a landmark, the sweep determines again
    which neighbors have the same likeliest class as this landmark. Equal arguments give equal
    results.

    Args:
        evidence: Sums over the observations of each landmark, by its id.
        covisible: Pairs of landmarks that are observed in the same keyframe; each pair counts once.
        lambda_sem: Weight of the observations.
        w_sem: Weight of the similarity.
        start: Start value [C] by landmark. A landmark without a start value starts at the geometric
            mean of its observations.
        only: Ids of the landmarks to optimize; the others keep their start values. None optimizes
            all landmarks.
        sweeps: Maximum number of sweeps.
        tolerance: Sweeps end when no probability changes by more than this.
    """
    p = {k: geometric_mean(evidence[k]) for k in sorted(evidence)}
    p |= {k: v for k, v in (start or {}).items() if k in p}
    neighbors = _neighbors(covisible, p)
    if only is not None:
        neighbors = {k: others for k, others in neighbors.items() if k in only}
    for _ in range(sweeps):
        largest = 0.0
        for k, others in neighbors.items():
            alike = [p[j] for j in others if p[j].argmax() == p[k].argmax()]
            new = _minimum(evidence[k], alike, lambda_sem, w_sem)
            largest = max(largest, float(np.abs(new - p[k]).max()))
            p[k] = new
        if largest < tolerance:
            break
    return p


def geometric_mean(evidence: Evidence) -> np.ndarray:
    """Return the weighted geometric mean of the observations, [C].

    Observation k has the class distribution q_k and the weight w_k; W is the sum of the weights.
    The mean minimizes sum_k w_k KL(p || q_k) over p, and is proportional to prod_k q_k^(w_k / W).
    """
    mean = evidence.log_sum / max(evidence.weight, np.finfo(float).tiny)
    p = np.exp(mean - mean.max())
    return p / p.sum()


def objective(
    p: Mapping[int, np.ndarray],
    evidence: Mapping[int, Evidence],
    pairs: Iterable[tuple[int, int]],
    lambda_sem: float = 0.5,
    w_sem: float = 0.1,
) -> float:
    """Return the cost G(p) of the class distributions p of all landmarks.

    The formula of G is in `ldo_service.pose_graph`. A constant that does not depend on p is left
    out.

    Args:
        p: Class distribution [C] of each landmark, by landmark id.
        evidence: Observed distributions of each landmark, by landmark id.
        pairs: Pairs of landmarks that count as similar, even if their likeliest labels differ.
        lambda_sem: Weight of the observations.
        w_sem: Weight of the similarity.
    """
    observed = sum(
        evidence[k].weight * np.sum(p_k * np.log(p_k)) - p_k @ evidence[k].log_sum
        for k, p_k in p.items()
    )
    alike = sum((p[i] - p[j]) @ (np.log(p[i]) - np.log(p[j])) for i, j in pairs)
    return float(lambda_sem * observed + 0.5 * w_sem * alike)


def _neighbors(
    covisible: Iterable[tuple[int, int]], known: Mapping[int, object]
) -> dict[int, list[int]]:
    neighbors: dict[int, list[int]] = {}
    for i, j in sorted({(min(pair), max(pair)) for pair in covisible}):
        if i != j and i in known and j in known:
            neighbors.setdefault(i, []).append(j)
            neighbors.setdefault(j, []).append(i)
    return dict(sorted(neighbors.items()))


def _minimum(
    evidence: Evidence, alike: list[np.ndarray], lambda_sem: float, w_sem: float
) -> np.ndarray:
    """Return the distribution [C] of one landmark that minimizes G while all others are fixed.

    `alike` has the distributions of the n neighbors with the same argmax. At the minimum, this
    condition with the Lagrange multiplier nu holds:

        a (log p_c + 1) - g_c - b_c / p_c + nu = 0,    a = lambda W + n w / 2,
        g = lambda L + w / 2 sum_j log p_j,            b = w / 2 sum_j p_j

    Its solution is p_c = (b_c / a) / omega(log(b_c / a) + 1 + (nu - g_c) / a). Here omega is
    Wright's function, with omega(x) + log omega(x) = x. The sum of p_c over c decreases with nu.
    Newton's method finds the nu for which this sum is one.
    """
    half = 0.5 * w_sem
    a = lambda_sem * evidence.weight + half * len(alike)
    if not alike or half == 0:
        return geometric_mean(evidence)
    g = lambda_sem * evidence.log_sum + half * np.sum(np.log(alike), axis=0)
    log_b = np.log(half * np.sum(alike, axis=0) / a)
    x = 1 - g / a + log_b
    # The start value of nu makes sum_c p_c larger than one. The sum is a convex function of nu, so
    # Newton's method approaches the solution from one side.
    nu = float(np.max(g / a)) - 1
    p = np.ones_like(g)
    for _ in range(NEWTON_STEPS):
        omega = wrightomega(x + nu)
        p = np.exp(log_b) / omega
        excess = p.sum() - 1
        if abs(excess) < 1e-14:
            break
        nu += excess / np.sum(p / (1 + omega))
    return p / p.sum()
