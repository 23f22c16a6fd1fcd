"""Distributions of landmarks against a general minimiser of the stated sum."""

import numpy as np
from scipy.optimize import minimize

from ldo_service.pose_graph.label_fusion import Evidence, fuse_labels, geometric_mean, objective

CLASSES = 6
MOSTLY_FIRST = np.r_[4.0, np.full(CLASSES - 1, 0.4)]
MOSTLY_SECOND = np.r_[0.3, 4.0, np.full(CLASSES - 2, 0.3)]


def observed(rng: np.random.Generator, of: np.ndarray, times: int) -> Evidence:
    evidence = Evidence.none(CLASSES)
    for _ in range(times):
        q = rng.dirichlet(of)
        entropy = -(q * np.log(q)).sum()
        evidence = evidence.with_observed(q, np.exp(-2 * entropy) if entropy > 0.5 else 1.0)
    return evidence


def test_alone_a_landmark_is_the_weighted_geometric_mean() -> None:
    q, r = np.array([0.7, 0.2, 0.1]), np.array([0.1, 0.8, 0.1])
    evidence = Evidence.none(3).with_observed(q, 1.0).with_observed(r, 0.5)
    expected = q ** (2 / 3) * r ** (1 / 3)
    np.testing.assert_allclose(geometric_mean(evidence), expected / expected.sum())
    np.testing.assert_allclose(fuse_labels({4: evidence})[4], expected / expected.sum())


def test_sweeps_end_where_a_general_minimizer_does() -> None:
    rng = np.random.default_rng(0)
    evidence = {k: observed(rng, MOSTLY_FIRST if k < 4 else MOSTLY_SECOND, 4) for k in range(5)}
    pairs = [(i, j) for j in range(5) for i in range(j)]
    for w_sem in (0.1, 1.0):
        p = fuse_labels(evidence, pairs, w_sem=w_sem)
        alike = [(i, j) for i, j in pairs if p[i].argmax() == p[j].argmax()]
        assert len(alike) == 6, "the last is of another class"

        def softmax(x: np.ndarray) -> np.ndarray:
            exp = np.exp(x.reshape(5, CLASSES))
            return exp / exp.sum(axis=1, keepdims=True)

        def cost(x: np.ndarray, alike=alike, w_sem=w_sem) -> float:
            return objective(dict(enumerate(softmax(x))), evidence, alike, w_sem=w_sem)

        best = minimize(cost, np.zeros(5 * CLASSES), options={"gtol": 1e-10, "maxiter": 2000})
        np.testing.assert_allclose(softmax(best.x), list(p.values()), atol=1e-4)
        assert objective(p, evidence, alike, w_sem=w_sem) <= best.fun + 1e-8


def test_similarity_draws_landmarks_of_one_class_together() -> None:
    rng = np.random.default_rng(1)
    evidence = {k: observed(rng, MOSTLY_FIRST, 3) for k in range(2)}
    apart, near = (fuse_labels(evidence, [(0, 1)], w_sem=w) for w in (0.0, 2.0))
    assert np.abs(near[0] - near[1]).sum() < 0.8 * np.abs(apart[0] - apart[1]).sum()


def test_a_class_that_was_never_named_is_unlikely_and_not_impossible() -> None:
    p = fuse_labels({0: Evidence.none(3).with_observed(np.array([0.5, 0.5, 0.0]), 1.0)})[0]
    assert 0 < p[2] < 1e-5


def test_two_fusions_are_the_same_bits_whatever_the_order_of_pairs() -> None:
    rng = np.random.default_rng(2)
    evidence = {k: observed(rng, MOSTLY_FIRST, 3) for k in range(6)}
    pairs = [(i, j) for j in range(6) for i in range(j)]
    one, two = (
        fuse_labels(evidence, pairs),
        fuse_labels(dict(reversed(evidence.items())), pairs[::-1]),
    )
    assert list(one) == list(two)
    assert all(np.array_equal(one[k], two[k]) for k in one)
