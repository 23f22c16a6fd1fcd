from typing import Any

from tests.faults.soak_summary import after_map


def sample_at(minute: float, main: int, rss_mb: float, cache_mb: float) -> dict[str, Any]:
    mapper = {"keyframes": 500, "keyframes_cache_mb": cache_mb}
    sizes = {"rss_mb": rss_mb, "descriptors": 60, "threads": 120}
    return {"time_s": 60 * minute, "main": main, "mapper": mapper, **sizes}


def test_quarters_are_compared_after_the_map_is_complete_and_per_start() -> None:
    early = [sample_at(minute, 1, 100, 0) for minute in range(4)]
    first = [sample_at(minute, 1, 500, 200) for minute in range(4, 20)]
    second = [sample_at(minute, 2, 300 + minute, minute) for minute in range(20, 36)]
    whole, *starts = after_map([*early, *first, *second], 240)
    assert whole.startswith("medians of first and last quarter, minutes 4.0 to 35.0: ")
    assert "rss_mb 500.0 to 331.5" in whole
    assert [line.split(": ")[0].split(", ")[1] for line in starts] == [
        "minutes 4.0 to 19.0",
        "minutes 20.0 to 35.0",
    ]
    assert "rss_mb 500.0 to 500.0, +0.0 % per hour" in starts[0]
    assert "rss_without_cache_mb 300.0 to 300.0, +0.0 % per hour" in starts[1]
    assert "rss_mb 321.5 to 333.5, +18.7 % per hour" in starts[1]


def test_cache_is_not_subtracted_if_a_sample_does_not_have_it() -> None:
    sample = sample_at(0, 1, 100, 0)
    del sample["mapper"]["keyframes_cache_mb"]
    (whole, _) = after_map([sample], 0)
    assert "rss_without_cache_mb" not in whole
