"""Landmarks from sightings: what is one, what it is called, and how the layout is told."""

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
CHAIR, CUP, SINK = 58, 43, 73  # any labels will do


def seen(*things: tuple[int, float, tuple[float, float, float]]) -> DetectionPoints:
    labels, scores, places = zip(*things, strict=True)
    return DetectionPoints(
        np.array(labels, np.uint8), np.array(scores, np.float32), np.float32(places)
    )


def landmarks(*sightings: DetectionPoints) -> SubgraphLandmarks:
    return cluster_landmarks(sightings, [np.eye(4)] * len(sightings), CONFIG)


def test_a_box_is_where_its_foreground_is() -> None:
    """A block half a metre before a wall, about the optical axis."""
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
    depth_m = np.full((120, 160), 3.0, np.float32)
    depth_m[40:80, 60:100] = 2.0
    box = np.array([[55.0, 35, 104, 84]])
    found = locate_detections(np.array([CHAIR]), np.array([0.8]), box, depth_m, camera, CONFIG)
    np.testing.assert_allclose(found.p_camera, [[0, 0, 2]], atol=0.02)
    assert found.histogram()[CHAIR] == np.float32(0.8)
    assert found.histogram().sum() == np.float32(0.8)


def test_sightings_of_one_thing_are_one_landmark_in_the_mean() -> None:
    first, second = (
        seen((CHAIR, 0.8, (0, 0, 2)), (CUP, 0.5, (0, 0, 2))),
        seen((CHAIR, 0.6, (0.2, 0, 2)), (CHAIR, 0.9, (2, 0, 2))),
    )
    found = landmarks(first, second)
    np.testing.assert_allclose(found.p_odom, [[0.1, 0, 2], [0, 0, 2], [2, 0, 2]], atol=1e-6)
    p = found.distributions
    np.testing.assert_allclose(p[0, [CHAIR, 1]], [0.7, 0.3], atol=1e-6)
    np.testing.assert_allclose(p.sum(axis=1), 1)


def test_what_has_no_depth_is_no_landmark_and_still_counts() -> None:
    nowhere = seen((CHAIR, 0.8, (np.nan, np.nan, np.nan)))
    assert len(landmarks(nowhere)) == 0
    assert nowhere.histogram()[CHAIR] > 0


def test_only_landmarks_of_one_kind_may_be_one() -> None:
    old = landmarks(seen((CHAIR, 0.8, (0, 0, 2)), (CUP, 0.9, (1, 0, 2))))
    new = landmarks(seen((CUP, 0.8, (0, 0, 2)), (CHAIR, 0.6, (1, 0, 2)), (SINK, 1, (2, 0, 2))))
    assert possible_pairs(old, new, CONFIG).tolist() == [[0, 1], [1, 0]]


def test_a_pose_is_told_what_agrees_and_what_speaks_against_it() -> None:
    things = ((CHAIR, 0.8, (0, 0, 2)), (CUP, 0.9, (1, 0, 2)), (SINK, 0.7, (2, 0, 2)))
    old, T_old_new = landmarks(seen(*things)), se3.exp(np.array([0.1, 0.2, 0.3, 1, 2, 3]))
    p_new = se3.transform(se3.inverse(T_old_new), old.p_odom)
    # a cup for the sink
    new = SubgraphLandmarks(p_new, old.labels[[0, 1, 1]], old.weights[[0, 1, 1]])
    found = compare_landmarks_at(old, new, T_old_new, CONFIG)
    assert (found.count, found.contradicted) == (2, 1)
    assert found.divergence < 1e-6
    expected = -np.mean(
        [0.8 * np.log(0.8) + 0.2 * np.log(0.2), 0.9 * np.log(0.9) + 0.1 * np.log(0.1)]
    )
    assert abs(found.entropy - expected) < 1e-5


def test_the_layout_is_the_same_from_every_side_and_another_for_other_distances() -> None:
    rng = np.random.default_rng(0)
    here = SubgraphLandmarks(
        rng.uniform(-2, 2, (6, 3)),
        np.tile(np.uint8([CHAIR, 1, 0, 0, 0, 0, 0, 0]), (6, 1)),
        np.tile(np.float32([0.8, 0.2, 0, 0, 0, 0, 0, 0]), (6, 1)),
    )
    turned = SubgraphLandmarks(
        se3.transform(se3.exp(rng.normal(size=6)), here.p_odom), here.labels, here.weights
    )
    wide = SubgraphLandmarks(3 * here.p_odom, here.labels, here.weights)
    np.testing.assert_allclose(layout_histogram(turned), layout_histogram(here), atol=1e-4)
    assert abs(layout_histogram(here).sum() - 15) < 1e-4, "one for each pair"
    assert np.minimum(layout_histogram(wide), layout_histogram(here)).sum() < 8


def test_a_thing_that_was_hardly_made_out_is_the_same_thing() -> None:
    places = [(float(x), 0.0, 2.0) for x in range(5)]
    things = (CHAIR, CUP, CHAIR, SINK, CHAIR)
    sure, unsure = (
        landmarks(seen(*((thing, score, p) for thing, p in zip(things, places, strict=True))))
        for score in (0.9, 0.4)
    )
    assert unsure.names.tolist() == list(things)
    found = compare_landmarks_at(sure, unsure, np.eye(4), CONFIG)
    assert (found.count, found.contradicted) == (0, 0), "too vague to vouch, and no contradiction"
    np.testing.assert_array_equal(layout_histogram(sure), layout_histogram(unsure))
    others = landmarks(seen(*((SINK, 0.4, p) for p in places)))
    assert compare_landmarks_at(sure, others, np.eye(4), CONFIG).contradicted == 4
