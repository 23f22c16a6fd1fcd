from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.tracking import Alignment, TrackingStatus
from ldo_service.tracking.pose_candidates import PoseHypothesis
from ldo_service.tracking.tracking_quality import (
    ResidualHistory,
    TrackingQualityConfig,
    classify_tracking,
)

CONFIG, MEDIAN_DEPTH_M = TrackingQualityConfig(), 2.0
SOUND = Alignment(
    T_reference_camera=np.eye(4),
    information=np.eye(6),
    photometric_inliers=0.95,
    geometric_inliers=0.95,
    intensity_sigma=4.0,
    depth_noise_scale=1.0,
    overlap=0.9,
    paired=0.7,
    gain=1.0,
    bias=0.0,
    iterations=10,
    converged=True,
    condition=50.0,
)
HISTORY = ResidualHistory((3.0, 4.0, 5.0), (0.8, 1.0, 1.2))


def hypothesis(is_confirmed: bool | None = None, **changes: Any) -> PoseHypothesis:
    return PoseHypothesis(replace(SOUND, **changes), "direct", MEDIAN_DEPTH_M, is_confirmed)


def status_of(
    previous: TrackingStatus = TrackingStatus.OK, is_confirmed: bool | None = None, **changes: Any
) -> TrackingStatus:
    return classify_tracking(hypothesis(is_confirmed, **changes), HISTORY, previous, CONFIG)


def test_sound_alignment_is_ok_after_any_status() -> None:
    assert [status_of(previous) for previous in TrackingStatus] == [TrackingStatus.OK] * 3


@pytest.mark.parametrize(
    "deviation",
    [
        {"overlap": 0.12},
        {"paired": 0.0},
        {"condition": 1e6},
        {"condition": float("inf")},
        {"gain": 0.3, "intensity_sigma": 1.2},
        {"gain": 3.1},
        {"intensity_sigma": 11.0},
        {"depth_noise_scale": 3.0},
        {"is_confirmed": False},
    ],
)
def test_single_deviation_makes_a_frame_weak(deviation: dict) -> None:
    assert status_of(**deviation) is TrackingStatus.WEAK


def test_intensity_noise_is_relative_to_the_gain() -> None:
    assert status_of(gain=2.5, intensity_sigma=10.0 * 2.5) is status_of(intensity_sigma=10.0)
    past = HISTORY.extended(replace(SOUND, gain=2.0, intensity_sigma=8.0), CONFIG)
    assert past.intensity_sigmas[-1] == 4.0


def test_frame_with_zero_gain_is_lost() -> None:
    assert status_of(gain=0.0) is TrackingStatus.LOST


def test_fivefold_residual_is_lost_after_any_status() -> None:
    for previous in TrackingStatus:
        assert status_of(previous, intensity_sigma=20.4) is TrackingStatus.LOST
        assert status_of(previous, depth_noise_scale=5.1) is TrackingStatus.LOST


def test_view_without_overlap_is_lost() -> None:
    assert status_of(overlap=0.05) is TrackingStatus.LOST


def test_recovery_needs_smaller_residuals_than_staying_ok() -> None:
    border = {"intensity_sigma": 9.0}
    assert status_of(TrackingStatus.OK, **border) is TrackingStatus.OK
    assert status_of(TrackingStatus.WEAK, **border) is TrackingStatus.WEAK
    assert status_of(TrackingStatus.WEAK, intensity_sigma=7.0) is TrackingStatus.OK


def test_confirmation_by_features_recovers_weak_but_not_lost_frames() -> None:
    assert (
        status_of(TrackingStatus.WEAK, is_confirmed=True, intensity_sigma=9.0) is TrackingStatus.OK
    )
    assert (
        status_of(TrackingStatus.LOST, is_confirmed=True, intensity_sigma=9.0)
        is TrackingStatus.LOST
    )


def test_noisy_pose_is_ok_only_if_that_by_features_is_close() -> None:
    noisy = hypothesis(intensity_sigma=18.0)
    close = replace(noisy, feature_distance_rad=0.02)
    loose = replace(noisy, feature_distance_rad=0.05, is_confirmed=True)
    statuses = [
        [classify_tracking(one, HISTORY, previous, CONFIG) for one in (noisy, loose, close)]
        for previous in (TrackingStatus.OK, TrackingStatus.WEAK, TrackingStatus.LOST)
    ]
    ok, weak, lost = TrackingStatus.OK, TrackingStatus.WEAK, TrackingStatus.LOST
    assert statuses == [[weak, weak, ok], [weak, weak, ok], [lost, lost, lost]]
    wrong = replace(close, alignment=replace(SOUND, intensity_sigma=70.0))
    assert classify_tracking(wrong, HISTORY, ok, CONFIG) is lost


def test_noisy_confirmed_frames_do_not_hide_a_wrong_pose_after_them() -> None:
    history, noisy = ResidualHistory((4.0,) * 30, (1.0,) * 30), replace(SOUND, intensity_sigma=20.0)
    for _ in range(10):
        history = history.extended(noisy, CONFIG)
    assert max(history.intensity_sigmas) == 10.0  # 2.5 times the median.
    wrong = hypothesis(intensity_sigma=22.0)
    assert classify_tracking(wrong, history, TrackingStatus.OK, CONFIG) is TrackingStatus.LOST


def test_lost_camera_recovers_only_to_ok() -> None:
    assert status_of(TrackingStatus.LOST, overlap=0.3) is TrackingStatus.LOST
    assert status_of(TrackingStatus.LOST, overlap=0.4) is TrackingStatus.OK


def test_relocalization_confirmed_by_features_needs_less_overlap() -> None:
    assert status_of(TrackingStatus.LOST, is_confirmed=True, overlap=0.2) is TrackingStatus.OK
    assert status_of(TrackingStatus.LOST, is_confirmed=True, overlap=0.16) is TrackingStatus.LOST
    assert status_of(TrackingStatus.LOST, is_confirmed=False, overlap=0.4) is TrackingStatus.LOST


def test_relocalization_from_afar_may_have_larger_residuals() -> None:
    afar = np.eye(4)
    afar[0, 3] = 0.4 * MEDIAN_DEPTH_M  # 0.4 rad of parallax.
    noisy = {"intensity_sigma": 2.0 * 4.0}
    assert status_of(TrackingStatus.LOST, **noisy) is TrackingStatus.LOST
    assert status_of(TrackingStatus.LOST, T_reference_camera=afar, **noisy) is TrackingStatus.OK


def test_residuals_beyond_the_weak_limit_are_lost_at_any_distance() -> None:
    far = np.eye(4)
    far[0, 3] = 3.0 * MEDIAN_DEPTH_M
    noisy = {"intensity_sigma": 1.05 * CONFIG.weak_residual * 4.0}
    assert status_of(TrackingStatus.LOST, T_reference_camera=far, **noisy) is TrackingStatus.LOST


def test_residuals_below_usual_camera_noise_may_rise() -> None:
    perfect = ResidualHistory((1.0,) * 5, (0.2,) * 5)
    textured = hypothesis(intensity_sigma=4.5, depth_noise_scale=1.0)
    assert classify_tracking(textured, perfect, TrackingStatus.OK, CONFIG) is TrackingStatus.OK


def test_without_history_residuals_are_compared_with_usual_noise() -> None:
    def first(**changes: float) -> TrackingStatus:
        return classify_tracking(
            hypothesis(**changes), ResidualHistory(), TrackingStatus.OK, CONFIG
        )

    assert first() is TrackingStatus.OK
    assert first(intensity_sigma=41.0) is TrackingStatus.LOST
    assert first(depth_noise_scale=6.0) is TrackingStatus.WEAK


def test_history_keeps_the_newest_residuals() -> None:
    history = ResidualHistory()
    for k in range(100):
        history = history.extended(replace(SOUND, intensity_sigma=float(k)), CONFIG)
    assert history.intensity_sigmas == tuple(float(k) for k in range(70, 100))


def test_limits_in_the_wrong_order_are_rejected() -> None:
    with pytest.raises(ConfigError, match="residual"):
        TrackingQualityConfig(weak_residual=6.0)
    with pytest.raises(ConfigError, match="relocalized_residual"):
        TrackingQualityConfig(relocalized_residual=0.9)
