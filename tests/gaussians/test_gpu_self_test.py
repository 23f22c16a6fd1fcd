"""Self-test and failures of the GPU backend, with the interpreter of Triton as the GPU."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.errors import DeviceError
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.kernels.gpu.arrays import HostArray
from ldo_service.kernels.gpu.device import Gpu
from tests.gaussians.conftest import FEW, halved, window
from tests.kernels.gpu.scenes import FilledArrays, descent, frame_loss, plane_rendering


class FailingArrays(FilledArrays):
    """Arrays of a device that is lost after a number of downloads."""

    def __init__(self, downloads: float = np.inf) -> None:
        self.downloads = downloads

    def download(self, array: HostArray) -> np.ndarray:
        self.downloads -= 1
        if self.downloads < 0:
            raise RuntimeError("CUDA error: out of memory")
        return super().download(array)


DOWNLOADS = 12  # Number of downloads of an iteration of the self-test.


class NoisyArrays(FilledArrays):
    """Arrays of a device whose floating-point results change after the first iteration."""

    calls = 0

    def download(self, array: HostArray) -> np.ndarray:
        values = super().download(array)
        self.calls += 1
        is_changed = values.dtype.kind == "f" and self.calls > DOWNLOADS
        return np.nextafter(values, np.float32(np.inf)) if is_changed else values


@pytest.fixture(autouse=True)
def _large_programs(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Launch few large programs, and compute without warnings."""
    monkeypatch.setattr(plane_rendering, "LANES", 1024)
    monkeypatch.setattr(descent, "LANES", 1024)
    monkeypatch.setattr(frame_loss, "PIXEL_LANES", 4096)
    with np.errstate(all="ignore"):
        yield


def run_self_test(arrays: FilledArrays, repeats: int) -> None:
    from ldo_service.gaussians.gpu_self_test import run_self_test  # It imports Triton.

    run_self_test(arrays, repeats)


@pytest.mark.slow
def test_kernels_pass_the_self_test() -> None:
    run_self_test(FilledArrays(), 2)


@pytest.mark.slow
def test_wrong_kernels_fail_the_self_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plane_rendering, "LOW_PASS", np.float32(0.3001))
    with pytest.raises(DeviceError, match=r".* differs by .* from the CPU"):
        run_self_test(FilledArrays(), 1)


@pytest.mark.slow
def test_results_that_change_fail_the_self_test() -> None:
    with pytest.raises(DeviceError, match="differ between two repetitions"):
        run_self_test(NoisyArrays(), 2)


def test_lost_device_fails_the_self_test() -> None:
    with pytest.raises(DeviceError, match=r"failed with RuntimeError: CUDA error: out of memory"):
        run_self_test(FailingArrays(2), 1)


def add(builder: MapBuilder, room: Sequence, index: int) -> None:
    frame = window(halved(room[index]), 64)
    builder.add(frame, room.truth().T_world_camera[index], index, 1)


def config_for(device: str) -> MapBuilderConfig:
    config = MapBuilderConfig(insertion=replace(FEW, coarsest_px=16))
    return replace(config, optimizer=replace(config.optimizer, device=device))


@pytest.mark.slow
@pytest.mark.timeout(1800)  # It takes three minutes of CPU time.
def test_keyframe_of_a_lost_device_is_mapped_by_the_cpu(
    room: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    arrays = FailingArrays()
    gpu = Gpu("interpreter", {"triton": "3.7.1"}, arrays)
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", lambda: gpu)
    monkeypatch.setattr("ldo_service.gaussians.gpu_self_test.run_self_test", lambda _: None)
    builder = MapBuilder(config_for("cuda"), folder=tmp_path / "gpu")
    add(builder, room, 0)
    assert builder.metrics()["on_gpu"] == 1
    assert builder.fitting.iterations > 0
    shutil.copytree(tmp_path / "gpu", tmp_path / "cpu")  # The images of the keyframe.
    on_cpu = MapBuilder(config_for("cpu"), folder=tmp_path / "cpu")
    on_cpu.restore(builder.snapshot())
    assert (on_cpu.metrics()["on_gpu"], on_cpu.metrics()["device_failed"]) == (0, 0)
    assert list(on_cpu.views.store.keyframes()) == [0]
    arrays.downloads = 10  # The device is lost in the second iteration, after the rendering.
    add(builder, room, 4)
    add(on_cpu, room, 4)
    assert arrays.downloads < 0
    assert builder.metrics()["device_failed"] == 1
    assert "out of memory" in caplog.text
    np.testing.assert_array_equal(builder.gaussians.rows, on_cpu.gaussians.rows)
    np.testing.assert_array_equal(builder.gaussians.ids, on_cpu.gaussians.ids)
    for name, values in builder.fitting.snapshot().items():
        np.testing.assert_array_equal(values, on_cpu.fitting.snapshot()[name])
