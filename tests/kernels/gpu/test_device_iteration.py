"""Benchmarks of a GPU, with the interpreter of Triton as the GPU."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ldo_service.errors import DeviceError
from ldo_service.evaluation.iteration import bench_camera
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.kernels.gpu.device import Gpu
from ldo_service.runs.map_benchmark import HeldOutErrors, MapMeasurement
from tests.bench import bench_gpu
from tests.commands.test_cli import ldo
from tests.kernels.gpu.scenes import ARRAYS, device_iteration, equation_sums, plane_rendering

GPU = Gpu("interpreter", {"triton": "3.7.1"}, ARRAYS)
SMALL = ("bench", "render", "--device", "cuda", "--gaussians", "30", "--size", "16x16")


@pytest.fixture(autouse=True)
def _interpreter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use the interpreter as the GPU, without the self-test, which takes half a minute."""
    monkeypatch.setenv("LDO_CACHE", str(tmp_path))
    for name in ("ldo_service.commands.bench.find_gpu", "tests.bench.bench_gpu.required_gpu"):
        monkeypatch.setattr(name, lambda: GPU)
    monkeypatch.setattr(device_iteration, "run_self_test", lambda *_: None)
    monkeypatch.setattr(device_iteration.alignment_self_test, "run_self_test", lambda *_: None)
    monkeypatch.setattr(device_iteration, "ALIGNED_PX", (48, 36))
    monkeypatch.setattr(equation_sums, "POINT_LANES", 2048)


def test_times_of_both_devices_are_measured(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = ldo(capsys, *SMALL, "--repeats", "1", "--json")
    assert code == 0
    facts = json.loads(out)
    assert facts["gpu"] == "interpreter"
    for times_ms in (facts["cpu_ms"], facts["gpu_ms"]):
        assert set(times_ms) == {
            *("rendering and exposure", "loss and step", "iteration"),
            "alignment",
        }
        assert all(time_ms > 0 for time_ms in times_ms.values())
    assert facts["gpu_ms"]["iteration"] > facts["cpu_ms"]["iteration"]
    result = GPU.benchmark()
    assert result is not None
    assert (result.cpu_ms, result.gpu_ms) == (facts["cpu_ms"], facts["gpu_ms"])
    assert result.scene.startswith("16x16 pixels, 30 Gaussians, ")
    assert not result.is_faster("mapper")


def test_wrong_results_are_not_timed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plane_rendering, "LOW_PASS", np.float32(0.301))
    monkeypatch.setattr(device_iteration, "medians_ms", lambda *_: pytest.fail("it was timed"))
    code, _, err = ldo(capsys, *SMALL)
    assert code == 1
    assert "the GPU failed or differed from the CPU in an iteration" in err
    assert "at 16x16 pixels with 30 Gaussians" in err
    assert "No times were measured." in err
    result = GPU.benchmark()
    assert result is not None
    assert "No times were measured." in result.error
    assert not result.is_faster("mapper")


def test_wrong_alignments_are_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(device_iteration.alignment_self_test.TOLERANCE, "pose", 0.0)
    with pytest.raises(DeviceError, match=r"pose differs by .* from the CPU"):
        device_iteration.alignment_steps(ARRAYS)


def test_gpu_that_fails_the_self_test_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise DeviceError("the loss differs.")

    monkeypatch.setattr(device_iteration, "run_self_test", fail)
    with pytest.raises(DeviceError, match="the loss differs"):
        device_iteration.device_times(ARRAYS, 30, bench_camera(16, 16), 1)


def test_program_maps_no_source_if_the_gpu_is_wrong(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise DeviceError("the loss differs.")

    monkeypatch.setattr(device_iteration, "run_self_test", fail)
    monkeypatch.setattr(bench_gpu, "report_source", lambda *_: pytest.fail("it was timed"))
    monkeypatch.setattr("sys.argv", ["bench_gpu", "synthetic:room"])
    assert bench_gpu.main() == 1
    assert capsys.readouterr().out.endswith("the loss differs.\n")


@pytest.mark.slow
def test_program_prints_the_stages(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_gpu, "SIZES", ((16, 16, 20),))
    monkeypatch.setattr(bench_gpu, "REPEATS", 1)
    bench_gpu.report_iterations()
    out = capsys.readouterr().out
    assert "interpreter triton 3.7.1" in out
    assert "16x16, 20 Gaussians" in out
    assert "  iteration: CPU" in out


def test_equal_time_gives_the_saved_time_to_the_iterations() -> None:
    cpu = SimpleNamespace(cpu_ms={"all": 500.0, "iterations": 400.0})
    gpu = SimpleNamespace(cpu_ms={"all": 140.0, "iterations": 40.0}, effort=12)
    assert bench_gpu.equal_time_effort(cpu, gpu) == 120  # type: ignore[arg-type]


class TimedSource:
    """Tracked source of two keyframes, whose iterations are ten times faster on a GPU."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []

    def record(self, *_: object) -> "TimedSource":
        return self

    def measure(self, config: MapBuilderConfig, effort: int) -> MapMeasurement:
        device = config.optimizer.device
        self.calls.append((device, effort))
        iterations_ms = effort * (10.0 if device == "cpu" else 1.0)
        psnr_db = 20.0 + effort / 10
        return MapMeasurement(
            source="room",
            frames=10,
            keyframes=2,
            effort=effort,
            iterations=2 * effort,
            gaussians=100,
            fps=10_000 / (2 * (iterations_ms + 20)),
            cpu_ms={"iterations": iterations_ms, "all": iterations_ms + 20},
            online=HeldOutErrors(
                mean_psnr_db=psnr_db,
                median_psnr_db=psnr_db,
                mean_depth_l1_cm=1.0,
                median_depth_l1_cm=1.0,
            ),
        )


def test_source_is_mapped_with_equal_iterations_and_in_equal_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = TimedSource()
    monkeypatch.setattr(bench_gpu, "TrackedSource", source)
    bench_gpu.report_source("synthetic:room", 10, 12, tmp_path)
    assert source.calls == [("cpu", 12), ("cuda", 12), ("cuda", 120)]
    _, cpu, equal_iterations, equal_time = capsys.readouterr().out.splitlines()
    assert "CPU: 35.71 FPS, 24 iterations, 100 Gaussians, 21.20 dB" in cpu
    assert "GPU, equal iterations: 156.25 FPS" in equal_iterations
    assert equal_iterations.endswith("(4.4x)")
    assert "GPU, equal time: 35.71 FPS, 240 iterations, 100 Gaussians, 32.00 dB" in equal_time
