"""An ONNX file, opened: which hardware runs it, and what it says of itself."""

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
    """A session of onnxruntime.

    path       the file
    providers  execution providers by preference, as onnxruntime names them or short: cpu, cuda,
               tensorrt, openvino. One that this machine lacks is warned about and left out; the
               CPU is always the last resort.
    threads    of one inference; with 1 the CPU gives the same bits in every run

    Raises ConfigError for a provider that does not exist, ModelError for a file that is no network.
    """

    def __init__(self, path: Path, providers: Sequence[str] = ("cpu",), threads: int = 1) -> None:
        wanted = available(providers)
        if not path.is_file():
            raise ModelError("there is no such file.")
        try:
            self._session = _session(path, wanted, threads)
        except Exception as error:  # onnxruntime has a class per cause, without a common base
            raise ModelError(f"it is no network in ONNX: {_first_line(error)}.") from error
        if self.providers[0] != wanted[0]:
            log.warning("%s runs on %s: %s refuses it", path, self.providers[0], wanted[0])

    @property
    def providers(self) -> list[str]:
        """Those that it runs on, preferred ones first."""
        return list(self._session.get_providers())

    @property
    def inputs(self) -> list[tuple[str, str, list[int | str | None]]]:
        """Name, type and shape of each; a side without a fixed length is a name or None."""
        return [(node.name, node.type, list(node.shape)) for node in self._session.get_inputs()]

    @property
    def metadata(self) -> dict[str, str]:
        """What its exporter wrote beside it. Raises ModelError for what is no text."""
        try:
            return dict(self._session.get_modelmeta().custom_metadata_map)
        except UnicodeDecodeError as error:
            raise ModelError(f"its metadata is no text: {error}.") from error

    def run(self, **inputs: np.ndarray) -> list[np.ndarray]:
        """All outputs. Raises ModelError when the inference fails or yields NaN or infinity."""
        try:
            outputs = [np.asarray(output) for output in self._session.run(None, inputs)]
        except Exception as error:
            raise ModelError(f"its inference fails: {_first_line(error)}.") from error
        if not all(np.isfinite(output).all() for output in outputs):
            raise ModelError("it yields NaN or infinity: its weights are damaged.")
        return outputs


def sha256(path: Path) -> str:
    """Checksum of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def available(names: Sequence[str]) -> list[str]:
    """onnxruntime's names of the providers that this machine has, the CPU last."""
    import onnxruntime  # here and below, because every start of `ldo` would pay for it

    wanted = [_full_name(name) for name in names]
    here = onnxruntime.get_available_providers()
    for name in wanted:
        if name not in here:
            log.warning(
                "this onnxruntime has no %s, only %s: it is left out. `pip install` the variant "
                "of onnxruntime that has it, such as onnxruntime-gpu",
                name,
                ", ".join(here),
            )
    found = [name for name in wanted if name in here]
    return list(dict.fromkeys([*found, CPU]))


def _full_name(name: str) -> str:
    import onnxruntime

    known = {full.removesuffix(SUFFIX).casefold(): full for full in onnxruntime.get_all_providers()}
    short = name.casefold().removesuffix(SUFFIX.casefold())
    if short not in known:
        raise ConfigError(
            f"onnxruntime knows no execution provider {name!r}. It knows {', '.join(known)}."
        )
    return known[short]


def _session(path: Path, providers: Sequence[str], threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # what is wrong is said in the error
    return onnxruntime.InferenceSession(str(path), options, providers=providers)


def _first_line(error: Exception) -> str:
    line = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
    return _SUGAR.sub("", line)
