import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking.submaps import SubmapConfig, SubmapMatch, Submaps
from tests.tracking.scenes import yaw

CONFIG = SubmapConfig(begin_after_frames=6, search_interval_frames=4, confirm_after=2)
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
    for _ in range(frames):
        submaps = submaps.after_tracked()
    return submaps


def thumbnail(number: int) -> np.ndarray:
    """Return a thumbnail that resembles only those of the same number."""
    return np.random.default_rng(number).integers(-99, 99, 300).astype(np.int8)


def submap_starts(frames: str, config: SubmapConfig = CONFIG) -> list[bool]:
    """Return whether a submap may start with each frame.

    Args:
        frames: A character per frame: "t" is tracked, "c" is LOST and covered. A digit is LOST and
            was searched in vain; equal digits show the same view.
        config: Settings.
    """
    submaps, may_start = started_submaps(1), []
    for frame in frames:
        if frame == "t":
            submaps = submaps.after_tracked()
        else:
            submaps = submaps.after_lost(None if frame == "c" else thumbnail(int(frame)), config)
        may_start.append(submaps.should_start(config))
    return may_start


def test_submap_starts_after_a_number_of_lost_frames() -> None:
    assert submap_starts("t1111111") == [False] * 6 + [True] * 2
    lost = SubmapConfig().begin_after_frames
    assert submap_starts("1" * lost, SubmapConfig()) == [False] * (lost - 1) + [True]


def test_a_third_of_the_frames_is_enough_if_they_show_different_views() -> None:
    assert submap_starts("t12") == [False, False, True]
    lost = SubmapConfig().begin_after_frames // 3
    views = "0123456789" * lost
    assert submap_starts(views[:lost], SubmapConfig()) == [False] * (lost - 1) + [True]


def test_tracked_frame_resets_the_number_of_lost_frames() -> None:
    assert submap_starts("11111t111111") == [False] * 11 + [True]
    assert submap_starts("1t12") == [False] * 3 + [True]


def test_frames_of_a_covered_camera_do_not_count() -> None:
    assert submap_starts("1ccccccc1c2") == [False] * 10 + [True]


def test_frames_without_contrast_show_the_same_view() -> None:
    submaps = started_submaps(1)
    for _ in range(3):
        submaps = submaps.after_lost(np.zeros(300, np.int8), CONFIG)
    assert (submaps.lost_frames, submaps.lost_views) == (3, 1)


def test_no_submap_starts_when_disabled() -> None:
    assert not any(submap_starts("0123456789" * 99, SubmapConfig(begin_after_frames=0)))


def test_state_of_an_earlier_version_counts_from_zero() -> None:
    saved = started_submaps(1).pack()
    del saved["lost_frames"], saved["lost_views"], saved["lost_thumbnail"]
    restored = Submaps.unpack({**saved, "lost_since_ns": 10**18})
    assert (restored.lost_frames, restored.lost_views, restored.roots) == (0, 0, (0,))


def test_number_of_lost_frames_survives_packing() -> None:
    lost = started_submaps(1).after_lost(thumbnail(1), CONFIG)
    restored = Submaps.unpack(decode_state(encode_state(lost.pack())))
    assert restored.after_lost(thumbnail(1), CONFIG).lost_views == 1
    assert restored.after_lost(thumbnail(2), CONFIG).should_start(CONFIG)


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
        {"begin_after_frames": -1},
        {"max_view_correlation": 2.0},
        {"search_interval_frames": 0},
        {"confirm_after": 0},
        {"confirm_rad": 0.0},
    ],
)
def test_impossible_settings_are_rejected(fields) -> None:
    with pytest.raises(ConfigError):
        SubmapConfig(**fields)
