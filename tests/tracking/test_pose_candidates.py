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
T_WRONG = se3.exp(np.array([0.0, -0.4, 0.1, -0.6, 0.1, 0.0]))


def align_and_select(room, guesses, second=None):
    keyframe = ReferenceKeyframe(pyramid_of(room.view(np.eye(4)), PyramidConfig()), np.eye(4), 0)
    view = pyramid_of(room.view(T_KEYFRAME_CAMERA), PyramidConfig())
    align = AlignConfig()
    attempts = [
        align_hypothesis(keyframe, view, T, f"guess {k}", align) for k, T in enumerate(guesses)
    ]
    return attempts, select_hypothesis(
        attempts, second, keyframe, view, PoseHypothesisConfig(), align
    )


def test_true_pose_wins_over_a_wrong_minimum_with_many_inliers(room) -> None:
    (wrong, _), winner = align_and_select(room, [T_WRONG, T_KEYFRAME_CAMERA])
    assert wrong.alignment.photometric_inliers > 0.85  # Relative to its own inflated noise.
    T_error = se3.inverse(wrong.alignment.T_reference_camera) @ T_KEYFRAME_CAMERA
    assert np.linalg.norm(T_error[:3, 3]) > 0.1
    assert winner.pose_source == "guess 1"
    assert winner.is_confirmed is None


def test_first_of_equal_hypotheses_wins(room) -> None:
    _, winner = align_and_select(room, [T_KEYFRAME_CAMERA, T_KEYFRAME_CAMERA])
    assert winner.pose_source == "guess 0"


def test_feature_pose_at_the_same_minimum_confirms(room) -> None:
    _, winner = align_and_select(room, [np.eye(4), T_KEYFRAME_CAMERA], T_KEYFRAME_CAMERA)
    assert winner.is_confirmed is True


def test_converged_starts_confirm_despite_a_rough_feature_pose(room) -> None:
    rough = T_KEYFRAME_CAMERA @ se3.exp(np.array([0.0, 0.05, 0.0, 0.1, 0.0, 0.0]))
    for guesses in ([T_KEYFRAME_CAMERA, rough], [rough, T_KEYFRAME_CAMERA]):
        _, winner = align_and_select(room, guesses, rough)
        assert winner.is_confirmed is True


def test_feature_pose_that_the_images_contradict_is_ignored(room) -> None:
    _, winner = align_and_select(room, [T_KEYFRAME_CAMERA, T_WRONG], T_WRONG)
    assert winner.pose_source == "guess 0"
    assert winner.is_confirmed is None
