"""Relative poses of a new keyframe to several earlier ones."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.tracking import AlignConfig, PyramidConfig, pyramid_of
from ldo_service.tracking.alignment import BrightnessModel
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import KeyframeDatabaseConfig, make_keyframe_record
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.pyramid import build_pyramid
from ldo_service.tracking.window import RecentKeyframeCache, WindowConfig, measure_against

USUAL_NOISE = BrightnessModel(intensity_sigma=1.0, depth_noise_scale=0.3)


@pytest.fixture(scope="module")
def truth(make_walk) -> list[np.ndarray]:
    return make_walk(7, 0.05, 0.03)


@pytest.fixture(scope="module")
def keyframes(room, truth) -> list[ReferenceKeyframe]:
    rng = np.random.default_rng(3)  # Noise of the odometry poses.
    return [
        ReferenceKeyframe(
            pyramid_of(room.view(T), PyramidConfig()),
            T @ se3.exp(rng.normal(scale=3e-3, size=6)),
            k,
        )
        for k, T in enumerate(truth)
    ]


def test_measurements_are_closer_to_the_truth_than_odometry(keyframes, truth) -> None:
    *earlier, newest = keyframes
    poses = measure_against(reversed(earlier), newest, USUAL_NOISE, AlignConfig(), WindowConfig())
    assert [(p.a, p.b) for p in poses] == [(5, 6), (4, 6), (3, 6)]
    for pose in poses:
        true = se3.inverse(truth[pose.a]) @ truth[6]
        np.testing.assert_allclose(pose.T_a_b, true, atol=1e-3)
        assert np.linalg.eigvalsh(pose.information)[0] > 0


def test_keyframes_without_overlap_are_skipped(keyframes, room) -> None:
    turned = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    elsewhere = ReferenceKeyframe(pyramid_of(room.view(turned), PyramidConfig()), turned, 9)
    *earlier, newest = keyframes
    poses = measure_against(
        [elsewhere, *reversed(earlier)], newest, USUAL_NOISE, AlignConfig(), WindowConfig()
    )
    assert [p.a for p in poses] == [5, 4, 3]


def test_cached_keyframe_is_rebuilt_when_its_odometry_pose_changes(keyframes) -> None:
    records = [
        make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig())
        for keyframe in keyframes
    ]
    cache, shift = RecentKeyframeCache(PyramidConfig()), se3.exp(np.array([0, 0, 0, 0.5, 0, 0]))
    first = list(cache.newest_first(records, 3))
    assert [k.id for k in first] == [6, 5, 4]
    moved = replace(records[5], T_odom_keyframe=shift @ records[5].T_odom_keyframe)
    again = list(cache.newest_first([*records[:5], records[6], moved], 3))
    assert [k.id for k in again] == [5, 6, 4]
    assert again[1] is first[0]
    np.testing.assert_array_equal(again[0].T_odom_keyframe, moved.T_odom_keyframe)


def test_noisy_alignment_is_rejected(keyframes) -> None:
    """The same view with other light and speckles aligns, with far more noise than usual."""
    first, *_, newest = keyframes
    gray = np.random.default_rng(1).integers(0, 60, first.view.gray.shape) + first.view.gray // 2
    frame = replace_gray(first, gray.astype(np.uint8))
    assert not measure_against(
        [frame], newest, USUAL_NOISE, AlignConfig(), WindowConfig(min_overlap=0.1)
    )


def replace_gray(keyframe: ReferenceKeyframe, gray: np.ndarray) -> ReferenceKeyframe:
    view = keyframe.view
    noisy = build_pyramid(gray, view.depth_m, view.camera, PyramidConfig())
    return ReferenceKeyframe(noisy, keyframe.T_odom_keyframe, keyframe.id)


def test_window_of_zero_keyframes_measures_nothing(keyframes) -> None:
    *earlier, newest = keyframes
    disabled = WindowConfig(measurements=0)
    assert measure_against(reversed(earlier), newest, USUAL_NOISE, AlignConfig(), disabled) == []


@pytest.mark.parametrize(
    "wrong", [{"measurements": -1}, {"min_overlap": 0.0}, {"max_noise": 0.5}, {"iterations": ()}]
)
def test_impossible_settings_are_rejected(wrong) -> None:
    with pytest.raises(ConfigError):
        replace(WindowConfig(), **wrong)
