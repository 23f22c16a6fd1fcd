import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.tracking.submaps import SubmapConfig, SubmapMatch, Submaps
from tests.tracking.scenes import yaw

PERIOD_NS = 33_333_333
CONFIG = SubmapConfig(begin_after_s=0.1, search_interval_frames=4, confirm_after=2)
T_THERE_HERE = se3.exp(np.array([0.0, 0.4, 0.0, 1.0, 0.0, 2.0]))


def match(
    T_there_here: np.ndarray = T_THERE_HERE, here: int = 2, there: int = 0, angle_rad: float = 0.0
) -> SubmapMatch:
    return SubmapMatch(here, there, T_there_here, yaw(angle_rad), median_depth_m=2.0)


def started_submaps(count: int) -> Submaps:
    submaps = Submaps()
    for _ in range(count):
        submaps = submaps.started()
    return submaps


def after_frames(submaps: Submaps, frames: int) -> Submaps:
    for k in range(frames):
        submaps = submaps.after(is_lost=False, stamp_ns=k * PERIOD_NS)
    return submaps


def submap_starts(is_lost: list[bool], stamps_ns: list[int], config: SubmapConfig) -> list[bool]:
    """Return whether a submap may start with each frame."""
    submaps, may_start = started_submaps(1), []
    for lost, stamp_ns in zip(is_lost, stamps_ns, strict=True):
        submaps = submaps.after(lost, stamp_ns)
        may_start.append(submaps.should_start(stamp_ns, config))
    return may_start


@pytest.mark.parametrize("rate_hz", [5, 30, 200])
def test_submap_starts_after_three_seconds_lost_at_any_frame_rate(rate_hz: int) -> None:
    stamps_ns = [round(1e9 * k / rate_hz) for k in range(4 * rate_hz)]
    expected = [stamp_ns >= 3_000_000_000 for stamp_ns in stamps_ns]
    assert submap_starts([True] * len(stamps_ns), stamps_ns, SubmapConfig()) == expected


def test_tracked_frame_resets_the_time_until_a_submap_starts() -> None:
    is_lost = [True, True, False, True, True, True, True]
    stamps_ns = [k * 50_000_000 for k in range(7)]
    assert submap_starts(is_lost, stamps_ns, CONFIG) == [False] * 5 + [True] * 2


def test_no_submap_starts_when_disabled() -> None:
    stamps_ns = [k * 10**9 for k in range(99)]
    assert not any(submap_starts([True] * 99, stamps_ns, SubmapConfig(begin_after_s=0)))


def test_lost_time_restarts_with_the_clock_of_the_camera() -> None:
    stamps_ns = [10**18, 10**18 + 50_000_000, 0, 50_000_000, 100_000_000]
    assert submap_starts([True] * 5, stamps_ns, CONFIG) == [False] * 4 + [True]


def test_search_is_due_only_while_a_submap_is_not_merged() -> None:
    assert not after_frames(started_submaps(1), 99).is_search_due(CONFIG)
    assert after_frames(started_submaps(2), 4).is_search_due(CONFIG)
    assert not after_frames(started_submaps(2).with_merge(1, 0), 99).is_search_due(CONFIG)


def test_search_is_due_earlier_while_a_match_is_pending() -> None:
    pending = started_submaps(2).with_search_result(match(), CONFIG)
    assert after_frames(pending, 2).is_search_due(CONFIG)
    assert not after_frames(started_submaps(2).with_search_result(None, CONFIG), 2).is_search_due(
        CONFIG
    )


def test_equal_matches_from_different_views_confirm_each_other() -> None:
    T_near = T_THERE_HERE @ se3.exp(np.full(6, 0.01))
    pending = started_submaps(3).with_search_result(match(), CONFIG)
    assert pending.is_confirmed_by(match(T_near, angle_rad=1.2), CONFIG)
    assert not pending.is_confirmed_by(match(T_near, angle_rad=0.5), CONFIG), "the same view"
    assert not pending.is_confirmed_by(match(T_THERE_HERE @ T_near, angle_rad=1.2), CONFIG)
    assert not pending.is_confirmed_by(match(there=1, angle_rad=1.2), CONFIG)
    assert not started_submaps(3).is_confirmed_by(match(angle_rad=1.2), CONFIG)


def test_oldest_match_without_contradiction_is_kept_for_confirmation() -> None:
    pending = (
        started_submaps(3)
        .with_search_result(match(), CONFIG)
        .with_search_result(match(angle_rad=0.6), CONFIG)
    )
    assert pending.is_confirmed_by(match(angle_rad=1.2), CONFIG)
    contradicted = pending.with_search_result(
        match(T_THERE_HERE @ T_THERE_HERE, angle_rad=0.6), CONFIG
    )
    assert not contradicted.is_confirmed_by(match(angle_rad=1.2), CONFIG)


def test_pending_match_is_dropped_after_searches_without_a_match() -> None:
    pending = started_submaps(2).with_search_result(match(), CONFIG)
    for _ in range(CONFIG.misses):
        pending = pending.with_search_result(None, CONFIG)
    assert pending.pending_match is not None
    assert pending.with_search_result(None, CONFIG).pending_match is None


def test_merged_submaps_share_the_oldest_as_their_root() -> None:
    submaps = started_submaps(4).with_merge(3, 2).with_merge(2, 1)
    assert submaps.roots == (0, 1, 1, 1)
    assert submaps.are_merged(3, 1)
    assert not submaps.are_merged(3, 0)


@pytest.mark.parametrize(
    "submaps",
    [
        Submaps(),
        started_submaps(3).with_search_result(match(), CONFIG),
        started_submaps(2).with_merge(0, 1),
    ],
)
def test_submaps_survive_packing(submaps: Submaps) -> None:
    restored = Submaps.unpack(submaps.pack())
    assert restored.roots == submaps.roots
    assert (restored.pending_match is None) == (submaps.pending_match is None)
    if restored.pending_match is not None:
        np.testing.assert_array_equal(restored.pending_match.T_there_here, T_THERE_HERE)


@pytest.mark.parametrize(
    "fields",
    [
        {"begin_after_s": -1.0},
        {"begin_after_s": float("nan")},
        {"search_interval_frames": 0},
        {"confirm_after": 0},
        {"confirm_rad": 0.0},
    ],
)
def test_impossible_settings_are_rejected(fields) -> None:
    with pytest.raises(ConfigError):
        SubmapConfig(**fields)
