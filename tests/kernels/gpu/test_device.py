"""Search for a GPU, with a stand-in for torch."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from ldo_service.errors import DeviceError
from ldo_service.kernels.gpu import device
from ldo_service.kernels.gpu.device import find_gpu, gpu_facts


@pytest.fixture
def torch(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Install stand-ins for torch and Triton, with one GPU."""
    cuda = SimpleNamespace(
        is_available=lambda: True,
        get_device_name=lambda _: "Some GPU",
        get_device_capability=lambda _: (8, 6),
    )
    torch = SimpleNamespace(__version__="2.13.0", version=SimpleNamespace(cuda="12.8"), cuda=cuda)
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__="3.7.1"))
    return torch


@pytest.mark.usefixtures("torch")
def test_gpu_has_model_and_versions() -> None:
    gpu = find_gpu()
    assert gpu.name == "Some GPU"
    assert gpu.versions["torch"] == "2.13.0"
    assert gpu.versions["triton"] == "3.7.1"
    assert gpu.versions["compute capability"] == "8.6"
    assert gpu_facts("cuda") == {"gpu": "Some GPU", **gpu.versions}
    assert gpu_facts("cpu") == {}


@pytest.mark.usefixtures("torch")
def test_version_of_the_driver_is_that_of_the_loaded_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "DRIVER", tmp_path / "version")
    assert find_gpu().versions["driver"] == "unknown"
    (tmp_path / "version").write_text("580.65.06\n")
    assert find_gpu().versions["driver"] == "580.65.06"


def test_missing_gpu_is_an_error(torch: SimpleNamespace) -> None:
    torch.cuda.is_available = lambda: False
    with pytest.raises(DeviceError, match=r"finds no GPU.*nvidia-smi"):
        find_gpu()
    assert gpu_facts("cuda") == {}


def test_old_gpu_is_an_error(torch: SimpleNamespace) -> None:
    torch.cuda.get_device_capability = lambda _: (6, 1)
    with pytest.raises(DeviceError, match=r"capability 6.1, but the kernels need at least 7.5"):
        find_gpu()


def test_error_of_the_driver_is_a_device_error(torch: SimpleNamespace) -> None:
    def fail(_: int) -> str:
        raise RuntimeError("CUDA error: unknown error\nCompile with TORCH_USE_CUDA_DSA.")

    torch.cuda.get_device_name = fail
    with pytest.raises(DeviceError, match=r"search for a GPU failed with RuntimeError: CUDA error"):
        find_gpu()
    assert gpu_facts("cuda") == {}


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize("missing", ["torch", "triton"])
def test_missing_library_is_an_error(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(DeviceError, match=rf"{missing} cannot be imported.*\[cuda\]"):
        find_gpu()
