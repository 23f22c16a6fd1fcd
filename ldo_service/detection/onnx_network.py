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
_SUGAR = re.compile(r"^\[ONNXRuntimeError\] : \d+ : \w+ : (Load model from .*? failed: ?)?")


class Network:
    """Session of onnxruntime."""

    def __init__(self, path: Path, providers: Sequence[str] = ("cpu",), threads: int = 1) -> None:
        """Open a network.

        Args:
            path: The ONNX file.
            providers: Execution providers by preference, as onnxruntime's names or short: cpu,
                cuda, tensorrt, openvino. A provider that this machine lacks is ignored with a
                warning. The CPU always comes last, even if it is not given.
            threads: Threads of one inference; with 1, the CPU gives bitwise equal results in every
                run.

        Raises:
            ConfigError: If onnxruntime knows no provider of a given name.
            ModelError: If the file does not exist or is no network.
        """
        wanted = available(providers)
        if not path.is_file():
            raise ModelError("there is no such file.")
        try:
            self._session = _session(path, wanted, threads)
        except Exception as error:  # Errors of onnxruntime have no common base class.
            raise ModelError(f"it is no network in ONNX: {_first_line(error)}.") from error
        if self.providers[0] != wanted[0]:
            log.warning(
                "%s: execution provider %s is unavailable for this network; running on %s.",
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
            raise ModelError(f"its metadata is not text: {error}.") from error

    def run(self, **inputs: np.ndarray) -> list[np.ndarray]:
        """Return all outputs of an inference.

        Raises:
            ModelError: If the inference fails or an output has NaN or infinity.
        """
        try:
            outputs = [np.asarray(output) for output in self._session.run(None, inputs)]
        except Exception as error:
            raise ModelError(f"its inference fails: {_first_line(error)}.") from error
        if not all(np.isfinite(output).all() for output in outputs):
            raise ModelError("it yields NaN or infinity: its weights are damaged. Export it again.")
        return outputs


def sha256(path: Path) -> str:
    """Return the checksum of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def available(names: Sequence[str]) -> list[str]:
    """Return onnxruntime's names of the providers that this machine has, the CPU last."""
    import onnxruntime  # A local import, here and below: it would slow every start of `ldo`.

    wanted = [_full_name(name) for name in names]
    here = onnxruntime.get_available_providers()
    for name in wanted:
        if name not in here:
            log.warning(
                "execution provider %s is not in this onnxruntime, which has %s; continuing "
                "without it. Install the onnxruntime package with it, such as onnxruntime-gpu.",
                name,
                ", ".join(here),
            )
    found = [name for name in wanted if name in here]
    return list(dict.fromkeys([*found, CPU]))


def _full_name(name: str) -> str:
    """Return onnxruntime's name of a provider."""
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
    options.log_severity_level = 4  # Fatal only: errors are raised.
    return onnxruntime.InferenceSession(str(path), options, providers=providers)


def _first_line(error: Exception) -> str:
    """Return the first line of an error without onnxruntime's prefix."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
    return _SUGAR.sub("", line)
