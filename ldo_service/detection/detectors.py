"""Detection of objects of known classes by a network of the YOLO family in ONNX."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.errors import ConfigError, ModelError, named
from ldo_service.geometry.boxes import non_maximum_suppression

from .onnx_network import Network, sha256
from .vocabulary import canonical, class_names, read_names
from .yolo import EXPECTED, Letterbox, detect_layout, layout_named


@dataclass(frozen=True, slots=True)
class NetworkConfig:
    """Settings of a detector, which finds objects of known classes in an image."""

    # Layout of the output: yolov5, yolox or yolov8; empty: determined by the shape of the output.
    layout: str = ""
    # File with one class name per line; empty: the registered names of the network, else the
    # names in its metadata, else the 80 names of COCO.
    names: str = ""
    # Width and height of the input, used if the network takes any size.
    input_px: tuple[int, int] = (640, 480)
    score_min: float = 0.25  # Minimum score of a box; the default of YOLOv5 and YOLOX.
    # Maximum IoU of two boxes of one class that are both kept; the default of YOLOv5.
    nms_iou: float = 0.45
    # Maximum boxes per image, the ones with the highest scores; COCO's own evaluation uses 100.
    max_boxes: int = 100
    # Maximum boxes before non-maximum suppression, to bound the time of the suppression.
    max_candidates: int = 1000
    device: str = "cpu"  # Setting `service.device`.
    threads: int = 1  # Threads of one inference; with 1, a replay is bitwise equal.

    def __post_init__(self) -> None:
        if self.layout:
            layout_named(self.layout)
        if not (0 <= self.score_min <= 1 and 0 <= self.nms_iou <= 1):
            raise ConfigError(named(self, "score_min", "nms_iou") + ": both must be in [0, 1].")
        if min(self.max_boxes, self.max_candidates, self.threads, *self.input_px) < 1:
            raise ConfigError(
                named(self, "max_boxes", "max_candidates", "threads", "input_px")
                + ": each must be at least 1."
            )


@dataclass(frozen=True, slots=True)
class Detections:
    """Detections in an image; `OnnxDetector` returns them with the highest score first."""

    # [M, 4] float64, x0, y0, x1, y1; the image of width W covers x from -0.5 to W - 0.5.
    boxes_px: np.ndarray
    scores: np.ndarray  # [M], 0..1.
    class_ids: np.ndarray  # [M], indices into the class names of the network.

    def __len__(self) -> int:
        return len(self.scores)

    def chosen(self, which: np.ndarray | slice) -> "Detections":
        """Return the detections that an index array, a mask or a slice selects."""
        return Detections(self.boxes_px[which], self.scores[which], self.class_ids[which])

    def inside(self) -> "Detections":
        """Return the detections with a positive area.

        Boxes were clipped to the image, so a box outside of the image has no area.
        """
        sides_px = self.boxes_px[:, 2:] - self.boxes_px[:, :2]
        return self.chosen(np.flatnonzero(sides_px.min(axis=1) > 0))

    def best(self, most: int) -> "Detections":
        """Return the `most` detections with the highest scores, the highest first."""
        return self.chosen(np.argsort(-self.scores, kind="stable")[:most])

    def distinct(self, iou_max: float) -> "Detections":
        """Return the detections that remain after non-maximum suppression per class.

        Args:
            iou_max: Maximum IoU of two boxes of one class that both remain.
        """
        return self.chosen(
            non_maximum_suppression(self.boxes_px, self.scores, self.class_ids, iou_max)
        )


class OnnxDetector:
    """Network of the YOLO family as a detector."""

    def __init__(
        self,
        path: Path,
        config: NetworkConfig | None = None,
        names: Sequence[str] = (),
        name: str = "",
    ) -> None:
        """Open a network and run it once on noise.

        Args:
            path: The ONNX file.
            config: Settings.
            names: Class names, unless `config.names` gives a file of names; empty: the names in the
                network's metadata, or the 80 of COCO.
            name: Name of the network in errors and in `identity`; empty: the name of the file.

        Raises:
            ConfigError: If a setting is invalid.
            ModelError: If the file cannot be used as a detector.
        """
        self.config = config or NetworkConfig()
        if self.config.names:
            names = read_names(Path(self.config.names).expanduser())
        try:
            self._network = Network(path, self.config.device, self.config.threads)
            self._input, self.input_px = _image_input(self._network, self.config.input_px)
            output = self._output(_noise(self.input_px))
            self._head = detect_layout(output, self.input_px, self.config.layout)
            metadata = self._network.metadata.get("names")
            self.names = class_names(self._head.class_count, names, metadata)
        except ModelError as error:
            raise ModelError(f"{name or path} cannot be used as a detector: {error}") from error
        self.labels = tuple(map(canonical, self.names))  # Canonical names of the classes.
        # Name and version of the network, for recordings and logs.
        self.identity = f"{name or path.stem} {sha256(path)[:12]}"

    @property
    def layout(self) -> str:
        """Name of the layout of the network's output: yolov5, yolox or yolov8."""
        return self._head.layout.name

    @property
    def providers(self) -> list[str]:
        """Execution providers that the network runs on, by onnxruntime's names, preferred first."""
        return self._network.providers

    def metrics(self) -> dict[str, float]:
        """Return the metrics of the network, see `Network.metrics`."""
        return self._network.metrics()

    def detect(self, image: np.ndarray) -> Detections:
        """Return the objects in an image [H, W, 3] uint8 RGB.

        The same image gives bitwise equal results on the CPU with one thread.

        Raises:
            ModelError: If the network fails.
        """
        config, layout = self.config, self._head.layout
        # Scale and pad the image to the size of the input.
        height, width = image.shape[:2]
        letterbox = Letterbox.fit((width, height), self.input_px, layout.is_centered)
        canvas = letterbox.canvas(image)
        # Run the network.
        pixels = canvas if layout.is_rgb else canvas[..., ::-1]
        output = self._output(_planes(pixels, layout.value_scale))
        # Read the boxes.
        found = self._head.candidates(output, config.score_min)
        boxes_px = letterbox.to_image(found.boxes)
        candidates = Detections(boxes_px, np.clip(found.scores, 0, 1), found.class_ids)
        # Keep one box for each object.
        likely = candidates.inside().best(config.max_candidates)
        return likely.distinct(config.nms_iou).best(config.max_boxes)

    def _output(self, planes: np.ndarray) -> np.ndarray:
        outputs = self._network.run(**{self._input: planes})
        if len(outputs) != 1:
            raise ModelError(
                f"the network has {len(outputs)} outputs. Expected: one output {EXPECTED}. Export "
                "the network with its boxes as the only output."
            )
        return outputs[0]


def _image_input(network: Network, free_px: tuple[int, int]) -> tuple[str, tuple[int, int]]:
    """Return the name of the network's only input, and its width and height.

    Args:
        network: The network.
        free_px: Width and height that are used if the network takes any size.

    Raises:
        ModelError: If the network has other inputs than one image.
    """
    inputs = network.inputs
    shapes = ", ".join(f"{name} {kind} {shape}" for name, kind, shape in inputs)
    name, kind, shape = inputs[0] if len(inputs) == 1 else ("", "", [])
    is_image = kind == "tensor(float)" and len(shape) == 4
    if not is_image or not (_allows(shape[0], 1) and _allows(shape[1], 3)):
        raise ModelError(
            f"the network's inputs are {shapes}. Expected: one image, float32 "
            "[1, 3, height, width]. Export the network with an image as its only input."
        )
    width, height = free_px
    return name, (_side(shape[3], width), _side(shape[2], height))


def _allows(side: int | str | None, length: int) -> bool:
    return not isinstance(side, int) or side == length


def _side(side: int | str | None, free: int) -> int:
    return side if isinstance(side, int) else free


def _noise(size_px: tuple[int, int]) -> np.ndarray:
    width, height = size_px
    return np.random.default_rng(0).random((1, 3, height, width), np.float32)


def _planes(image: np.ndarray, scale: float) -> np.ndarray:
    """Convert an image [H, W, 3] uint8 to float32 planes [1, 3, H, W], multiplied by `scale`."""
    planes = np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32)
    return planes if scale == 1 else planes * np.float32(scale)
