"""Tests of label fusion against a general minimizer of its objective."""

import numpy as np
from scipy.optimize import minimize

from ldo_service.pose_graph.label_fusion import Evidence, fuse_labels, geometric_mean, objective

CLASSES = 6
MOSTLY_FIRST_CLASS = np.r_[4.0, np.full(CLASSES - 1, 0.4)]
MOSTLY_SECOND_CLASS = np.r_[0.3, 4.0, np.full(CLASSES - 2, 0.3)]


def observed_evidence(rng: np.random.Generator, concentration: np.ndarray, count: int) -> Evidence:
    """Return the evidence of class distributions drawn from a Dirichlet distribution."""
    evidence = Evidence.none(CLASSES)
    for _ in range(count):
        q = rng.dirichlet(concentration)
        entropy = -(q * np.log(q)).sum()
        evidence = evidence.with_observed(q, np.exp(-2 * entropy) if entropy > 0.5 else 1.0)
    return evidence


def test_single_landmark_gets_the_weighted_geometric_mean() -> None:
    q, r = np.array([0.7, 0.2, 0.1]), np.array([0.1, 0.8, 0.1])
    evidence = Evidence.none(3).with_observed(q, 1.0).with_observed(r, 0.5)
    expected = q ** (2 / 3) * r ** (1 / 3)
    np.testing.assert_allclose(geometric_mean(evidence), expected / expected.sum())
    np.testing.assert_allclose(fuse_labels({4: evidence})[4], expected / expected.sum())


def test_sweeps_converge_to_the_minimum_that_scipy_finds() -> None:
    rng = np.random.default_rng(0)
    evidence = {
        k: observed_evidence(rng, MOSTLY_FIRST_CLASS if k < 4 else MOSTLY_SECOND_CLASS, 4)
        for k in range(5)
    }
    pairs = [(i, j) for j in range(5) for i in range(j)]
    for w_sem in (0.1, 1.0):
        p = fuse_labels(evidence, pairs, w_sem=w_sem)
        same_class_pairs = [(i, j) for i, j in pairs if p[i].argmax() == p[j].argmax()]
        assert len(same_class_pairs) == 6, "the last landmark has another class"

        def softmax(x: np.ndarray) -> np.ndarray:
            exp = np.exp(x.reshape(5, CLASSES))
            return exp / exp.sum(axis=1, keepdims=True)

        def cost(x: np.ndarray, same_class_pairs=same_class_pairs, w_sem=w_sem) -> float:
            return objective(dict(enumerate(softmax(x))), evidence, same_class_pairs, w_sem=w_sem)

        best = minimize(cost, np.zeros(5 * CLASSES), options={"gtol": 1e-10, "maxiter": 2000})
        np.testing.assert_allclose(softmax(best.x), list(p.values()), atol=1e-4)
        assert objective(p, evidence, same_class_pairs, w_sem=w_sem) <= best.fun + 1e-8


def test_similarity_term_pulls_landmarks_of_one_class_together() -> None:
    rng = np.random.default_rng(1)
    evidence = {k: observed_evidence(rng, MOSTLY_FIRST_CLASS, 3) for k in range(2)}
    without_similarity, with_similarity = (
        fuse_labels(evidence, [(0, 1)], w_sem=w) for w in (0.0, 2.0)
    )
    assert (
        np.abs(with_similarity[0] - with_similarity[1]).sum()
        < 0.8 * np.abs(without_similarity[0] - without_similarity[1]).sum()
    )


def test_unobserved_class_keeps_a_small_positive_probability() -> None:
    p = fuse_labels({0: Evidence.none(3).with_observed(np.array([0.5, 0.5, 0.0]), 1.0)})[0]
    assert 0 < p[2] < 1e-5


def test_fusion_is_bitwise_independent_of_the_order_of_landmarks_and_pairs() -> None:
    rng = np.random.default_rng(2)
    evidence = {k: observed_evidence(rng, MOSTLY_FIRST_CLASS, 3) for k in range(6)}
    pairs = [(i, j) for j in range(6) for i in range(j)]
    fused, fused_in_reverse = (
        fuse_labels(evidence, pairs),
        fuse_labels(dict(reversed(evidence.items())), pairs[::-1]),
    )
    assert list(fused) == list(fused_in_reverse)
    assert all(np.array_equal(fused[k], fused_in_reverse[k]) for k in fused)
