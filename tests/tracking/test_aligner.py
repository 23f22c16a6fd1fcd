"""Choice of the device of the alignment, and failures of a device that computes like the CPU."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.calibration.shutter import ShutterTiming
from ldo_service.errors import DeviceError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.kernels.gpu.arrays import HostArrays
from ldo_service.kernels.gpu.device import Gpu
from ldo_service.tracking import (
    Odometry,
    OdometryConfig,
    TrackingResult,
    TrackingStatus,
    shutter_timing,
)
from ldo_service.tracking import alignment as alignment_module
from ldo_service.tracking.aligner import Aligner, choose_aligner
from ldo_service.tracking.alignment import NormalEquations, normal_equations
from ldo_service.tracking.shutter import ShutterConfig
from tests.kernels.gpu.saved_times import save_times
from tests.moving_camera import MovingCamera

CONFIG = OdometryConfig()


class FlakyEquations:
    """Equations of the CPU, as those of a device that fails after a number of calls."""

    def __init__(self, calls_before: float = np.inf) -> None:
        self.calls_before, self.calls, self.is_inside = calls_before, 0, False

    def normal_equations(self, *args, **kwargs) -> NormalEquations:
        self.calls += 1
        if self.calls > self.calls_before:
            raise DeviceError("out of memory.") from RuntimeError("CUDA error 2")
        self.is_inside = True
        found = normal_equations(*args, **kwargs)
        self.is_inside = False
        return found


def odometry_on(
    device: FlakyEquations, monkeypatch: pytest.MonkeyPatch, config: OdometryConfig = CONFIG
) -> Odometry:
    choice = replace(Aligner().device, device="cuda", name="Some GPU")
    aligner = Aligner(device.normal_equations, choice)
    monkeypatch.setattr("ldo_service.tracking.frame_tracking.choose_aligner", lambda _: aligner)
    return Odometry(config)


@pytest.fixture(scope="module")
def frames(large_room) -> list[RgbdFrame]:
    """Return frames of a turn, after which the camera is lost and relocalized at its start."""
    turn = [se3.exp(np.array([0.0, 0.12 * k, 0.0, 0.0, 0.0, 0.0])) for k in range(16)]
    views = [large_room.view(T, index=k) for k, T in enumerate(turn)]
    back = se3.exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.02]))
    return [*views, large_room.blank(index=16), large_room.view(back, index=17)]


def track(odometry: Odometry, frames: Sequence[RgbdFrame]) -> list[TrackingResult]:
    return [odometry.process(frame) for frame in frames]


def assert_same_bits(first: Sequence[TrackingResult], second: Sequence[TrackingResult]) -> None:
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.T_odom_camera, other.T_odom_camera)
        np.testing.assert_array_equal(one.information, other.information)
        assert (one.status, one.pose_source) == (other.status, other.pose_source)


@pytest.mark.parametrize("calls_before", [0, 3, 60])
def test_alignment_of_a_failed_device_is_repeated_by_the_cpu(
    frames: list[RgbdFrame], calls_before: int, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    device = FlakyEquations(calls_before)
    odometry = odometry_on(device, monkeypatch)
    results = track(odometry, frames)
    assert device.calls == calls_before + 1  # The device is not used again.
    assert odometry.aligner.device.metrics() == {"device_failed": 1, "on_gpu": 0}
    failures = [r for r in caplog.records if "out of memory. The CPU aligns" in r.getMessage()]
    assert len(failures) == 1
    assert "RuntimeError: CUDA error 2" in caplog.text  # The traceback of the cause.
    monkeypatch.undo()
    assert_same_bits(results, track(Odometry(), frames))


def test_all_alignments_run_on_the_device(
    frames: list[RgbdFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tracking, relocalization and measurements to earlier keyframes use the device."""
    device = FlakyEquations()
    odometry = odometry_on(device, monkeypatch)
    on_cpu, compute = [], alignment_module._align.normal_equations

    class Watched:
        @staticmethod
        def normal_equations(*args, **kwargs):
            on_cpu.append(not device.is_inside)
            return compute(*args, **kwargs)

    monkeypatch.setattr(alignment_module, "_align", Watched)
    results = track(odometry, frames)
    assert {str(r.status) for r in results} == {"OK", "LOST"}
    assert results[-1].pose_source == "relocalized"
    assert any(r.keyframe is not None and r.keyframe.window for r in results)
    assert odometry._reuse.aligner is odometry.aligner
    assert len(on_cpu) == device.calls > 100
    assert not any(on_cpu)
    assert odometry.aligner.device.metrics() == {"device_failed": 0, "on_gpu": 1}


def test_equations_by_band_of_rows_run_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The GPU has no kernel for the timing of a shutter; its frames are still aligned there."""
    camera, timing, bands = MovingCamera(), ShutterTiming(0.024, 0.012, 0.010), []
    views = [camera.frame(k / 30, timing, k) for k in range(6)]

    def on_cpu(*args, **kwargs) -> NormalEquations:
        bands.append(args)
        return normal_equations(*args, **kwargs)

    monkeypatch.setattr(shutter_timing, "normal_equations", on_cpu)
    device = FlakyEquations()
    config = replace(CONFIG, shutter=ShutterConfig(initial=timing))
    results = track(odometry_on(device, monkeypatch, config), views)
    assert {r.status for r in results} == {TrackingStatus.OK}
    assert bands
    assert device.calls > 50
    monkeypatch.undo()
    assert_same_bits(results, track(Odometry(config), views))


# --- choice at the start --------------------------------------------------------------------------
def no_gpu() -> Gpu:
    raise DeviceError("there is no GPU.")


@pytest.mark.parametrize(("wanted", "has_failed"), [("auto", 0), ("cuda", 1), ("cpu", 0)])
def test_missing_gpu_is_replaced_by_the_cpu(
    wanted: str, has_failed: int, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", no_gpu)
    choice = choose_aligner(wanted).device
    assert choice.metrics() == {"device_failed": has_failed, "on_gpu": 0}
    assert len(caplog.records) == has_failed
    if has_failed:
        assert "so frames are aligned on the CPU: there is no GPU." in caplog.text


@pytest.mark.parametrize("error", [None, DeviceError("the pose differs.")])
@pytest.mark.parametrize("wanted", ["auto", "cuda"])
def test_gpu_is_chosen_if_it_passes_the_self_test(
    wanted: str, error: DeviceError | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("triton", reason="`make gpu-check` installs Triton")
    from ldo_service.tracking import alignment_self_test

    def self_test(_: object) -> None:
        if error:
            raise error

    gpu = Gpu("Some GPU", {"triton": "3"}, HostArrays())
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", lambda: gpu)
    monkeypatch.setattr(alignment_self_test, "run_self_test", self_test)
    monkeypatch.setenv("LDO_CACHE", str(tmp_path))
    if wanted == "auto":
        assert choose_aligner("auto").device.device == "cpu"
        save_times(gpu, {"alignment": 5.0}, {"alignment": 1.0})
    choice = choose_aligner(wanted).device
    if error:
        assert (choice.device, choice.has_failed) == ("cpu", True)
        assert choice.reason == "the GPU Some GPU failed: the pose differs."
    else:
        assert (choice.device, choice.name, choice.has_failed) == ("cuda", "Some GPU", False)
        assert choice.versions == {"triton": "3"}


def test_settings_select_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", no_gpu)
    odometry = Odometry(replace(CONFIG, device="cuda"))
    assert odometry.aligner.device.has_failed
    assert not Odometry().aligner.device.has_failed
