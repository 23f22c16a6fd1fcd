"""Forecasts from synthetic heartbeats and from the files of a state folder."""

import os
import re
from collections.abc import Iterable
from math import inf
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.actors.mapper import Mapper
from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.errors import DataError
from ldo_service.recordings.mcap_file import RecordConfig, RecordingFile
from ldo_service.schemas import Health
from ldo_service.service.forecast import Forecast, Trend, duration, forecast
from ldo_service.service.state_forecast import forecast_of_state
from tests.commands.test_cli import ldo
from tests.recordings.journal_helpers import Tally, run_recorded
from tests.runtime.fake_actors import Number
from tests.service.conftest import live_service, wait_until
from tests.service.test_diagnostics import health, outputs

USED_OF_MAPPER = (
    *("gaussians", "gaussians_max", "keyframes_disk_mb", "keyframes_disk_max_mb"),
    *("keyframes_stored", "keyframes_stored_max"),
)
PERIOD_S = 0.5
COUNT = 20


def beats(
    actor: str = "mapper",
    *,
    count: int = COUNT,
    first: int = 0,
    pid: int = 1,
    rss_mb: float = 300.0,
    rss_mb_per_beat: float = 0.0,
    per_beat: dict[str, tuple[float, float]] | None = None,
    **fields,
) -> list[tuple[float, Health]]:
    """Return heartbeats; `per_beat` has the first value and the change per heartbeat of metrics."""
    return [
        (
            PERIOD_S * number,
            health(
                actor=actor,
                pid=pid,
                steps=10 * number,
                rss_mb=rss_mb + rss_mb_per_beat * number,
                metrics={k: start + step * number for k, (start, step) in (per_beat or {}).items()},
                **fields,
            ),
        )
        for number in range(first, first + count)
    ]


def text(result: Forecast) -> str:
    return "\n".join(result.lines())


MAPPING = {  # A keyframe per second: one every second heartbeat.
    "keyframes": (100.0, 0.5),
    "memory_available_mb": (5000.0, 0.0),
    "disk_free_mb": (9000.0, 0.0),
    "state_mb": (50.0, 0.25),
    "gaussians_disk_mb": (0.0, 0.25),
    "keyframes_disk_mb": (1000.0, 0.5),
    "keyframes_disk_max_mb": (4096.0, 0.0),
}


def test_rates_and_times_until_bounds_are_those_of_the_series() -> None:
    result = forecast({"mapper": beats(per_beat=MAPPING, rss_mb_per_beat=0.25, step_ms_p50=210.0)})
    assert result.keyframes_per_s == pytest.approx(1.0)
    assert result.memory_mb_per_s == pytest.approx(0.5)
    assert result.disk_mb_per_s == pytest.approx(2.0)
    assert [bound.what for bound in result.reached] == [
        "keyframe images on disk",
        "disk of the state folder",
        "memory",
    ]
    images, disk, memory = result.reached
    assert images.time_s == pytest.approx((4096 - 1009.5) / 1)
    assert disk.time_s == pytest.approx(9000 / 2)
    assert memory.time_s == pytest.approx(5000 / 0.5)
    first, *_, last = result.lines()
    assert first == (
        "forecast, extrapolated from 20 heartbeats of each actor over 9.5 s: a keyframe every 1 s "
        "takes 0.50 MB of memory, 2.00 MB of disk, 210 ms of the mapper"
    )
    assert last == (
        "after that, memory, in 2.8 h (5,000 MB available): the operating system may then kill a "
        "process of the service"
    )
    assert "the first limit is keyframe images on disk, in 51.4 min (1,010 of 4,096" in text(result)


@pytest.mark.parametrize("step", [0.0, -1.0])
def test_flat_and_shrinking_values_reach_no_bound(step: float) -> None:
    metrics = {
        "keyframes": (100.0, 0.0),
        "memory_available_mb": (5000.0, 0.0),
        "disk_free_mb": (9000.0, -step),
        "keyframes_disk_mb": (1000.0, step),
        "keyframes_disk_max_mb": (4096.0, 0.0),
        "gaussians": (1e6, 10 * step),
        "gaussians_max": (1.5e6, 0.0),
    }
    result = forecast({"mapper": beats(per_beat=metrics, rss_mb_per_beat=step)})
    assert result.reached == []
    assert {bound.time_s for bound in result.bounds} == {inf}
    taken = "-120.00 MB of" if step else "no clear amount of"
    assert "no clear rate of keyframes (a longer window may show one)" in text(result)
    assert f"; a minute takes {taken} memory, {taken} disk" in text(result)
    assert text(result).endswith("if this goes on, no limit is reached within 24 h")


def test_noise_without_growth_is_no_trend() -> None:
    noisy = [3.0, -2.0, 1.0, -3.0, 2.0, 2.0, -1.0, 0.0, 1.0, -2.0]
    assert Trend.of(range(10), noisy).per_s == 0.0
    growing = [10.0 * t + noise for t, noise in enumerate(noisy)]
    assert Trend.of(range(10), growing).per_s == pytest.approx(10.0, abs=0.5)


@pytest.mark.parametrize("count", [6, 20])
def test_single_step_is_no_trend(count: int) -> None:
    """A state that was saved once, or one keyframe, does not tell when the next one comes."""
    jitter = [0.2 * (number % 2) for number in range(count)]
    for at in range(1, count):
        values = [300.0 + jitter[number] + 100.0 * (number >= at) for number in range(count)]
        assert Trend.of(range(count), values) == Trend(values[-1], 0.0)


def test_step_does_not_add_to_the_trend_of_the_other_values() -> None:
    values = [0.5 * number + 100.0 * (number >= 7) for number in range(20)]
    assert Trend.of(range(20), values).per_s == pytest.approx(0.5, rel=0.15)


def test_two_keyframes_in_a_window_are_a_trend() -> None:
    values = [float((number >= 5) + (number >= 15)) for number in range(20)]
    assert Trend.of(range(20), values).per_s == pytest.approx(0.1, rel=0.3)


def test_memory_that_is_freed_regularly_is_no_growth() -> None:
    for period in (4, 5, 7, 10):
        values = [300.0 + number % period for number in range(20)]
        assert Trend.of(range(20), values).per_s == 0.0


def test_scatter_of_a_constant_service_rarely_is_a_trend() -> None:
    random = np.random.default_rng(1)
    clear = [Trend.of(range(6), random.normal(300, 1, 6).tolist()).per_s != 0 for _ in range(2000)]
    assert np.mean(clear) < 0.02


def test_disk_that_other_programs_fill_is_full_earlier() -> None:
    metrics = {"state_mb": (50.0, 0.5), "disk_free_mb": (9019.0, -1.0)}
    result = forecast({"mapper": beats(per_beat=metrics)})
    (disk,) = result.reached
    assert result.disk_mb_per_s == pytest.approx(1.0)
    assert disk.time_s == pytest.approx(9000 / 2)
    assert "9,000 MB free, 2 MB less per second, for all programs together" in str(disk)


def test_backlog_that_only_an_older_generation_needs_is_no_bound() -> None:
    series = [
        (at_s, msgspec.structs.replace(message, outputs=outputs(
            behind={"detector": 0}, backlog_mb=float(number), backlog_max_mb=2000.0)))
        for number, (at_s, message) in enumerate(beats("tracker"))
    ]  # fmt: skip
    assert forecast({"tracker": series}).reached == []


def test_bound_after_24_hours_is_not_reported() -> None:
    near_mb, far_mb = 23.9 * 7200, 24.1 * 7200  # The rate is 2 MB per second.
    (bound,) = forecast({"mapper": beats(per_beat={"disk_free_mb": (near_mb, -1.0)})}).reached
    assert bound.time_s == pytest.approx(23.9 * 3600, abs=60)
    assert forecast({"mapper": beats(per_beat={"disk_free_mb": (far_mb, -1.0)})}).reached == []


def test_only_heartbeats_after_a_restart_count() -> None:
    before = beats(count=10, pid=1, per_beat={"state_mb": (10.0, 500.0)})
    after = beats(count=10, first=10, pid=2, per_beat={"state_mb": (50.0, 1.0)})
    result = forecast({"mapper": before + after})
    assert result.disk_mb_per_s == pytest.approx(2.0)
    assert "mapper was restarted in this time; only its 10 heartbeats since then count" in text(
        result
    )
    assert "from 10 heartbeats of each actor over 4.5 s" in text(result)


def test_memory_of_a_restarted_process_is_no_growth() -> None:
    before = beats("optimizer", count=17, pid=2, rss_mb=50.0)
    after = beats("optimizer", count=2, first=17, pid=3, rss_mb=500.0)
    metrics = {"memory_available_mb": (5000.0, 0.0)}
    result = forecast({"optimizer": before + after, "mapper": beats(per_beat=metrics)})
    assert result.memory_mb_per_s == 0.0
    assert result.reached == []


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_heartbeats_give_no_forecast(count: int) -> None:
    lines = list(forecast({"mapper": beats(count=count, per_beat=MAPPING)}).lines())
    assert len(lines) == 1
    assert lines[0].startswith(f"no forecast from {count} heartbeats")
    assert "a trend needs 3" in lines[0]


def test_heartbeat_that_the_parent_process_repeats_is_left_out() -> None:
    series = beats(count=2, per_beat=MAPPING)
    repeated = [(PERIOD_S * number, series[-1][1]) for number in range(2, 12)]
    assert forecast({"mapper": series + repeated}).missing


def test_memory_of_actors_in_one_process_counts_once() -> None:
    metrics = {"memory_available_mb": (5000.0, 0.0)}
    series = {
        name: beats(name, pid=pid, rss_mb_per_beat=0.5, per_beat=metrics)
        for name, pid in (("mapper", 1), ("tracker", 1), ("optimizer", 2))
    }
    assert forecast(series).memory_mb_per_s == pytest.approx(2.0)


def test_reached_limit_of_a_store_is_said() -> None:
    metrics = {"keyframes_disk_mb": (4095.6, 0.0), "keyframes_disk_max_mb": (4096.0, 0.0)}
    result = forecast({"mapper": beats(per_beat=metrics)})
    assert "keyframe images on disk, reached now (4,096 of 4,096 MB)" in text(result)


def test_backlog_and_recording_have_bounds() -> None:
    recording = {
        "recording_mb": (9000.0, 0.0),
        "recording_file_mb": (10.0, 5.0),
        "recording_max_mb": (10_000.0, 0.0),
        "recording_min_free_mb": (1000.0, 0.0),
        "recording_free_mb": (21_190.0, -10.0),
        "disk_free_mb": (7200.0, 0.0),  # The state folder is on another disk.
    }
    series = {name: beats(name, per_beat=recording) for name in ("tracker", "mapper")}
    series["tracker"] = [
        (
            at_s,
            msgspec.structs.replace(
                message,
                outputs=outputs(
                    behind={"detector": 9, "optimizer": 0},
                    backlog_mb=100 + 0.5 * number,
                    backlog_max_mb=2000.0,
                ),
            ),
        )
        for number, (at_s, message) in enumerate(series["tracker"])
    ]
    times_s = {bound.what: bound.time_s for bound in forecast(series).reached}
    assert times_s == {
        "recording.max_gb": pytest.approx(1000 / 20),
        "recording.min_free_gb": pytest.approx(20_000 / 20),
        "disk of the state folder": pytest.approx(7200 / 1),
        "backlog of keyframe/new in tracker": pytest.approx(1890.5 / 1),
    }
    assert "dropped and never reach detector" in text(forecast(series))


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [(89.0, "89 s"), (90.0, "1.5 min"), (5399.0, "90.0 min"), (7200.0, "2.0 h")],
)
def test_duration_has_a_suitable_unit(seconds: float, expected: str) -> None:
    assert duration(seconds) == expected


def state_folder(folder: Path, times_s: Iterable[float]) -> Path:
    images = folder / "map" / "images"
    images.mkdir(parents=True)
    for number, at_s in enumerate(times_s):
        image = images / f"{number:08d}.keyframe"
        image.write_bytes(bytes(500_000))
        os.utime(image, (at_s, at_s))
    return folder


def test_state_folder_is_extrapolated_from_its_newest_images(tmp_path: Path) -> None:
    hours_ago = (1e9 + number for number in range(10))
    newest = (1e9 + 9000 + 2.0 * number for number in range(10))
    folder = state_folder(tmp_path, (*hours_ago, *newest))
    (folder / "config.yaml").write_text("mapper: {keyframe_images: {disk_mb: 100.0}}\n")
    (folder / "map.1").write_bytes(bytes(10_000_000))  # 0.5 MB more per keyframe.
    result = forecast_of_state(folder)
    assert result.keyframes_per_s == pytest.approx(0.5)
    assert result.disk_mb_per_s == pytest.approx(0.5, rel=1e-3)
    assert "the newest 10 keyframe images" in text(result)
    assert "a keyframe every 2 s takes an unknown amount of memory, 1.00 MB of disk" in text(result)
    times_s = {bound.what: bound.time_s for bound in result.bounds}
    assert times_s["keyframe images on disk"] == pytest.approx(90 / 0.25)
    assert times_s["keyframes with images"] == pytest.approx((20_000 - 20) / 0.5)


def test_state_folder_with_few_images_has_no_forecast(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no keyframe images"):
        forecast_of_state(tmp_path)
    assert "a trend needs 3" in text(forecast_of_state(state_folder(tmp_path, (1e9, 2e9))))


async def test_actors_report_the_metrics_that_a_forecast_uses(tmp_path: Path) -> None:
    """A forecast omits the bounds of metrics that are not reported."""
    mapper = Mapper(MapperConfig(folder=str(tmp_path / "map"))).metrics()
    assert {"keyframes", "gaussians_disk_mb", *USED_OF_MAPPER} <= mapper.keys()
    stage = await run_recorded(tmp_path, range(3))
    reported = stage.health().metrics
    assert {"memory_available_mb", "disk_free_mb"} <= reported.keys()
    files = (tmp_path / "state" / Tally.name).iterdir()
    assert reported["state_mb"] == pytest.approx(sum(file.stat().st_size for file in files) / 1e6)
    file = RecordingFile(tmp_path / "one.mcap", {}, RecordConfig(max_gb=2.0, min_free_gb=0.5))
    empty_mb = file.metrics()["recording_mb"]
    file.add("numbers", Number, bytes(3_000_000), 0, 0)
    metrics = file.metrics()
    assert metrics["recording_file_mb"] == pytest.approx(3.0)
    assert metrics["recording_mb"] == pytest.approx(empty_mb + 3.0)
    assert (metrics["recording_max_mb"], metrics["recording_min_free_mb"]) == (2000.0, 500.0)
    assert metrics["recording_free_mb"] > 0
    file.close()
    assert file.metrics() == {}


@pytest.mark.slow
def test_doctor_prints_a_forecast_for_a_running_service(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        service.publisher("synthetic:tour-noisy", "--rate", "5")
        service.wait_for_poses(10)

        def is_forecast() -> bool:
            _, out, _ = ldo(capsys, "doctor", "--endpoint", service.endpoint, "--window-s", "8")
            return bool(
                re.search(r"over \d+\.\d s: a keyframe every [\d.]+ s takes .* MB of disk", out)
            )

        wait_until(is_forecast, 60, "a forecast with keyframes")
        code, out, _ = ldo(capsys, "doctor", "forecast", service.state)
    assert code == 0
    assert "MB of disk" in out
