import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.tracking.submaps import SubmapConfig, SubmapMatch, Submaps

PERIOD_NS = 33_333_333
CONFIG = SubmapConfig(begin_after_s=0.1, look_every=4, confirm_after=2)
T_THERE_HERE = se3.exp(np.array([0.0, 0.4, 0.0, 1.0, 0.0, 2.0]))


def turned(angle_rad: float) -> np.ndarray:
    return se3.exp(np.array([0.0, angle_rad, 0.0, 0.0, 0.0, 0.0]))


def look(
    T_there_here: np.ndarray = T_THERE_HERE, here: int = 2, there: int = 0, angle_rad: float = 0.0
) -> SubmapMatch:
    return SubmapMatch(here, there, T_there_here, turned(angle_rad), median_depth_m=2.0)


def begun(count: int) -> Submaps:
    submaps = Submaps()
    for _ in range(count):
        submaps = submaps.started()
    return submaps


def after(submaps: Submaps, frames: int) -> Submaps:
    for k in range(frames):
        submaps = submaps.after(is_lost=False, stamp_ns=k * PERIOD_NS)
    return submaps


def begins(is_lost: list[bool], stamps_ns: list[int], config: SubmapConfig) -> list[bool]:
    """Whether a submap may begin with each frame."""
    submaps, may_begin = begun(1), []
    for lost, stamp_ns in zip(is_lost, stamps_ns, strict=True):
        submaps = submaps.after(lost, stamp_ns)
        may_begin.append(submaps.should_start(stamp_ns, config))
    return may_begin


@pytest.mark.parametrize("rate_hz", [5, 30, 200])
def test_a_submap_begins_after_so_many_seconds_lost_at_any_rate(rate_hz: int) -> None:
    stamps_ns = [round(1e9 * k / rate_hz) for k in range(4 * rate_hz)]
    expected = [stamp_ns >= 3_000_000_000 for stamp_ns in stamps_ns]
    assert begins([True] * len(stamps_ns), stamps_ns, SubmapConfig()) == expected


def test_a_frame_that_is_not_lost_ends_the_patience_and_renews_it() -> None:
    is_lost = [True, True, False, True, True, True, True]
    stamps_ns = [k * 50_000_000 for k in range(7)]
    assert begins(is_lost, stamps_ns, CONFIG) == [False] * 5 + [True] * 2


def test_no_submap_begins_where_none_is_wanted() -> None:
    stamps_ns = [k * 10**9 for k in range(99)]
    assert not any(begins([True] * 99, stamps_ns, SubmapConfig(begin_after_s=0)))


def test_a_camera_that_starts_again_while_lost_is_waited_for_by_its_new_clock() -> None:
    stamps_ns = [10**18, 10**18 + 50_000_000, 0, 50_000_000, 100_000_000]
    assert begins([True] * 5, stamps_ns, CONFIG) == [False] * 4 + [True]


def test_nobody_looks_for_other_submaps_where_there_is_none_apart() -> None:
    assert not after(begun(1), 99).is_search_due(CONFIG)
    assert after(begun(2), 4).is_search_due(CONFIG)
    assert not after(begun(2).with_merge(1, 0), 99).is_search_due(CONFIG)


def test_a_find_is_looked_at_again_sooner() -> None:
    found = begun(2).with_search_result(look(), CONFIG)
    assert after(found, 2).is_search_due(CONFIG)
    assert not after(begun(2).with_search_result(None, CONFIG), 2).is_search_due(CONFIG)


def test_two_finds_confirm_each_other_when_they_say_the_same_of_different_views() -> None:
    near = T_THERE_HERE @ se3.exp(np.full(6, 0.01))
    found = begun(3).with_search_result(look(), CONFIG)
    assert found.is_confirmed_by(look(near, angle_rad=1.2), CONFIG)
    assert not found.is_confirmed_by(look(near, angle_rad=0.5), CONFIG), "the same view"
    assert not found.is_confirmed_by(look(T_THERE_HERE @ near, angle_rad=1.2), CONFIG)
    assert not found.is_confirmed_by(look(there=1, angle_rad=1.2), CONFIG)
    assert not begun(3).is_confirmed_by(look(angle_rad=1.2), CONFIG)


def test_the_oldest_find_that_nothing_contradicts_is_the_one_to_be_confirmed() -> None:
    found = (
        begun(3).with_search_result(look(), CONFIG).with_search_result(look(angle_rad=0.6), CONFIG)
    )
    assert found.is_confirmed_by(look(angle_rad=1.2), CONFIG)
    other = found.with_search_result(look(T_THERE_HERE @ T_THERE_HERE, angle_rad=0.6), CONFIG)
    assert not other.is_confirmed_by(look(angle_rad=1.2), CONFIG)


def test_a_find_is_forgotten_after_looks_that_find_nothing() -> None:
    found = begun(2).with_search_result(look(), CONFIG)
    for _ in range(CONFIG.misses):
        found = found.with_search_result(None, CONFIG)
    assert found.pending_match is not None
    assert found.with_search_result(None, CONFIG).pending_match is None


def test_joined_submaps_share_the_oldest_as_their_root() -> None:
    submaps = begun(4).with_merge(3, 2).with_merge(2, 1)
    assert submaps.roots == (0, 1, 1, 1)
    assert submaps.are_merged(3, 1)
    assert not submaps.are_merged(3, 0)


@pytest.mark.parametrize(
    "submaps", [Submaps(), begun(3).with_search_result(look(), CONFIG), begun(2).with_merge(0, 1)]
)
def test_submaps_survive_packing(submaps: Submaps) -> None:
    again = Submaps.unpack(submaps.pack())
    assert again.roots == submaps.roots
    assert (again.pending_match is None) == (submaps.pending_match is None)
    if again.pending_match is not None:
        np.testing.assert_array_equal(again.pending_match.T_there_here, T_THERE_HERE)


@pytest.mark.parametrize(
    "fields",
    [
        {"begin_after_s": -1.0},
        {"begin_after_s": float("nan")},
        {"look_every": 0},
        {"confirm_after": 0},
        {"confirm_rad": 0.0},
    ],
)
def test_impossible_settings_are_refused(fields) -> None:
    with pytest.raises(ConfigError):
        SubmapConfig(**fields)
