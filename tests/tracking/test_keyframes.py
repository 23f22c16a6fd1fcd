import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.tracking import PyramidConfig, pyramid_of
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframes import KeyframeConfig, ReferenceKeyframe, needs_keyframe

CONFIG = KeyframeConfig(min_frames=2)
TURNED = se3.exp(np.array([0, np.radians(16), 0, 0, 0, 0]))
MOVED = se3.exp(np.array([0, 0, 0, 0.2, 0, 0]))
SLIGHTLY_MOVED = se3.exp(np.array([0.0, 0.0, 0.0, 0.03, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("T", "overlap", "median_depth_m", "frames", "expected"),
    [
        (np.eye(4), 1.0, 2.0, 5, False),
        (np.eye(4), 0.84, 2.0, 5, True),
        (TURNED, 1.0, 2.0, 5, True),
        (MOVED, 1.0, 2.0, 5, True),
        (MOVED, 1.0, 3.0, 5, False),  # The same distance changes less in a larger room.
        (TURNED, 0.2, 2.0, 1, False),  # The limit is every second frame.
        (SLIGHTLY_MOVED, 1.0, 2.0, 30, True),  # Every 30th frame is a keyframe.
        (SLIGHTLY_MOVED, 1.0, 2.0, 29, False),
        (np.eye(4), 1.0, 2.0, 3000, False),  # A camera at rest adds no keyframes.
        (np.eye(4), 0.9, 2.0, 30, True),  # A changed view needs a keyframe also at rest.
    ],
)
def test_keyframe_is_needed_when_the_view_has_changed(
    T: np.ndarray, overlap: float, median_depth_m: float, frames: int, expected: bool
) -> None:
    assert needs_keyframe(T, overlap, median_depth_m, frames, CONFIG) is expected


def test_each_frame_may_become_a_keyframe_by_default() -> None:
    assert needs_keyframe(TURNED, 0.2, 2.0, 1, KeyframeConfig())


def test_features_are_detected_once(room) -> None:
    keyframe = ReferenceKeyframe(pyramid_of(room.view(np.eye(4)), PyramidConfig()), np.eye(4), 0)
    assert keyframe.features(FeatureConfig()) is keyframe.features(FeatureConfig())
    assert keyframe.reference is keyframe.reference


def test_limits_in_the_wrong_order_are_rejected() -> None:
    with pytest.raises(ConfigError, match="min_frames"):
        KeyframeConfig(min_frames=31)
    with pytest.raises(ConfigError, match="max_translation=0"):
        KeyframeConfig(max_translation=0)
