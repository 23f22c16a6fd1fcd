"""Devices in the summary of a run."""

import json
from pathlib import Path

import pytest

from ldo_service import kernels
from ldo_service.commands.options import with_device
from ldo_service.config import Config
from ldo_service.gaussians.optimizer_backend import CpuBackend
from ldo_service.kernels.gpu.arrays import HostArrays
from ldo_service.kernels.gpu.device import DeviceChoice, Gpu
from ldo_service.runs.summary import devices
from ldo_service.tracking.aligner import Aligner
from tests.commands.test_cli import ldo

GPU = {"gpu": "Some GPU", "triton": "3.7.1"}


def test_summary_names_the_gpu_that_an_actor_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.runs.summary.gpu_facts", lambda _: GPU)
    mapper = {"on_gpu": 1.0, "device_failed": 0.0}
    detector = {"on_gpu": 0.0, "device_failed": 1.0}
    assert devices({"tracker": {}, "mapper": mapper, "detector": detector}) == {
        "devices": {"detector": "cpu", "mapper": "cuda"},
        "devices_failed": ["detector"],
        "gpu": GPU,
    }


def test_summary_of_a_run_on_the_cpu_names_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.runs.summary.gpu_facts", lambda _: GPU)
    found = devices({"mapper": {"on_gpu": 0.0, "device_failed": 0.0}})
    assert found == {"devices": {"mapper": "cpu"}, "devices_failed": [], "gpu": {}}


@pytest.mark.parametrize("fails", [False, True])
def test_summary_names_a_gpu_that_failed_during_the_run(
    fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ldo_service.runs.summary.gpu_facts", lambda _: GPU)
    found = devices({"mapper": {"on_gpu": 0.0, "device_failed": float(fails)}})
    assert found["gpu"] == (GPU if fails else {})


def test_run_folder_names_instruction_set_and_gpu(
    capsys, room_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = {"driver": "580.1", "torch": "2.13.0", "triton": "3.7.1"}
    gpu = Gpu("Some GPU", versions, HostArrays())
    choice = DeviceChoice("cuda", "it was chosen.", gpu.name, gpu.versions)
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", lambda: gpu)
    monkeypatch.setattr(  # A stand-in for the GPU computes as the CPU does.
        "ldo_service.gaussians.optimizer.choose_backend",
        lambda _, *settings: (CpuBackend(*settings), choice),
    )
    monkeypatch.setattr("ldo_service.tracking.frame_tracking.choose_aligner", lambda _: Aligner())
    quick = "--set", "mapper.iterations=1", "--max-frames", "3", "--device", "cuda"
    code, _, err = ldo(capsys, "run", room_folder, "--out", tmp_path / "run", *quick)
    assert code == 0, err
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["isa"] == kernels.isa()
    assert summary["devices"] == {"mapper": "cuda", "tracker": "cpu"}
    assert summary["gpu"] == {"gpu": "Some GPU", **versions}
    assert summary["versions"]["ldo-slam"]


def test_option_replaces_the_setting() -> None:
    config = Config()
    assert config.service.device == "cpu"
    assert with_device(config, None) is config
    assert with_device(config, "auto").service.device == "auto"
