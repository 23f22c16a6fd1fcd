"""Tests of landmarks from detections: clustering, class labels and layout."""

import numpy as np

from ldo_service.geometry import Camera, se3
from ldo_service.loop_closing.object_points import (
    DetectionPoints,
    LandmarkConfig,
    SubgraphLandmarks,
    cluster_landmarks,
    compare_landmarks_at,
    layout_histogram,
    locate_detections,
    possible_pairs,
)

CONFIG = LandmarkConfig()
CHAIR, CUP, SINK = 58, 43, 73  # Arbitrary labels.


def detected(*objects: tuple[int, float, tuple[float, float, float]]) -> DetectionPoints:
    labels, scores, places = zip(*objects, strict=True)
    return DetectionPoints(
        np.array(labels, np.uint8), np.array(scores, np.float32), np.float32(places)
    )


def landmarks_of(*observations: DetectionPoints) -> SubgraphLandmarks:
    return cluster_landmarks(observations, [np.eye(4)] * len(observations), CONFIG)


def test_detection_is_located_at_the_foreground_of_its_box() -> None:
    """The camera looks at a block one meter in front of a wall."""
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
    depth_m = np.full((120, 160), 3.0, np.float32)
    depth_m[40:80, 60:100] = 2.0
    box = np.array([[55.0, 35, 104, 84]])
    found = locate_detections(np.array([CHAIR]), np.array([0.8]), box, depth_m, camera, CONFIG)
    np.testing.assert_allclose(found.p_camera, [[0, 0, 2]], atol=0.02)
    assert found.histogram()[CHAIR] == np.float32(0.8)
    assert found.histogram().sum() == np.float32(0.8)


def test_observations_of_one_object_form_one_landmark_at_their_mean() -> None:
    first, second = (
        detected((CHAIR, 0.8, (0, 0, 2)), (CUP, 0.5, (0, 0, 2))),
        detected((CHAIR, 0.6, (0.2, 0, 2)), (CHAIR, 0.9, (2, 0, 2))),
    )
    found = landmarks_of(first, second)
    np.testing.assert_allclose(found.p_odom, [[0.1, 0, 2], [0, 0, 2], [2, 0, 2]], atol=1e-6)
    p = found.distributions
    np.testing.assert_allclose(p[0, [CHAIR, 1]], [0.7, 0.3], atol=1e-6)
    np.testing.assert_allclose(p.sum(axis=1), 1)


def test_detection_without_depth_is_no_landmark_but_in_the_histogram() -> None:
    without_depth = detected((CHAIR, 0.8, (np.nan, np.nan, np.nan)))
    assert len(landmarks_of(without_depth)) == 0
    assert without_depth.histogram()[CHAIR] > 0


def test_possible_pairs_are_landmarks_of_one_class() -> None:
    old = landmarks_of(detected((CHAIR, 0.8, (0, 0, 2)), (CUP, 0.9, (1, 0, 2))))
    new = landmarks_of(
        detected((CUP, 0.8, (0, 0, 2)), (CHAIR, 0.6, (1, 0, 2)), (SINK, 1, (2, 0, 2)))
    )
    assert possible_pairs(old, new, CONFIG).tolist() == [[0, 1], [1, 0]]


def test_comparison_counts_landmarks_that_agree_and_contradict() -> None:
    objects = ((CHAIR, 0.8, (0, 0, 2)), (CUP, 0.9, (1, 0, 2)), (SINK, 0.7, (2, 0, 2)))
    old, T_old_new = landmarks_of(detected(*objects)), se3.exp(np.array([0.1, 0.2, 0.3, 1, 2, 3]))
    p_new = se3.transform(se3.inverse(T_old_new), old.p_odom)
    # The new landmarks have a cup in place of the sink.
    new = SubgraphLandmarks(p_new, old.labels[[0, 1, 1]], old.weights[[0, 1, 1]])
    found = compare_landmarks_at(old, new, T_old_new, CONFIG)
    assert (found.count, found.contradicted) == (2, 1)
    assert found.divergence < 1e-6
    expected = -np.mean(
        [0.8 * np.log(0.8) + 0.2 * np.log(0.2), 0.9 * np.log(0.9) + 0.1 * np.log(0.1)]
    )
    assert abs(found.entropy - expected) < 1e-5


def test_layout_histogram_ignores_rotation_and_depends_on_distances() -> None:
    rng = np.random.default_rng(0)
    original = SubgraphLandmarks(
        rng.uniform(-2, 2, (6, 3)),
        np.tile(np.uint8([CHAIR, 1, 0, 0, 0, 0, 0, 0]), (6, 1)),
        np.tile(np.float32([0.8, 0.2, 0, 0, 0, 0, 0, 0]), (6, 1)),
    )
    turned = SubgraphLandmarks(
        se3.transform(se3.exp(rng.normal(size=6)), original.p_odom),
        original.labels,
        original.weights,
    )
    wide = SubgraphLandmarks(3 * original.p_odom, original.labels, original.weights)
    np.testing.assert_allclose(layout_histogram(turned), layout_histogram(original), atol=1e-4)
    assert abs(layout_histogram(original).sum() - 15) < 1e-4, "one entry per pair"
    assert np.minimum(layout_histogram(wide), layout_histogram(original)).sum() < 8


def test_uncertain_landmark_neither_agrees_with_nor_contradicts_its_class() -> None:
    places = [(float(x), 0.0, 2.0) for x in range(5)]
    labels = (CHAIR, CUP, CHAIR, SINK, CHAIR)
    confident, uncertain = (
        landmarks_of(
            detected(*((label, score, p) for label, p in zip(labels, places, strict=True)))
        )
        for score in (0.9, 0.4)
    )
    assert uncertain.names.tolist() == list(labels)
    found = compare_landmarks_at(confident, uncertain, np.eye(4), CONFIG)
    assert (found.count, found.contradicted) == (0, 0), "too uncertain to count for or against"
    np.testing.assert_array_equal(layout_histogram(confident), layout_histogram(uncertain))
    others = landmarks_of(detected(*((SINK, 0.4, p) for p in places)))
    assert compare_landmarks_at(confident, others, np.eye(4), CONFIG).contradicted == 4
