"""Session of an ONNX file: execution providers, inputs, outputs and metadata."""

import hashlib
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, ModelError

log = logging.getLogger(__name__)

SUFFIX = "ExecutionProvider"
CPU = "CPU" + SUFFIX
# Prefix of onnxruntime's error messages.
_SUGAR = re.compile(r"^\[ONNXRuntimeError\] : \d+ : \w+ : (Load model from .*? failed: ?)?")


class Network:
    """Network of an ONNX file, opened in a session of onnxruntime."""

    def __init__(self, path: Path, providers: Sequence[str] = ("cpu",), threads: int = 1) -> None:
        """Open a network.

        Args:
            path: The ONNX file.
            providers: Execution providers by preference, by onnxruntime's names or short names:
                cpu, cuda, tensorrt, openvino. A provider that this machine lacks is ignored with a
                warning. The CPU is added as the last provider unless it is given.
            threads: Threads of one inference; with 1, the CPU gives bitwise equal results in every
                run.

        Raises:
            ConfigError: If onnxruntime has no provider of a given name.
            ModelError: If the file does not exist or is not an ONNX network.
        """
        wanted = available(providers)
        if not path.is_file():
            raise ModelError(f"{path} does not exist. Give the path of an ONNX file.")
        try:
            self._session = _session(path, wanted, threads)
        except Exception as error:  # Errors of onnxruntime have no common base class.
            raise ModelError(
                f"the file is no network in ONNX: {_first_line(error)}. Export the network to ONNX "
                "again."
            ) from error
        if self.providers[0] != wanted[0]:
            log.warning(
                "%s: execution provider %s cannot run this network, which now runs on %s; no "
                "action needed unless it is too slow.",
                path,
                wanted[0],
                self.providers[0],
            )

    @property
    def providers(self) -> list[str]:
        """Execution providers that the network runs on, by onnxruntime's names, preferred first."""
        return list(self._session.get_providers())

    @property
    def inputs(self) -> list[tuple[str, str, list[int | str | None]]]:
        """Name, type and shape of each input; an axis of variable length is a name or None."""
        return [(node.name, node.type, list(node.shape)) for node in self._session.get_inputs()]

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata that the exporter of the network wrote into the file.

        Raises:
            ModelError: If the metadata is not text.
        """
        try:
            return dict(self._session.get_modelmeta().custom_metadata_map)
        except UnicodeDecodeError as error:
            raise ModelError(
                f"the network's metadata is not text: {error}. Export the network again."
            ) from error

    def run(self, **inputs: np.ndarray) -> list[np.ndarray]:
        """Run an inference, and return all outputs in the order of the network.

        Args:
            **inputs: Value of each input, by the input's name.

        Raises:
            ModelError: If the inference fails or an output has NaN or infinity.
        """
        try:
            outputs = [np.asarray(output) for output in self._session.run(None, inputs)]
        except Exception as error:
            raise ModelError(
                f"the inference of the network fails: {_first_line(error)}. Export the network "
                "again."
            ) from error
        if not all(np.isfinite(output).all() for output in outputs):
            raise ModelError(
                "the network yields NaN or infinity, so its weights are damaged: export it again."
            )
        return outputs


def sha256(path: Path) -> str:
    """Return the SHA-256 checksum of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def available(names: Sequence[str]) -> list[str]:
    """Return those of the given execution providers that this machine has.

    Args:
        names: Names of providers, by preference, as onnxruntime's or short names.

    Returns:
        Names of the providers in onnxruntime, in the order of `names`; the CPU is last unless it
        was given.

    Raises:
        ConfigError: If onnxruntime has no provider of a given name.
    """
    import onnxruntime  # Imported in functions only, because the import slows the start of `ldo`.

    wanted = [_full_name(name) for name in names]
    here = onnxruntime.get_available_providers()
    for name in wanted:
        if name not in here:
            log.warning(
                "execution provider %s is missing from the installed onnxruntime, which has %s; "
                "networks run on the other providers. To use the missing one, install a package "
                "such as onnxruntime-gpu.",
                name,
                ", ".join(here),
            )
    found = [name for name in wanted if name in here]
    return list(dict.fromkeys([*found, CPU]))


def _full_name(name: str) -> str:
    """Return onnxruntime's name of a provider, such as CUDAExecutionProvider for cuda."""
    import onnxruntime

    known = {full.removesuffix(SUFFIX).casefold(): full for full in onnxruntime.get_all_providers()}
    short = name.casefold().removesuffix(SUFFIX.casefold())
    if short not in known:
        raise ConfigError(
            f"onnxruntime knows no execution provider {name!r}. Choose from {', '.join(known)}."
        )
    return known[short]


def _session(path: Path, providers: Sequence[str], threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # Log fatal errors only; other errors are raised.
    return onnxruntime.InferenceSession(str(path), options, providers=providers)


def _first_line(error: Exception) -> str:
    """Return the first line of an error without onnxruntime's prefix."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
    return _SUGAR.sub("", line)
