"""Pairing of two streams by nearest stamps, in order and with bounded waiting."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.errors import ConfigError, FrameError
from ldo_service.geometry import associate
from ldo_service.geometry.stamps import StreamPairer

MS = 1_000_000


@dataclass(frozen=True)
class Half:
    stamp_ns: int


def pairing(max_skew_ms: int = 15, buffer: int = 8) -> StreamPairer[Half, Half]:
    return StreamPairer(max_skew_ms * MS, buffer)


def feed(pairs: StreamPairer[Half, Half], *events: tuple[str, int]) -> list[tuple[int, int]]:
    """Feed halves ("a" or "b", stamp in ms), and return the stamps in ms of the new pairs."""
    out = []
    for stream, stamp_ms in events:
        add = pairs.add_a if stream == "a" else pairs.add_b
        out += [(a.stamp_ns // MS, b.stamp_ns // MS) for a, b in add(Half(stamp_ms * MS))]
    return out


def at_30_hz(offset_ms: int, count: int = 10) -> list[tuple[str, int]]:
    """Return events of two streams in order of their stamps; b is later by an offset."""
    a = [("a", 33 * i) for i in range(count)]
    b = [("b", 33 * i + offset_ms) for i in range(count)]
    return sorted(a + b, key=lambda event: event[1])


def test_equal_stamps_are_paired_at_once() -> None:
    pairs = pairing()
    assert feed(pairs, ("a", 100)) == []
    assert feed(pairs, ("b", 100)) == [(100, 100)]
    assert (pairs.pairs, pairs.lost_a, pairs.lost_b, pairs.skews_ms()) == (1, 0, 0, [0.0])


@pytest.mark.parametrize("offset_ms", [-12, -3, 0, 4, 15])
def test_pair_within_the_allowed_skew_is_given_at_once(offset_ms: int) -> None:
    pairs = pairing()
    for i in range(5):
        assert feed(pairs, ("a", 100 + 33 * i)) == []
        expected = (100 + 33 * i, 100 + 33 * i + offset_ms)
        assert feed(pairs, ("b", expected[1])) == [expected]
    assert max(pairs.skews_ms()) == abs(offset_ms)


def test_halves_too_far_apart_are_never_paired_and_counted() -> None:
    pairs = pairing(max_skew_ms=5)
    assert feed(pairs, *at_30_hz(offset_ms=16)) == []
    assert pairs.lost_a + pairs.lost_b == 19, "the last one still waits"


def test_nearest_half_is_paired_though_an_earlier_one_is_within_reach() -> None:
    pairs = pairing()
    at_90_hz = [("b", 11 * i + 3) for i in range(9)]
    feed(pairs, *at_90_hz)  # The period of b is known now.
    assert feed(pairs, ("b", 102), ("a", 112)) == [], "102 is 10 ms away: a nearer one may come"
    assert feed(pairs, ("b", 113)) == [(112, 113)]
    assert pairs.lost_a == 0


def test_dropped_half_loses_only_its_partner() -> None:
    pairs = pairing()
    events = [event for event in at_30_hz(offset_ms=2) if event not in (("a", 99), ("b", 200))]
    assert feed(pairs, *events) == [(33 * i, 33 * i + 2) for i in range(10) if i not in (3, 6)]
    assert (pairs.lost_a, pairs.lost_b) == (1, 1)


def test_stream_that_arrives_much_later_is_paired() -> None:
    pairs = pairing()
    late = [("a", 33 * i) for i in range(6)] + [("b", 33 * i + 1) for i in range(6)]
    assert feed(pairs, *late) == [(33 * i, 33 * i + 1) for i in range(6)]


def test_single_stream_buffers_a_bounded_number_of_halves() -> None:
    pairs = pairing(buffer=4)
    assert feed(pairs, *(("a", 33 * i) for i in range(20))) == []
    assert pairs.lost_a == 16
    assert feed(pairs, ("b", 33 * 19)) == [(33 * 19, 33 * 19)]


def test_pair_does_not_wait_forever_for_a_nearer_half() -> None:
    pairs = pairing(buffer=3)
    feed(pairs, *(("b", 11 * i) for i in range(9)))  # 90 Hz, and then no more.
    assert feed(pairs, ("a", 98), ("a", 131), ("a", 164)) == []
    assert feed(pairs, ("a", 197)) == [(98, 88)]


def test_decreasing_stamps_are_rejected_without_effect() -> None:
    pairs = pairing()
    feed(pairs, ("a", 100))
    for stamp_ms in (100, 67):
        with pytest.raises(FrameError, match="must be later than the last"):
            feed(pairs, ("a", stamp_ms))
    assert feed(pairs, ("b", 101)) == [(100, 101)]


@pytest.mark.parametrize(("max_skew_ns", "buffer"), [(-1, 8), (1, 0)])
def test_impossible_limits_are_rejected(max_skew_ns: int, buffer: int) -> None:
    with pytest.raises(ConfigError):
        StreamPairer(max_skew_ns, buffer)


stamps = st.lists(st.integers(0, 500), unique=True, max_size=20).map(sorted)


@given(stamps, stamps, st.randoms())
def test_pairs_are_in_order_and_reach_and_every_half_is_counted(a, b, random) -> None:
    pairs, out, left = pairing(buffer=4), [], {"a": list(a), "b": list(b)}
    while left["a"] or left["b"]:
        stream = random.choice([name for name in left if left[name]])
        out += feed(pairs, (stream, left[stream].pop(0)))
    for side in (0, 1):
        of_side = [pair[side] for pair in out]
        assert of_side == sorted(set(of_side))
    assert all(abs(one - other) <= 15 for one, other in out)
    assert pairs.pairs == len(out)
    assert 0 <= len(a) - len(out) - pairs.lost_a <= 4
    assert 0 <= len(b) - len(out) - pairs.lost_b <= 4


@given(st.lists(st.integers(-15, 15), min_size=1, max_size=30))
def test_jitter_below_half_a_period_gives_the_pairs_of_associate(jitter) -> None:
    a = [33 * i + 40 for i in range(len(jitter))]
    b = [stamp + j for stamp, j in zip(a, jitter, strict=True)]
    events = sorted([("a", s) for s in a] + [("b", s) for s in b], key=lambda e: (e[1], e[0]))
    if len(set(b)) < len(b) or b != sorted(b):
        return
    pairs = pairing()
    expected = associate(np.array(a), np.array(b), 15)
    paired = feed(pairs, *events)
    assert paired == [(a[i], b[j]) for i, j in expected][: len(paired)]
    assert len(paired) >= len(expected) - 1, "only the last may still wait for a nearer one"


def test_both_streams_together_are_bounded_by_bytes_and_the_larger_one_gives_way() -> None:
    # The next measurement of a may be nearer to those of b, so both streams wait.
    pairs = StreamPairer[Half, Half](15 * MS, 8, size_of=lambda _half: 30, max_bytes=64)
    assert feed(pairs, ("a", 0), ("a", 20), ("b", 32), ("b", 33), ("b", 34)) == []
    assert (pairs.waiting_bytes, pairs.lost_a, pairs.lost_b) == (60, 1, 2)
