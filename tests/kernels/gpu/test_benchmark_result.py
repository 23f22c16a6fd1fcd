"""Saved results of `ldo bench --device cuda`, and the choice of `service.device=auto` by them."""

from pathlib import Path

import msgspec
import pytest

from ldo_service.errors import ConfigError
from ldo_service.kernels.gpu import device
from ldo_service.kernels.gpu.arrays import HostArrays
from ldo_service.kernels.gpu.benchmark_result import (
    BenchmarkResult,
    result_file,
    save_result,
    saved_result,
)
from ldo_service.kernels.gpu.device import Gpu, choose_device, gpu_facts

GPU = Gpu("Some GPU", {"torch": "2.13.0", "driver": "580.1"}, HostArrays())
FASTER = BenchmarkResult(
    gpu=GPU.name,
    versions=GPU.versions_and_ours,
    scene="640x480 pixels",
    cpu_ms={"iteration": 20.0, "alignment": 5.0},
    gpu_ms={"iteration": 2.0, "alignment": 6.0},  # The CPU aligns faster.
)
FAILED = msgspec.structs.replace(FASTER, error="the loss differs.", cpu_ms={}, gpu_ms={})
WORK = {"mapper": "the map is fitted", "tracker": "frames are aligned"}


@pytest.fixture(autouse=True)
def _one_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Find GPU on this machine, and save results in a new folder."""
    monkeypatch.setenv("LDO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(device, "find_gpu", lambda: GPU)


def chosen(wanted: str, actor: str) -> device.DeviceChoice:
    made, choice = choose_device(wanted, actor, WORK[actor], lambda _: "on the GPU")
    assert made == (None if choice.device == "cpu" else "on the GPU")
    assert not choice.has_failed
    return choice


def test_auto_uses_the_gpu_for_the_actors_that_it_makes_faster() -> None:
    save_result(FASTER)
    mapper, tracker = chosen("auto", "mapper"), chosen("auto", "tracker")
    assert (mapper.device, mapper.name, mapper.versions) == ("cuda", "Some GPU", GPU.versions)
    assert mapper.reason == (
        "the GPU passed the self-test. `ldo bench --device cuda` measured 2.00 ms per iteration on "
        "Some GPU, and 20.00 ms on the CPU (640x480 pixels)."
    )
    assert tracker.device == "cpu"
    assert "measured 6.00 ms per alignment on Some GPU, and 5.00 ms on the CPU" in tracker.reason


def test_auto_uses_the_cpu_if_the_benchmark_failed() -> None:
    save_result(FASTER)
    save_result(FAILED)
    for actor in WORK:
        choice = chosen("auto", actor)
        assert choice.device == "cpu"
        assert choice.reason == "`ldo bench --device cuda` failed on Some GPU: the loss differs."


@pytest.mark.parametrize(
    "other",
    [
        None,
        {"gpu": "Another GPU"},
        {"versions": {**GPU.versions_and_ours, "driver": "590.1"}},
        {"versions": {**GPU.versions_and_ours, "ldo-slam": "0.0.1"}},
    ],
)
def test_auto_uses_the_cpu_without_a_result_of_this_gpu_and_these_versions(
    other: dict | None,
) -> None:
    if other is not None:
        save_result(msgspec.structs.replace(FASTER, **other))
    choice = chosen("auto", "mapper")
    assert choice.device == "cpu"
    assert "has not run on Some GPU with these versions yet" in choice.reason


def test_cuda_needs_no_result() -> None:
    choice = chosen("cuda", "tracker")
    assert choice.device == "cuda"
    assert choice.reason.startswith("the GPU passed the self-test.")
    assert "so the GPU is experimental" in choice.reason


def test_gpu_that_the_benchmark_does_not_select_is_not_tested() -> None:
    def make(_: object) -> None:
        pytest.fail("the self-test ran")

    assert choose_device("auto", "mapper", WORK["mapper"], make)[0] is None


def test_new_result_replaces_that_of_the_same_gpu_alone() -> None:
    another = msgspec.structs.replace(FASTER, gpu="Another GPU")
    for result in (FASTER, another, FAILED):
        save_result(result)
    assert saved_result(GPU.name, GPU.versions_and_ours) == FAILED
    assert saved_result("Another GPU", GPU.versions_and_ours) == another
    assert len(msgspec.json.decode(result_file().read_bytes())) == 2


def test_damaged_file_counts_as_no_result(caplog: pytest.LogCaptureFixture) -> None:
    save_result(FASTER)
    result_file().write_bytes(result_file().read_bytes()[:-9])
    assert chosen("auto", "mapper").device == "cpu"
    assert "gpu.json cannot be read" in caplog.text
    save_result(FASTER)
    assert chosen("auto", "mapper").device == "cuda"


def test_folder_that_cannot_be_written_is_a_configuration_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("LDO_CACHE", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match=r"gpu\.json: File exists\. Set LDO_CACHE"):
        save_result(FASTER)


def test_facts_of_auto_name_the_device_of_mapper_and_tracker() -> None:
    facts = {"gpu": "Some GPU", **GPU.versions}
    assert gpu_facts("auto") == {**facts, "mapper": "cpu", "tracker": "cpu"}
    save_result(FASTER)
    assert gpu_facts("auto") == {**facts, "mapper": "cuda", "tracker": "cpu"}
    assert gpu_facts("cuda") == facts
