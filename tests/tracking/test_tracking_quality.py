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
PAST = ResidualHistory((3.0, 4.0, 5.0), (0.8, 1.0, 1.2))


def candidate(agree: bool | None = None, **changes: Any) -> PoseHypothesis:
    return PoseHypothesis(replace(SOUND, **changes), "direct", MEDIAN_DEPTH_M, agree)


def verdict(
    previous: TrackingStatus = TrackingStatus.OK, agree: bool | None = None, **changes: Any
) -> TrackingStatus:
    return classify_tracking(candidate(agree, **changes), PAST, previous, CONFIG)


def test_sound_alignment_is_ok_whatever_came_before() -> None:
    assert [verdict(previous) for previous in TrackingStatus] == [TrackingStatus.OK] * 3


@pytest.mark.parametrize(
    "sign",
    [
        {"overlap": 0.12},
        {"paired": 0.0},
        {"condition": 1e6},
        {"condition": float("inf")},
        {"gain": 0.3, "intensity_sigma": 1.2},
        {"gain": 3.1},
        {"intensity_sigma": 11.0},
        {"depth_noise_scale": 3.0},
        {"agree": False},
    ],
)
def test_every_single_sign_makes_a_frame_weak(sign: dict) -> None:
    assert verdict(**sign) is TrackingStatus.WEAK


def test_noise_that_grows_with_the_exposure_is_no_sign() -> None:
    assert verdict(gain=2.5, intensity_sigma=10.0 * 2.5) is verdict(intensity_sigma=10.0)
    past = PAST.extended(replace(SOUND, gain=2.0, intensity_sigma=8.0), CONFIG)
    assert past.intensity_sigmas[-1] == 4.0


def test_a_frame_that_tells_no_brightness_is_never_accepted() -> None:
    assert verdict(gain=0.0) is TrackingStatus.LOST


def test_residual_that_jumps_fivefold_is_never_accepted() -> None:
    for previous in TrackingStatus:
        assert verdict(previous, intensity_sigma=20.4) is TrackingStatus.LOST
        assert verdict(previous, depth_noise_scale=5.1) is TrackingStatus.LOST


def test_view_without_overlap_is_lost() -> None:
    assert verdict(overlap=0.05) is TrackingStatus.LOST


def test_recovery_takes_more_than_staying() -> None:
    border = {"intensity_sigma": 9.0}
    assert verdict(TrackingStatus.OK, **border) is TrackingStatus.OK
    assert verdict(TrackingStatus.WEAK, **border) is TrackingStatus.WEAK
    assert verdict(TrackingStatus.WEAK, intensity_sigma=7.0) is TrackingStatus.OK


def test_features_vouch_for_a_weak_frame_but_not_for_a_lost_one() -> None:
    assert verdict(TrackingStatus.WEAK, agree=True, intensity_sigma=9.0) is TrackingStatus.OK
    assert verdict(TrackingStatus.LOST, agree=True, intensity_sigma=9.0) is TrackingStatus.LOST


def test_only_ok_leads_back_from_a_loss() -> None:
    assert verdict(TrackingStatus.LOST, overlap=0.3) is TrackingStatus.LOST
    assert verdict(TrackingStatus.LOST, overlap=0.4) is TrackingStatus.OK


def test_a_find_that_features_agree_with_may_show_less() -> None:
    assert verdict(TrackingStatus.LOST, agree=True, overlap=0.2) is TrackingStatus.OK
    assert verdict(TrackingStatus.LOST, agree=True, overlap=0.16) is TrackingStatus.LOST
    assert verdict(TrackingStatus.LOST, agree=False, overlap=0.4) is TrackingStatus.LOST


def test_a_place_found_from_afar_may_fit_worse_than_one_found_where_it_was_seen() -> None:
    afar = np.eye(4)
    afar[0, 3] = 0.4 * MEDIAN_DEPTH_M  # 0.4 rad of parallax
    noisy = {"intensity_sigma": 2.0 * 4.0}
    assert verdict(TrackingStatus.LOST, **noisy) is TrackingStatus.LOST
    assert verdict(TrackingStatus.LOST, T_reference_camera=afar, **noisy) is TrackingStatus.OK


def test_no_distance_excuses_more_noise_than_tracking_bears() -> None:
    far = np.eye(4)
    far[0, 3] = 3.0 * MEDIAN_DEPTH_M
    noisy = {"intensity_sigma": 1.05 * CONFIG.weak_residual * 4.0}
    assert verdict(TrackingStatus.LOST, T_reference_camera=far, **noisy) is TrackingStatus.LOST


def test_noise_below_that_of_any_camera_may_rise_unpunished() -> None:
    perfect = ResidualHistory((1.0,) * 5, (0.2,) * 5)
    textured = candidate(intensity_sigma=4.5, depth_noise_scale=1.0)
    assert classify_tracking(textured, perfect, TrackingStatus.OK, CONFIG) is TrackingStatus.OK


def test_without_a_past_noise_is_compared_with_a_usual_cameras() -> None:
    def first(**changes: float) -> TrackingStatus:
        return classify_tracking(candidate(**changes), ResidualHistory(), TrackingStatus.OK, CONFIG)

    assert first() is TrackingStatus.OK
    assert first(intensity_sigma=41.0) is TrackingStatus.LOST
    assert first(depth_noise_scale=6.0) is TrackingStatus.WEAK


def test_history_forgets_beyond_its_length() -> None:
    history = ResidualHistory()
    for k in range(100):
        history = history.extended(replace(SOUND, intensity_sigma=float(k)), CONFIG)
    assert history.intensity_sigmas == tuple(float(k) for k in range(70, 100))


def test_limits_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(ConfigError, match="residual"):
        TrackingQualityConfig(weak_residual=6.0)
    with pytest.raises(ConfigError, match="relocalised_residual"):
        TrackingQualityConfig(relocalised_residual=0.9)
