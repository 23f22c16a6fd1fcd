import numpy as np

from ldo_service.geometry import se3
from ldo_service.tracking import AlignConfig, PyramidConfig, pyramid_of
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.pose_candidates import (
    PoseHypothesisConfig,
    align_hypothesis,
    select_hypothesis,
)

T_KEYFRAME_CAMERA = se3.exp(np.array([0.0, 0.1, 0.0, 0.1, 0.0, 0.1]))
T_ASTRAY = se3.exp(np.array([0.0, -0.4, 0.1, -0.6, 0.1, 0.0]))


def chosen_from(room, guesses, second=None):
    keyframe = ReferenceKeyframe(pyramid_of(room.view(np.eye(4)), PyramidConfig()), np.eye(4), 0)
    view = pyramid_of(room.view(T_KEYFRAME_CAMERA), PyramidConfig())
    align = AlignConfig()
    attempts = [
        align_hypothesis(keyframe, view, T, f"guess {k}", align) for k, T in enumerate(guesses)
    ]
    return attempts, select_hypothesis(
        attempts, second, keyframe, view, PoseHypothesisConfig(), align
    )


def test_true_pose_wins_over_a_wrong_minimum_that_calls_itself_inliers(room) -> None:
    (wrong, _), winner = chosen_from(room, [T_ASTRAY, T_KEYFRAME_CAMERA])
    assert wrong.alignment.photometric_inliers > 0.85  # by its own inflated noise
    off = se3.inverse(wrong.alignment.T_reference_camera) @ T_KEYFRAME_CAMERA
    assert np.linalg.norm(off[:3, 3]) > 0.1
    assert winner.pose_source == "guess 1"
    assert winner.is_confirmed is None


def test_first_of_equals_wins(room) -> None:
    _, winner = chosen_from(room, [T_KEYFRAME_CAMERA, T_KEYFRAME_CAMERA])
    assert winner.pose_source == "guess 0"


def test_features_at_the_same_pose_agree(room) -> None:
    _, winner = chosen_from(room, [np.eye(4), T_KEYFRAME_CAMERA], T_KEYFRAME_CAMERA)
    assert winner.is_confirmed is True


def test_two_starts_that_met_agree_even_where_the_raw_feature_pose_was_rough(room) -> None:
    rough = T_KEYFRAME_CAMERA @ se3.exp(np.array([0.0, 0.05, 0.0, 0.1, 0.0, 0.0]))
    for guesses in ([T_KEYFRAME_CAMERA, rough], [rough, T_KEYFRAME_CAMERA]):
        _, winner = chosen_from(room, guesses, rough)
        assert winner.is_confirmed is True


def test_features_that_the_images_refute_have_no_say(room) -> None:
    _, winner = chosen_from(room, [T_KEYFRAME_CAMERA, T_ASTRAY], T_ASTRAY)
    assert winner.pose_source == "guess 0"
    assert winner.is_confirmed is None
