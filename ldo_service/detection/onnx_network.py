"""Session of an ONNX file: device, inputs, outputs and metadata."""

import hashlib
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import DeviceError, ModelError

log = logging.getLogger(__name__)

CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
PROVIDERS = {
    "cuda": CUDA,
    "openvino": "OpenVINOExecutionProvider",
}  # Names of onnxruntime.
# Options of execution providers, so that results do not depend on timing: without TF32, and without
# a search for the fastest convolution.
OPTIONS = {CUDA: {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"}}
MEMORY = {CUDA: "cuda"}  # Memory to which inputs and outputs are bound, by execution provider.
# Largest difference between the outputs of GPU and CPU, relative to 1 + |output|. It was
# chosen without a GPU: it is ten times the rounding of half precision, 1e-3.
TOLERANCE = 1e-2
# Prefix of onnxruntime's error messages.
_SUGAR = re.compile(r"^\[ONNXRuntimeError\] : \d+ : \w+ : (Load model from .*? failed: ?)?")


class Network:
    """Network of an ONNX file, opened in a session of onnxruntime.

    The first inference on CUDA is checked: its outputs must agree with those of the CPU. If this
    check fails, or if a device other than the CPU fails in any inference, the CPU repeats the
    inference and runs all later ones.

    Attributes:
        has_failed: True if the CPU replaces another device that was found or requested.
    """

    def __init__(self, path: Path, device: str = "cpu", threads: int = 1) -> None:
        """Open a network.

        Args:
            path: The ONNX file.
            device: Setting `service.device`. With auto, a GPU is used if onnxruntime supports it.
                With cuda or openvino, a missing execution provider causes a warning.
            threads: Threads of one inference; with 1, the CPU gives bitwise equal results in every
                run.

        Raises:
            ModelError: If the file does not exist or is not an ONNX network.
        """
        wanted = providers_of(device)
        self._path, self._threads = path, threads
        if not path.is_file():
            raise ModelError(f"{path} does not exist. Give the path of an ONNX file.")
        self._session = self._open(wanted)
        self._is_tested = False  # The first inference on a GPU has agreed with the CPU.
        self._inputs: dict[str, Any] = {}  # Input buffers in the memory of the device, by name.
        self.has_failed = device in PROVIDERS and wanted[0] != PROVIDERS[device]
        if self.providers[0] != wanted[0]:
            self.has_failed = True
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
    def outputs(self) -> list[str]:
        """Name of each output, in the order of `run`."""
        return [node.name for node in self._session.get_outputs()]

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
            ModelError: If the inference fails, or an output is not numeric or not finite.
        """
        try:
            if self.providers[0] != CPU:
                try:
                    return self._run_on_device(inputs)
                except DeviceError as error:
                    self._continue_on_cpu(error)
            outputs = [np.asarray(output) for output in self._session.run(None, inputs)]
        except Exception as error:
            raise ModelError(
                f"the inference of the network fails: {_first_line(error)}. Export the network "
                "again."
            ) from error
        if any(output.dtype.kind not in "biuf" for output in outputs):
            raise ModelError(
                "the network yields something else than numbers: export it without outputs of text."
            )
        if not all(np.isfinite(output).all() for output in outputs):
            raise ModelError(
                "the network yields NaN or infinity, so its weights are damaged: export it again."
            )
        return outputs

    def metrics(self) -> dict[str, float]:
        """Return `device_failed` (1: the CPU replaces another device) and `on_gpu` (1: CUDA)."""
        on_gpu = self.providers[0] == CUDA
        return {"device_failed": float(self.has_failed), "on_gpu": float(on_gpu)}

    def _open(self, wanted: Sequence[str]) -> Any:
        """Open a session on the first execution provider that can run the network.

        Raises:
            ModelError: The file is not an ONNX network.
        """
        try:
            try:
                return _session(self._path, wanted, self._threads)
            except Exception:  # Errors of onnxruntime have no common base class.
                if wanted[0] == CPU:
                    raise
                # The device may be the cause, for example because its memory is full.
                session = _session(self._path, [CPU], self._threads)
                log.warning("%s: %s cannot open it.", self._path, wanted[0], exc_info=True)
                return session
        except Exception as error:
            raise ModelError(
                f"the file is no network in ONNX: {_first_line(error)}. Export the network to ONNX "
                "again."
            ) from error

    def _bound_run(self, inputs: dict[str, np.ndarray], memory: str) -> list[np.ndarray]:
        """Run an inference with inputs and outputs bound to the memory of the device."""
        from onnxruntime import OrtValue

        binding = self._session.io_binding()
        for name, values in inputs.items():
            buffer = self._inputs.get(name)
            if buffer is None or buffer.shape() != list(values.shape):
                buffer = OrtValue.ortvalue_from_shape_and_type(values.shape, values.dtype, memory)
                self._inputs[name] = buffer
            buffer.update_inplace(np.ascontiguousarray(values))
            binding.bind_ortvalue_input(name, buffer)
        for output in self._session.get_outputs():
            binding.bind_output(output.name, memory)
        self._session.run_with_iobinding(binding)
        return [np.asarray(output) for output in binding.copy_outputs_to_cpu()]

    def _run_on_device(self, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Run an inference on another device than the CPU.

        Raises:
            DeviceError: The device fails, or its results are wrong.
        """
        memory = MEMORY.get(self.providers[0])
        try:
            outputs = self._bound_run(inputs, memory) if memory else self._session.run(None, inputs)
        except Exception as error:
            raise DeviceError(f"the inference fails: {_first_line(error)}.") from error
        if not all(np.isfinite(output).all() for output in outputs):
            raise DeviceError("the outputs are NaN or infinity.")
        if self.providers[0] == CUDA and not self._is_tested:
            wanted = _session(self._path, [CPU], self._threads).run(None, inputs)
            for output, expected in zip(outputs, wanted, strict=True):
                # The number of boxes may differ if the network contains the suppression.
                if output.shape != expected.shape or not np.allclose(
                    output, expected, rtol=TOLERANCE, atol=TOLERANCE
                ):
                    raise DeviceError("the outputs of the first inference differ from the CPU's.")
            self._is_tested = True
        return outputs

    def _continue_on_cpu(self, error: DeviceError) -> None:
        log.warning(
            "%s: %s cannot run this network: %s The CPU repeats the inference and runs all later "
            "ones. Restart the service to use the device again.",
            self._path,
            self.providers[0],
            error,
            exc_info=error.__cause__,
        )
        self._session, self.has_failed = _session(self._path, [CPU], self._threads), True
        self._inputs.clear()


def sha256(path: Path) -> str:
    """Return the SHA-256 checksum of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def providers_of(device: str) -> list[str]:
    """Return the execution providers for a device, the preferred one first.

    Providers that the installed onnxruntime lacks are omitted.

    Args:
        device: Setting `service.device`.

    Returns:
        Names of the providers in onnxruntime; the last one is that of the CPU.
    """
    import onnxruntime  # Imported in functions only, because the import slows the start of `ldo`.

    here = onnxruntime.get_available_providers()
    wanted = PROVIDERS.get("cuda" if device == "auto" else device, CPU)
    if wanted in here:
        return list(dict.fromkeys([wanted, CPU]))
    if device != "auto":
        log.warning(
            "service.device=%s: execution provider %s is missing from the installed onnxruntime, "
            "which has %s; networks run on the CPU. To use %s, install onnxruntime-%s instead of "
            "onnxruntime.",
            device,
            wanted,
            ", ".join(here),
            device,
            {"cuda": "gpu"}.get(device, device),
        )
    return [CPU]


def _session(path: Path, providers: Sequence[str], threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # Log fatal errors only; other errors are raised.
    chosen = [(name, OPTIONS.get(name, {})) for name in providers]
    return onnxruntime.InferenceSession(str(path), options, providers=chosen)


def _first_line(error: Exception) -> str:
    """Return the first line of an error without onnxruntime's prefix."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
    return _SUGAR.sub("", line)
