"""Search for a GPU that the kernels can use."""

import platform
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
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
    torch, triton = _library("torch"), _library("triton")
    with device_errors("search for a GPU"):
        return _found(torch, triton)


@contextmanager
def device_errors(what: str) -> Iterator[None]:
    """Convert errors in a `with` block to DeviceError.

    torch, Triton and the driver raise errors of several classes, without a common base class. An
    error of this program is converted too. Callers therefore log the traceback of the cause.

    Args:
        what: What the block does, for the error text.

    Raises:
        DeviceError: The block raised an error.
    """
    try:
        yield
    except DeviceError:
        raise
    except Exception as error:
        line = (str(error).strip().splitlines() or [""])[0].rstrip(".")
        raise DeviceError(
            f"the {what} failed with {type(error).__name__}: {line}. If memory is short, reduce "
            "mapper.offload.max_resident_gaussians."
        ) from error


def _found(torch: Any, triton: Any) -> Gpu:
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
        "triton": str(triton.__version__),
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
