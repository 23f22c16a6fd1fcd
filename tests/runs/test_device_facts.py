"""Devices in the summary of a run."""

import pytest

from ldo_service.commands.options import with_device
from ldo_service.config import Config
from ldo_service.runs.summary import devices

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


def test_option_replaces_the_setting() -> None:
    config = Config()
    assert config.service.device == "cpu"
    assert with_device(config, None) is config
    assert with_device(config, "auto").service.device == "auto"
