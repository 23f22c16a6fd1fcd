"""Objects of known classes in an image, by a network of the YOLO family in ONNX."""

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
    """How a detector is read and run."""

    layout: str = ""  # yolov5, yolox, yolov8; empty: recognised by the shape of its output
    names: str = ""  # file with a class a line; empty: those it was registered with or carries, or
    # the 80 of COCO
    input_px: tuple[int, int] = (640, 480)  # width, height for a network that takes any
    score_min: float = 0.25  # of a box to be told; YOLOv5's and YOLOX's own default
    nms_iou: float = 0.45  # boxes of a class that overlap more are one object; YOLOv5
    max_boxes: int = 100  # in an image, the most certain; what COCO's own evaluation counts
    max_candidates: int = 1000  # before overlapping boxes are dropped: bounds the time
    providers: tuple[str, ...] = ("cpu",)  # of onnxruntime, by preference: cuda, tensorrt, ...
    threads: int = 1  # of one inference; with 1 a replay gives the same bits

    def __post_init__(self) -> None:
        if self.layout:
            layout_named(self.layout)
        if not (0 <= self.score_min <= 1 and 0 <= self.nms_iou <= 1):
            raise ConfigError(named(self, "score_min", "nms_iou") + ": both must be within 0..1.")
        if min(self.max_boxes, self.max_candidates, self.threads, *self.input_px) < 1:
            raise ConfigError(
                named(self, "max_boxes", "max_candidates", "threads", "input_px")
                + ": each must be at least 1."
            )


@dataclass(frozen=True, slots=True)
class Detections:
    """Boxes in an image; what is found is told with the most certain first."""

    boxes_px: np.ndarray  # [M, 4] float64: x0, y0, x1, y1; the whole image is -0.5 .. W - 0.5
    scores: np.ndarray  # [M] 0..1
    class_ids: np.ndarray  # [M] index into the class names of the network

    def __len__(self) -> int:
        return len(self.scores)

    def chosen(self, which: np.ndarray | slice) -> "Detections":
        return Detections(self.boxes_px[which], self.scores[which], self.class_ids[which])

    def inside(self) -> "Detections":
        """Those with anything of them in the image; boxes are clipped to it."""
        sides_px = self.boxes_px[:, 2:] - self.boxes_px[:, :2]
        return self.chosen(np.flatnonzero(sides_px.min(axis=1) > 0))

    def best(self, most: int) -> "Detections":
        return self.chosen(np.argsort(-self.scores, kind="stable")[:most])

    def distinct(self, iou_max: float) -> "Detections":
        return self.chosen(
            non_maximum_suppression(self.boxes_px, self.scores, self.class_ids, iou_max)
        )


class OnnxDetector:
    """A network that is known to be a detector: opening it runs it once, on noise.

    path    the ONNX file
    config  see there
    names   of its classes, unless `config.names` has others; empty: those it carries, or the 80 of
            COCO
    name    what errors and `identity` call it; empty: the file

    Raises ConfigError for settings that cannot be, ModelError for a file that is no such network.
    """

    def __init__(
        self,
        path: Path,
        config: NetworkConfig | None = None,
        names: Sequence[str] = (),
        name: str = "",
    ) -> None:
        self.config = config or NetworkConfig()
        if self.config.names:
            names = read_names(Path(self.config.names).expanduser())
        try:
            self._network = Network(path, self.config.providers, self.config.threads)
            self._input, self.input_px = _image_input(self._network, self.config.input_px)
            output = self._output(_noise(self.input_px))
            self._head = detect_layout(output, self.input_px, self.config.layout)
            metadata = self._network.metadata.get("names")
            self.names = class_names(self._head.class_count, names, metadata)
        except ModelError as error:
            raise ModelError(f"{name or path} cannot be used as a detector: {error}") from error
        self.labels = tuple(map(canonical, self.names))  # what a vocabulary calls them
        self.identity = f"{name or path.stem} {sha256(path)[:12]}"  # which network it was

    @property
    def layout(self) -> str:
        return self._head.layout.name

    @property
    def providers(self) -> list[str]:
        """What it runs on, as onnxruntime names it."""
        return self._network.providers

    def detect(self, image: np.ndarray) -> Detections:
        """The objects in an image [H, W, 3] uint8 RGB.

        The same image gives the same bits on the CPU with one thread. Raises ModelError when the
        network fails.
        """
        config, layout = self.config, self._head.layout
        # fit it into the input
        height, width = image.shape[:2]
        letterbox = Letterbox.fit((width, height), self.input_px, layout.is_centered)
        canvas = letterbox.canvas(image)
        # run the network
        pixels = canvas if layout.is_rgb else canvas[..., ::-1]
        output = self._output(_planes(pixels, layout.value_scale))
        # read the boxes
        found = self._head.candidates(output, config.score_min)
        boxes_px = letterbox.to_image(found.boxes)
        candidates = Detections(boxes_px, np.clip(found.scores, 0, 1), found.class_ids)
        # keep one for each object
        likely = candidates.inside().best(config.max_candidates)
        return likely.distinct(config.nms_iou).best(config.max_boxes)

    def _output(self, planes: np.ndarray) -> np.ndarray:
        outputs = self._network.run(**{self._input: planes})
        if len(outputs) != 1:
            raise ModelError(f"it has {len(outputs)} outputs. Expected: one, {EXPECTED}.")
        return outputs[0]


def _image_input(network: Network, free_px: tuple[int, int]) -> tuple[str, tuple[int, int]]:
    """Name, width and height of the input; `free_px` where the network takes any size."""
    inputs = network.inputs
    shapes = ", ".join(f"{name} {kind} {shape}" for name, kind, shape in inputs)
    name, kind, shape = inputs[0] if len(inputs) == 1 else ("", "", [])
    is_image = kind == "tensor(float)" and len(shape) == 4
    if not is_image or not (_allows(shape[0], 1) and _allows(shape[1], 3)):
        raise ModelError(
            f"its inputs are {shapes}. Expected: one image, float32 [1, 3, height, width]."
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
    """[1, 3, H, W] float32"""
    planes = np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32)
    return planes if scale == 1 else planes * np.float32(scale)
