"""Benchmarks, which are run by hand: their imports must resolve, and the comparisons must work."""

from importlib import import_module
from pathlib import Path

import pytest

from ldo_service.runs.map_benchmark import HeldOutErrors

from .bench.bench_map_curves import Point, cpu_ms_at, plot
from .bench.checkouts import turn, workers

PROGRAMS = sorted(path.stem for path in Path(__file__).parent.glob("bench/bench_*.py"))


def test_benchmarks_exist() -> None:
    assert PROGRAMS


@pytest.mark.parametrize("program", PROGRAMS)
def test_benchmark_imports_and_has_main(program: str) -> None:
    assert callable(import_module(f"tests.bench.{program}").main)


def points(*values: tuple[float, float]) -> list[Point]:
    """Return points with the given CPU times and PSNRs."""
    return [
        Point(
            "this one",
            effort,
            cpu_ms,
            iterations=10,
            gaussians=100,
            resident_mb=50.0,
            errors=HeldOutErrors(
                mean_psnr_db=psnr_db,
                median_psnr_db=psnr_db,
                mean_depth_l1_cm=1.0,
                median_depth_l1_cm=1.0,
            ),
        )
        for effort, (cpu_ms, psnr_db) in enumerate(values, 1)
    ]


def test_cpu_time_at_a_psnr_is_interpolated_on_the_curve() -> None:
    curve = points((100.0, 20.0), (200.0, 24.0), (400.0, 26.0))
    assert cpu_ms_at(curve, 23.0) == 175.0
    assert cpu_ms_at(curve, 26.0) == 400.0
    assert cpu_ms_at(curve, 19.0) == 100.0  # The curve begins above.
    assert cpu_ms_at(curve, 26.5) is None


def test_plot_shows_each_point_with_its_effort() -> None:
    curve = points((100.0, 20.0), (200.0, 24.0))
    drawing = plot("room", {"earlier": curve, "this one": curve})
    assert drawing.count("<circle") == 4
    assert drawing.count(">2</text>") == 2


def test_workers_track_the_same_frames_in_turn() -> None:
    arguments = ("track", "synthetic:room")
    with workers([(None, arguments), (None, arguments)]) as started:
        turns = [turn(started, index, str(index)) for index in range(2)]
    for first, second in turns:
        assert first["status"] == "OK"
        assert first["T"] == second["T"]
        assert first["cpu_s"] > 0
