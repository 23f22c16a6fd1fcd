import numpy as np

from ldo_service.geometry import se3
from ldo_service.tracking import AlignConfig, PyramidConfig, pyramid_of
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.judgement import History, JudgementConfig
from ldo_service.tracking.keyframes import Keyframe
from ldo_service.tracking.relocalisation import RelocalisationConfig, relocalise

T_AWAY = se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
T_NEAR = se3.exp(np.array([0.03, -0.15, 0.05, 0.15, 0.05, 0.1]))


def found(large_room, frame):
    keyframes = [
        Keyframe(pyramid_of(large_room.view(T), PyramidConfig()), T, index)
        for index, T in enumerate((np.eye(4), T_AWAY))
    ]
    return relocalise(
        keyframes,
        pyramid_of(frame, PyramidConfig()),
        History(),
        JudgementConfig(),
        FeatureConfig(),
        AlignConfig(),
        RelocalisationConfig(),
    )


def test_right_keyframe_is_found_whatever_its_age(large_room) -> None:
    for index, T_odom_keyframe in enumerate((np.eye(4), T_AWAY)):
        place = found(large_room, large_room.view(T_odom_keyframe @ T_NEAR))
        assert place is not None
        keyframe, candidate = place
        assert keyframe.id == index
        np.testing.assert_allclose(candidate.alignment.T_reference_camera, T_NEAR, atol=1e-3)


def test_unknown_place_is_not_recognised(large_room) -> None:
    elsewhere = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert found(large_room, large_room.view(elsewhere)) is None
    assert found(large_room, large_room.blank()) is None
