"""Search for a GPU that the kernels can use, and choice between GPU and CPU."""

import logging
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar

from ldo_service import __version__
from ldo_service.errors import DeviceError, install_command
from ldo_service.kernels import isa

from .arrays import Arrays, TorchArrays
from .benchmark_result import COMMAND, STEPS, BenchmarkResult, result_file, saved_result

log = logging.getLogger(__name__)

Device = Literal["auto", "cpu", "cuda", "openvino"]
Made = TypeVar("Made")
# Lowest compute capability for which `make gpu-check` compiles the kernels, times 10.
MIN_CAPABILITY = 75
DRIVER = Path("/sys/module/nvidia/version")  # Version of the loaded driver.


@dataclass(frozen=True, eq=False, slots=True)
class Gpu:
    """GPU that the kernels can use.

    Attributes:
        name: Model, such as "NVIDIA GeForce RTX 3090".
        versions: Versions of hardware, driver and libraries on which the bits of the results
            depend, by name.
        arrays: Arrays on this GPU.
    """

    name: str
    versions: dict[str, str]
    arrays: Arrays

    @property
    def versions_and_ours(self) -> dict[str, str]:
        """Return `versions` with the version of LDO-SLAM, by which benchmark results are saved."""
        return {**self.versions, "ldo-slam": __version__}

    def benchmark(self) -> BenchmarkResult | None:
        """Return the saved result of `ldo bench --device cuda`; None without one."""
        return saved_result(self.name, self.versions_and_ours)


@dataclass(frozen=True, slots=True)
class DeviceChoice:
    """Device that computes the results of an actor.

    Attributes:
        device: cpu or cuda.
        reason: Sentence that says why this device was chosen.
        name: Instruction set of the CPU, or model of the GPU.
        versions: Versions of hardware, driver and libraries on which the bits of the results
            depend; empty on the CPU.
        has_failed: True if the CPU is used although a GPU was found or requested.
    """

    device: str
    reason: str
    name: str
    versions: dict[str, str] = field(default_factory=dict)
    has_failed: bool = False

    def failed(self, error: DeviceError) -> "DeviceChoice":
        """Return the choice that replaces a failed GPU by the CPU."""
        return replace(on_cpu(f"the GPU {self.name} failed: {error}"), has_failed=True)

    def metrics(self) -> dict[str, float]:
        """Return `device_failed` (1 if the CPU replaces a GPU) and `on_gpu` (1 on a GPU)."""
        return {"device_failed": float(self.has_failed), "on_gpu": float(self.device == "cuda")}


def on_cpu(reason: str) -> DeviceChoice:
    """Return the `DeviceChoice` that selects the CPU for the given reason."""
    return DeviceChoice("cpu", reason, isa())


def choose_device(
    wanted: str, actor: str, work: str, make: Callable[[Arrays], Made]
) -> tuple[Made | None, DeviceChoice]:
    """Choose a device: a GPU if it passes a self-test, otherwise the CPU.

    The setting auto also requires a saved benchmark in which this GPU passed and was faster than
    the CPU. The speed is not measured at the start, because the choice, and with it the bits of the
    results, could then change from start to start.

    Args:
        wanted: Setting `service.device`. A missing GPU counts as a failure with cuda, but not with
            auto.
        actor: Actor that uses the device, for the log.
        work: What the device does, such as "the map is fitted", for the log.
        make: Function that runs the self-test on a GPU and returns the object that computes on this
            GPU.

    Returns:
        The result of `make` (None if the CPU is chosen), and the choice.
    """
    if wanted not in ("auto", "cuda"):
        return None, on_cpu(f"service.device={wanted} was chosen.")
    try:
        gpu = find_gpu()
    except DeviceError as error:
        choice = replace(on_cpu(str(error)), has_failed=wanted == "cuda")
        if choice.has_failed:
            log.warning("%s: no GPU can be used, so %s on the CPU: %s", actor, work, error)
        return None, choice
    is_faster, measured = _judged(gpu, actor)
    if wanted == "auto" and not is_faster:
        return None, on_cpu(measured)
    try:
        with device_errors("self-test"):
            made = make(gpu.arrays)
    except DeviceError as error:
        choice = DeviceChoice("cuda", "", gpu.name).failed(error)
        log.warning(
            "%s: %s %s on the CPU.",
            actor,
            choice.reason,
            work[0].upper() + work[1:],
            exc_info=error.__cause__,
        )
        return None, choice
    reason = f"the GPU passed the self-test. {measured}"
    log.info("%s: %s on %s: %s", actor, work, gpu.name, reason)
    return made, DeviceChoice("cuda", reason, gpu.name, gpu.versions)


def _judged(gpu: Gpu, actor: str) -> tuple[bool, str]:
    """Return whether a saved benchmark says that the GPU is faster, and a sentence about it."""
    result = gpu.benchmark()
    if result is None:
        return False, (
            f"{COMMAND} has not run on {gpu.name} with these versions yet (no result in "
            f"{result_file()}), so the GPU is experimental."
        )
    return result.is_faster(actor), result.text(actor)


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

    torch, Triton and the driver raise errors of several classes, without a common base class.
    Therefore all exceptions are converted, including those of programming errors. Callers log the
    traceback of the cause, so that a programming error stays visible.

    Args:
        what: Name of the operation in the block, for the error text.

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
            f"the GPU {name} has compute capability {major}.{minor}, but the kernels need "
            f"at least {MIN_CAPABILITY / 10:.1f}. Use another GPU, or set service.device=cpu."
        )
    found = {
        "compute capability": f"{major}.{minor}",
        "driver": _driver_version(),
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
        Facts by name; empty if only the CPU is used, or if torch finds no GPU. With auto, the facts
        include the device that the saved benchmark selects for mapper and tracker.
    """
    if device not in ("auto", "cuda"):
        return {}
    try:
        gpu = find_gpu()
    except DeviceError:
        return {}
    facts = {"gpu": gpu.name, **gpu.versions}
    if device == "auto":
        facts |= {actor: "cuda" if _judged(gpu, actor)[0] else "cpu" for actor in STEPS}
    return facts


def _driver_version() -> str:
    """Return the version of the driver of NVIDIA; "unknown" where the system does not state it."""
    try:
        return DRIVER.read_text().strip()
    except OSError:
        return "unknown"


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except (ImportError, OSError) as error:  # OSError: a shared library of CUDA is missing.
        raise DeviceError(
            f"{name} cannot be imported ({error}). Run {install_command('cuda')}."
        ) from error
