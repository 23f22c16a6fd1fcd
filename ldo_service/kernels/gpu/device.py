"""Search for a GPU that the kernels can use."""

import platform
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from typing import Any

from ldo_service.errors import DeviceError, install_command

from .arrays import Arrays, TorchArrays

# Lowest compute capability for which `make gpu-check` compiles the kernels, times 10.
MIN_CAPABILITY = 75


@dataclass(frozen=True, eq=False, slots=True)
class Gpu:
    """A GPU.

    Attributes:
        name: Model, such as "NVIDIA GeForce RTX 3090".
        versions: Versions that determine the bits of the results, by name.
        arrays: Arrays on this GPU.
    """

    name: str
    versions: dict[str, str]
    arrays: Arrays


def find_gpu() -> Gpu:
    """Return the first GPU of this machine.

    Raises:
        DeviceError: There is no GPU, or a library that the kernels need is missing.
    """
    torch = _library("torch")
    _library("triton")
    if not torch.cuda.is_available():
        raise DeviceError(
            f"torch {torch.__version__} finds no GPU. Check that `nvidia-smi` lists one, and that "
            "torch is a build for CUDA."
        )
    name, (major, minor) = torch.cuda.get_device_name(0), torch.cuda.get_device_capability(0)
    if 10 * major + minor < MIN_CAPABILITY:
        raise DeviceError(
            f"the GPU {name} has compute capability {major}.{minor}, and the kernels need "
            f"{MIN_CAPABILITY / 10:.1f}. Use the CPU."
        )
    found = {
        "compute capability": f"{major}.{minor}",
        "cuda": str(torch.version.cuda),
        "torch": str(torch.__version__),
        "triton": version("triton"),
        "machine": platform.machine(),
    }
    return Gpu(name, found, TorchArrays("cuda"))


def gpu_facts(device: str) -> dict[str, str]:
    """Return model and versions of the GPU that computes results, for runs and recordings.

    Args:
        device: Setting `service.device`.

    Returns:
        Facts by name; empty if only the CPU is used, or if torch finds no GPU.
    """
    if device not in ("auto", "cuda"):
        return {}
    try:
        gpu = find_gpu()
    except DeviceError:
        return {}
    return {"gpu": gpu.name, **gpu.versions}


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except (ImportError, OSError) as error:  # OSError: a shared library of CUDA is missing.
        raise DeviceError(
            f"{name} cannot be imported ({error}). Run {install_command('cuda')}."
        ) from error
