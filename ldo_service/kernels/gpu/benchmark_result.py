"""Saved results of `ldo bench --device cuda`, by which `service.device=auto` chooses a device.

The file gpu.json in the user's cache folder has one result per GPU model and set of versions.
"""

import logging
from pathlib import Path

import msgspec

from ldo_service.errors import ConfigError
from ldo_service.storage.atomic_write import write_atomically
from ldo_service.storage.cache_folder import cache_root

log = logging.getLogger(__name__)

COMMAND = "`ldo bench --device cuda`"
STEPS = {"mapper": "iteration", "tracker": "alignment"}  # Measured step that decides, by actor.


class BenchmarkResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of `ldo bench --device cuda` on one GPU."""

    gpu: str  # Model of the GPU.
    versions: dict[str, str]  # Versions of driver, libraries and LDO-SLAM.
    scene: str  # Size of the measured scene, and threads of the CPU.
    error: str = ""  # Reason for which nothing was measured; empty if the GPU passed.
    cpu_ms: dict[str, float] = {}  # Median time on the CPU by step.
    gpu_ms: dict[str, float] = {}  # Median time on the GPU by step.

    @property
    def has_passed(self) -> bool:
        """Return whether the results of the GPU agreed with those of the CPU."""
        return not self.error

    def is_faster(self, actor: str) -> bool:
        """Return whether the GPU has passed, and was faster in the step of the given actor."""
        step = STEPS[actor]
        nothing = float("inf")
        return self.has_passed and self.gpu_ms.get(step, nothing) < self.cpu_ms.get(step, nothing)

    def text(self, actor: str) -> str:
        """Return a sentence that states the result for the given actor."""
        if self.error:
            return f"{COMMAND} failed on {self.gpu}: {self.error}"
        step = STEPS[actor]
        if not {step} <= self.gpu_ms.keys() & self.cpu_ms.keys():
            return f"{COMMAND} has not measured the {step} on {self.gpu}."
        return (
            f"{COMMAND} measured {self.gpu_ms[step]:.2f} ms per {step} on {self.gpu}, and "
            f"{self.cpu_ms[step]:.2f} ms on the CPU ({self.scene})."
        )


def result_file() -> Path:
    """Return the path of the file with all results."""
    return cache_root() / "gpu.json"


def saved_result(gpu: str, versions: dict[str, str]) -> BenchmarkResult | None:
    """Return the saved result of a GPU; None if it was not measured with these versions."""
    for result in _saved():
        if (result.gpu, result.versions) == (gpu, versions):
            return result
    return None


def save_result(result: BenchmarkResult) -> None:
    """Save a result in place of an earlier one of the same GPU and versions.

    Raises:
        ConfigError: The file cannot be written.
    """
    same = result.gpu, result.versions
    kept = [other for other in _saved() if (other.gpu, other.versions) != same]
    path = result_file()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        content = msgspec.json.format(msgspec.json.encode([*kept, result]))
        write_atomically(path, content + b"\n", unique=True)
        path.chmod(0o644)  # The service may run as another user.
    except OSError as error:
        raise ConfigError(
            f"the result cannot be written to {path}: {error.strerror}. Set LDO_CACHE to another "
            "folder, for the service too."
        ) from error


def _saved() -> list[BenchmarkResult]:
    path = result_file()
    try:
        return msgspec.json.decode(path.read_bytes(), type=list[BenchmarkResult])
    except FileNotFoundError:
        return []
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as error:
        log.warning(
            "%s cannot be read: %s. Make it readable for the user of the service, or delete it and "
            "run %s again.", path, error, COMMAND,
        )  # fmt: skip
        return []
