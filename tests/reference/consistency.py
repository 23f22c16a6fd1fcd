"""NumPy reference implementation of `smooth_labels`."""

from itertools import product

import numpy as np

from ldo_service.semantics.gaussian_labels import (
    MAX_LABELS,
    ConsistencyConfig,
    Disagreement,
    distribution,
    top_labels,
)

SAME_VOXEL, MOST = 8, 16
STEPS = sorted(product((-1, 0, 1), repeat=3), key=lambda s: (sum(x * x for x in s), s))


def agree_reference(
    rows: np.ndarray, labels: np.ndarray, indices: np.ndarray, config: ConsistencyConfig
) -> tuple[np.ndarray, Disagreement]:
    """Return the dense distributions [V, 256] after the step, and the disagreement before it."""
    means = rows[indices, :3].astype(float)
    p = distribution(labels[indices], MAX_LABELS).astype(float)
    top = top_labels(labels[indices])
    voxels = np.floor(rows[indices, :3] * np.float32(1 / np.float32(2 * config.sigma_m)))
    members: dict[tuple[int, ...], list[int]] = {}
    for i, voxel in enumerate(voxels.astype(int)):
        members.setdefault(tuple(voxel), []).append(i)
    after, literal, expected = p.copy(), 0.0, 0.0
    for voxel, own in members.items():
        around = np.array(neighborhood(members, voxel))
        for i in own:
            square = np.sum((means[around] - means[i]) ** 2, axis=1)
            near = (around != i) & (square < config.radius_m**2)
            j = around[near]
            k = np.exp(-square[near] / config.sigma_m**2) / max(len(j), 1)
            after[i] += config.rate * (k @ p[j] - k.sum() * p[i])
            literal += k[top[j] != top[i]].sum()
            expected += k @ (1 - p[j] @ p[i])
    return after, Disagreement(literal, expected)


def neighborhood(members: dict[tuple[int, ...], list[int]], voxel: tuple[int, ...]) -> list[int]:
    """Return at most MOST Gaussians as a sample of the neighborhood of a voxel."""
    own, *others = (members.get(tuple(np.add(voxel, step)), []) for step in STEPS)
    out = own[:SAME_VOXEL]
    for turn in range(max(map(len, others), default=0)):
        out += [other[turn] for other in others if turn < len(other)]
    return out[:MOST]
