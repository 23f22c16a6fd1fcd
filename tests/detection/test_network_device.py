"""Networks on another device than the CPU, with a stand-in for the session on a GPU."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ldo_service.detection import onnx_network
from ldo_service.detection.detectors import NetworkConfig, OnnxDetector
from ldo_service.detection.onnx_network import CPU, CUDA
from ldo_service.errors import DeviceError
from tests.detection.networks import squares_image, squares_network

IMAGE = squares_image([("red", 16, 48, 16), ("blue", 112, 80, 16), ("red", 64, 0, 16)])


class GpuSession:
    """Session of onnxruntime on the CPU that claims to run on a GPU, and can fail.

    Attributes:
        failure: Error of the next inference; None for none.
        error: Value that is added to the outputs.
        length: Length of the last axis of the outputs; None for all.
    """

    failure: Exception | None = None
    error = 0.0
    length: int | None = None

    def __init__(self, session: Any) -> None:
        self._session = session

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def get_providers(self) -> list[str]:
        return [CUDA, CPU]

    def io_binding(self) -> Any:
        binding = self._session.io_binding()
        copy = binding.copy_outputs_to_cpu
        binding.copy_outputs_to_cpu = lambda: [
            (output + self.error)[..., : self.length] for output in copy()
        ]
        return binding

    def run_with_iobinding(self, binding: Any) -> None:
        if self.failure:
            raise self.failure
        self._session.run_with_iobinding(binding)


@pytest.fixture
def sessions(monkeypatch: pytest.MonkeyPatch) -> type[GpuSession]:
    """Open sessions on a GPU whose memory is that of the CPU."""
    kind = type("Session", (GpuSession,), {})
    open_session = onnx_network._session

    def session(path: Path, providers: list[str], threads: int) -> Any:
        opened = open_session(path, [CPU], threads)
        return kind(opened) if providers[0] == CUDA else opened

    monkeypatch.setattr(onnx_network, "providers_of", lambda _: [CUDA, CPU])
    monkeypatch.setattr(onnx_network, "_session", session)
    monkeypatch.setattr(onnx_network, "MEMORY", {CUDA: "cpu"})
    return kind


def detector(tmp_path: Path, device: str = "cuda") -> OnnxDetector:
    path = squares_network("yolov8").write(tmp_path / "net.onnx")
    return OnnxDetector(path, NetworkConfig(device=device))


def boxes_of(network: OnnxDetector) -> np.ndarray:
    return network.detect(IMAGE).boxes_px


@pytest.mark.usefixtures("sessions")
def test_network_on_a_gpu_gives_the_results_of_the_cpu(tmp_path: Path, caplog) -> None:
    network = detector(tmp_path)
    assert network.metrics() == {"device_failed": 0, "on_gpu": 1}
    on_gpu = boxes_of(network)
    assert len(on_gpu) == 3
    assert not caplog.records
    network._network._continue_on_cpu(DeviceError("it was removed."))
    np.testing.assert_array_equal(boxes_of(network), on_gpu)


def test_cpu_repeats_an_inference_that_fails(
    tmp_path: Path, sessions: type[GpuSession], caplog
) -> None:
    network = detector(tmp_path)
    wanted = boxes_of(network)
    sessions.failure = RuntimeError("CUDA failure 2: out of memory")
    np.testing.assert_array_equal(boxes_of(network), wanted)
    np.testing.assert_array_equal(boxes_of(network), wanted)
    assert network.providers == [CPU]
    assert network.metrics() == {"device_failed": 1, "on_gpu": 0}
    (record,) = caplog.records
    assert "CUDA failure 2: out of memory" in record.getMessage()
    assert "Traceback" in caplog.text


def test_first_outputs_of_another_shape_select_the_cpu(
    tmp_path: Path, sessions: type[GpuSession], caplog
) -> None:
    sessions.length = 10
    network = detector(tmp_path)
    assert network.metrics() == {"device_failed": 1, "on_gpu": 0}
    assert len(boxes_of(network)) == 3
    (record,) = caplog.records
    assert "differ from the CPU" in record.getMessage()


def test_network_that_a_gpu_cannot_open_runs_on_the_cpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    open_session = onnx_network._session

    def session(path: Path, providers: list[str], threads: int) -> Any:
        if providers[0] == CUDA:
            raise RuntimeError("CUDA failure 2: out of memory")
        return open_session(path, providers, threads)

    monkeypatch.setattr(onnx_network, "providers_of", lambda _: [CUDA, CPU])
    monkeypatch.setattr(onnx_network, "_session", session)
    network = detector(tmp_path)
    assert len(boxes_of(network)) == 3
    assert network.metrics() == {"device_failed": 1, "on_gpu": 0}
    assert "CUDA failure 2: out of memory" in caplog.text


@pytest.mark.parametrize(("error", "reason"), [(0.5, "differ from the CPU"), (np.nan, "are NaN")])
def test_wrong_first_inference_selects_the_cpu(
    tmp_path: Path, sessions: type[GpuSession], error: float, reason: str, caplog
) -> None:
    wanted = boxes_of(detector(tmp_path))
    sessions.error = error
    network = detector(tmp_path)
    assert network.metrics() == {"device_failed": 1, "on_gpu": 0}
    np.testing.assert_array_equal(boxes_of(network), wanted)
    (record,) = caplog.records
    assert reason in record.getMessage()
