"""LPIPS image distance (Zhang et al., CVPR 2018), computed by a network file of the user."""

from pathlib import Path

import numpy as np

from ldo_service.errors import ConfigError

LAYOUT = (
    "two inputs float32 [1, 3, H, W], RGB in -1..1, and one output with a single number, as "
    "torch.onnx.export writes lpips.LPIPS(net='alex')"
)
OF_EQUAL_IMAGES = 1e-4  # Maximum distance of an image to itself, by which the network is checked.


class Lpips:
    """LPIPS of two images, computed by an ONNX network with the inputs and outputs of `LAYOUT`.

    The network may fix the height and width of the images, or leave them dynamic.

    Raises:
        ConfigError: If the file is not a network with these inputs and outputs. The constructor or
            the first call raises the error.
    """

    def __init__(self, path: Path, *, threads: int = 1) -> None:
        import onnxruntime  # Imported here, so that other commands of `ldo` start faster.

        self.path = path
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # Turns the log off: the exception has the message.
        try:
            if not path.is_file():
                raise FileNotFoundError("the option --lpips must name an existing file")
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # The exceptions of onnxruntime have no common base class.
            raise ConfigError(
                f"--lpips {path} cannot be opened: {_first_line(error)}. Give an ONNX file with "
                f"{LAYOUT}."
            ) from error
        self._names = [node.name for node in self._session.get_inputs()]
        self._require_layout()
        self._is_checked = False

    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the LPIPS distance of two images, each [H, W, 3] in 0..1."""
        if not self._is_checked:
            self._require_distance(a)
            self._is_checked = True
        return self._distance(a, b)

    def _distance(self, a: np.ndarray, b: np.ndarray) -> float:
        feeds = dict(zip(self._names, (_planes(a), _planes(b)), strict=True))
        try:
            out = np.asarray(self._session.run(None, feeds)[0])
        except Exception as error:
            raise ConfigError(
                f"--lpips {self.path} fails on images of {a.shape[1]}x{a.shape[0]} pixels: "
                f"{_first_line(error)}. Export the network with dynamic height and width."
            ) from error
        if out.size != 1:
            raise self._misfit(f"the network output has shape {out.shape}, must be a single number")
        return float(out.item())

    def _require_layout(self) -> None:
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shapes = [node.shape for node in inputs]
        are_images = all(
            node.type == "tensor(float)" and len(node.shape) == 4 and _allows(node.shape[1], 3)
            for node in inputs
        )
        if len(inputs) != 2 or len(outputs) != 1 or not are_images:
            raise self._misfit(
                f"the network has inputs of the shapes {shapes} and {len(outputs)} outputs, but "
                "must have two float32 inputs [1, 3, H, W] and one output"
            )

    def _require_distance(self, image: np.ndarray) -> None:
        itself = self._distance(image, image)
        if not abs(itself) <= OF_EQUAL_IMAGES:
            raise self._misfit(
                f"the LPIPS distance of two equal images is {itself:.3g}, but must be almost 0"
            )

    def _misfit(self, finding: str) -> ConfigError:
        return ConfigError(
            f"--lpips {self.path} is not an LPIPS network: {finding}. Export it again. Expected: "
            f"{LAYOUT}."
        )


def _planes(image: np.ndarray) -> np.ndarray:
    """Return the image as planes [1, 3, H, W] float32 in -1..1."""
    return np.ascontiguousarray(image.transpose(2, 0, 1)[None] * 2 - 1, np.float32)


def _allows(side: int | str | None, length: int) -> bool:
    return not isinstance(side, int) or side == length


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
