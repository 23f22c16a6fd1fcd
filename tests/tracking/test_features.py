from dataclasses import replace

import cv2
import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.tracking import (
    Odometry,
    OdometryConfig,
    PyramidConfig,
    TrackingStatus,
    features,
    pyramid_of,
)
from ldo_service.tracking.features import (
    FeatureConfig,
    detect,
    detect_sift,
    estimate_pose,
    match,
)
from ldo_service.tracking.pyramid import Pyramid

CONFIG = FeatureConfig()
T_REFERENCE_CAMERA = se3.exp(np.array([0.05, -0.2, 0.05, 0.2, 0.1, 0.15]))  # 12 degrees and 27 cm.


def test_feature_pose_of_a_large_motion_is_within_reach_of_alignment(large_room) -> None:
    reference, frame = (
        detect(pyramid_of(large_room.view(T), PyramidConfig()), CONFIG)
        for T in (np.eye(4), T_REFERENCE_CAMERA)
    )
    poses = [estimate_pose(reference, frame, large_room.camera, CONFIG) for _ in range(2)]
    assert poses[0] is not None
    assert poses[1] is not None
    assert poses[0].inliers >= CONFIG.min_inliers
    difference = T_REFERENCE_CAMERA @ poses[0].T_camera_reference
    assert np.linalg.norm(difference[:3, 3]) < 0.1
    assert se3.rotation_angle(difference) < np.radians(2)
    np.testing.assert_array_equal(poses[0].T_camera_reference, poses[1].T_camera_reference)


def test_feature_points_project_to_their_pixels(large_room) -> None:
    view = pyramid_of(large_room.view(np.eye(4)), PyramidConfig())
    features = detect(view, CONFIG)
    assert len(features.pixels) > 100
    np.testing.assert_allclose(
        large_room.camera.project(features.points_camera), features.pixels, atol=1e-6
    )


def test_features_are_detected_once_per_image_and_settings(large_room) -> None:
    view = pyramid_of(large_room.view(np.eye(4)), PyramidConfig())
    same = pyramid_of(large_room.view(np.eye(4)), PyramidConfig())
    features, fewer = detect(view, CONFIG), detect(view, replace(CONFIG, count=50))
    assert detect(view, FeatureConfig()) is features
    assert len(fewer.pixels) <= 50 < len(features.pixels)
    assert detect(same, CONFIG) is not features
    np.testing.assert_array_equal(detect(same, CONFIG).descriptors, features.descriptors)


def test_tracker_detects_the_features_of_an_image_once_also_when_it_becomes_the_reference(
    large_room, monkeypatch: pytest.MonkeyPatch
) -> None:
    detected: list[tuple[int, FeatureConfig]] = []
    original, views = features._detected, []

    def count(view: Pyramid, config: FeatureConfig) -> features.Features:
        views.append(view)  # Keeps the view, so that its id stays unique.
        detected.append((id(view), config))
        return original(view, config)

    monkeypatch.setattr(features, "_detected", count)
    odometry = Odometry(OdometryConfig(features=CONFIG))
    steps = [np.array([0.0, 0.25 * (k // 2), 0.0, 0.0, 0.0, 0.0]) for k in range(8)]
    results = [
        odometry.process(large_room.view(se3.exp(step), index=k)) for k, step in enumerate(steps)
    ]
    assert {result.status for result in results} == {TrackingStatus.OK}
    assert len(set(detected)) == len(detected)
    assert sum(config == CONFIG for _, config in detected) > 3
    assert len({image for image, config in detected if config == CONFIG}) < len(steps)


def test_sift_matches_agree_with_opencv(large_room) -> None:
    reference, frame = (
        detect_sift(view.gray, view.depth_m, view.camera, 300, CONFIG)
        for view in (
            pyramid_of(large_room.view(T), PyramidConfig()) for T in (np.eye(4), T_REFERENCE_CAMERA)
        )
    )
    pairs = match(reference, frame, CONFIG)
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(reference.descriptors, frame.descriptors, k=2)
    expected = {
        (m.queryIdx, m.trainIdx) for m, n in nearest if m.distance < CONFIG.ratio * n.distance
    }
    assert len(pairs) > 100
    assert set(map(tuple, pairs.tolist())) <= expected
    assert len(set(pairs[:, 1])) == len({index for _, index in expected})


def test_every_feature_is_matched_at_most_once(large_room) -> None:
    reference, frame = (
        detect(pyramid_of(large_room.view(T), PyramidConfig()), CONFIG)
        for T in (np.eye(4), T_REFERENCE_CAMERA)
    )
    pairs = match(reference, frame, CONFIG)
    assert len(pairs) > CONFIG.min_inliers
    for side in pairs.T:
        assert len(np.unique(side)) == len(side)


def test_blank_image_has_no_features_and_no_pose(large_room) -> None:
    blank = detect(pyramid_of(large_room.blank(), PyramidConfig()), CONFIG)
    textured = detect(pyramid_of(large_room.view(np.eye(4)), PyramidConfig()), CONFIG)
    assert len(blank.pixels) == 0
    assert estimate_pose(textured, blank, large_room.camera, CONFIG) is None
    assert estimate_pose(blank, textured, large_room.camera, CONFIG) is None


def test_ratio_above_one_is_rejected() -> None:
    with pytest.raises(ConfigError, match="ratio"):
        FeatureConfig(ratio=1.5)
