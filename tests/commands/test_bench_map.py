"""Command `ldo bench map`: the measurement, and its comparison with a stored baseline."""

import json
from pathlib import Path

import msgspec
import pytest

from ldo_service.commands.bench import (
    measurement_table,
    read_baseline,
    require_comparable,
    save_baseline,
)
from ldo_service.errors import ConfigError
from ldo_service.runs.map_benchmark import STAGES, HeldOutErrors, MapMeasurement

from .test_cli import assert_one_paragraph, ldo


@pytest.fixture
def measured() -> MapMeasurement:
    errors = HeldOutErrors(
        mean_psnr_db=30.0, median_psnr_db=31.0, mean_depth_l1_cm=1.0, median_depth_l1_cm=0.0
    )
    return MapMeasurement(
        source="room",
        frames=60,
        keyframes=20,
        effort=12,
        iterations=500,
        gaussians=50_000,
        fps=4.0,
        cpu_ms={**dict.fromkeys(STAGES, 100.0), "all": 500.0},
        online=errors,
    )


def test_saved_baseline_is_read_back(measured: MapMeasurement, tmp_path: Path) -> None:
    save_baseline(tmp_path / "baseline.json", measured)
    assert read_baseline(tmp_path / "baseline.json") == measured


def test_table_has_the_ratio_to_the_baseline(measured: MapMeasurement) -> None:
    faster = msgspec.structs.replace(measured, fps=8.0, cpu_ms={**measured.cpu_ms, "all": 175.0})
    table = measurement_table(faster, measured)
    cells = [list(column.cells) for column in table.columns]
    rows = {row[0]: row[1:] for row in zip(*cells, strict=True)}
    assert rows["FPS"] == ("8.00", "4.00", "2.00")
    assert rows["all, CPU ms per keyframe"] == ("175.00", "500.00", "0.35")
    assert rows["depth L1 cm, median"][-1] == ""  # The baseline is 0.


def test_baseline_of_other_frames_is_refused(measured: MapMeasurement) -> None:
    require_comparable(measured, msgspec.structs.replace(measured, effort=4))
    with pytest.raises(ConfigError, match="20 keyframes in 50 frames of room"):
        require_comparable(measured, msgspec.structs.replace(measured, frames=50))


@pytest.mark.parametrize("content", [None, b"{", b'{"source": "room"}', b"\xff"])
def test_unreadable_baseline_is_refused(capsys, tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "baseline.json"
    if content is not None:
        path.write_bytes(content)
    code, _, err = ldo(capsys, "bench", "map", "synthetic:room", "--baseline", path)
    assert code == 2
    assert_one_paragraph(err)


def test_unwritable_baseline_is_refused(measured: MapMeasurement, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        save_baseline(tmp_path / "missing" / "baseline.json", measured)


@pytest.mark.parametrize("change", [("--frames", "1"), ("--refine-iterations", "-1")])
def test_invalid_numbers_are_refused(capsys, change: tuple[str, str]) -> None:
    code, _, err = ldo(capsys, "bench", "map", "synthetic:room", *change)
    assert code == 2
    assert_one_paragraph(err)


@pytest.mark.slow
def test_bench_map_reuses_the_tracked_source(capsys, tmp_path: Path) -> None:
    runs, baseline = tmp_path / "runs", tmp_path / "baseline.json"
    common = ("bench", "map", "synthetic:room", "--frames", "14", "--runs", runs)
    code, out, err = ldo(capsys, *common, "--set", "mapper.iterations=2", "--save", baseline)
    assert code == 0
    assert "track" in err
    assert "PSNR dB, mean" in out
    recorded = next(runs.glob("*/front_end.mcap")).stat().st_mtime_ns

    more = ("--set", "mapper.iterations=6", "--refine-iterations", "4", "--json")
    code, out, _ = ldo(capsys, *common, *more, "--baseline", baseline)
    assert code == 0
    facts, before = json.loads(out), read_baseline(baseline)
    assert next(runs.glob("*/front_end.mcap")).stat().st_mtime_ns == recorded
    assert facts["keyframes"] == before.keyframes
    assert facts["iterations"] > before.iterations
    assert facts["cpu_ms"]["all"] == pytest.approx(sum(facts["cpu_ms"][s] for s in STAGES))
    assert facts["cpu_ratio"] == pytest.approx(facts["cpu_ms"]["all"] / before.cpu_ms["all"])
    assert facts["refined"]["mean_psnr_db"] > 20

    code, _, err = ldo(capsys, *common, "--set", "tracker.features.max_features=300")
    assert code == 2
    assert_one_paragraph(err)
