"""Small ONNX networks that detect red, green or blue squares, in every layout.

A square has 16 pixels in the input and fills a cell of the grid with that stride. Its box is the
cell and its score is the purity of its color. Gray and black are background.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

STRIDES = (8, 16, 32)
SQUARE_STRIDE = 16
COLORS = ("red", "green", "blue")
PURITY = np.array([[1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float32)


@dataclass(frozen=True)
class Squares:
    """Network for squares; `write` makes the file. Most fields make it invalid on purpose."""

    layout: str
    width: int = 128
    height: int = 96
    classes: int = 3
    metadata: str | None = str(dict(enumerate(COLORS)))
    is_decoded: bool = True  # Boxes in pixels; yolox has them as offsets.
    has_nan: bool = False
    has_logits: bool = False
    is_normalized: bool = False  # Boxes in 0..1.
    is_free: bool = False  # Declares no size.
    more_outputs: bool = False
    fails_on_white: bool = False  # Gives NaN where a pixel of the input is 255.

    def write(self, path: Path) -> Path:
        graph = _Graph()
        scores = "scores"
        graph.add("Concat", [self._scores(graph, s) for s in STRIDES], scores, axis=2)
        if self.layout == "yolov8":
            boxes = graph.constant(self.boxes().T[None])
            graph.add("Concat", [boxes, scores], "output", axis=1)
        else:
            boxes = graph.constant(np.hstack((self.boxes(), np.ones((self.count, 1))))[None])
            graph.add("Transpose", [scores], "rows", perm=[0, 2, 1])
            graph.add("Concat", [boxes, "rows"], "output", axis=2)
        onnx.save(self._model(graph), path)
        return path

    def boxes(self) -> np.ndarray:
        """Return boxes [N, 4] in the format of the layout."""
        cells = [self._cells(stride) for stride in STRIDES]
        return np.concatenate(cells).astype(np.float32)

    @property
    def count(self) -> int:
        return len(self.boxes())

    @property
    def _anchors(self) -> int:
        return 3 if self.layout == "yolov5" else 1

    def _cells(self, stride: int) -> np.ndarray:
        columns, rows = self.width // stride, self.height // stride
        boxes = [
            (0.5, 0.5, 0, 0)
            if not self.is_decoded
            else ((c + 0.5) * stride, (r + 0.5) * stride, stride, stride)
            for _ in range(self._anchors)
            for r in range(rows)
            for c in range(columns)
        ]
        size = (self.width, self.height) * 2 if self.is_normalized else 1
        return np.array(boxes) / size

    def _scores(self, graph: "_Graph", stride: int) -> str:
        """Add scores [1, C, N] of a stride and return their name.

        The score is the purity of the mean color of a cell, for the first anchor only.
        """
        weights = np.zeros((self.classes, 3), np.float32)
        if stride == SQUARE_STRIDE:
            weights[:3] = PURITY[:, ::-1] / 255 if self.layout == "yolox" else PURITY
        pooled, pure, clipped, flat = (f"{name}_{stride}" for name in ("mean", "pure", "clip", "f"))
        pooling = {"kernel_shape": [stride, stride], "strides": [stride, stride]}
        graph.add("AveragePool", ["images"], pooled, **pooling)
        graph.add("Conv", [pooled, graph.constant(weights[:, :, None, None])], pure)
        low, high = (-9, 9) if self.has_logits else (0, 1)
        bounds = [graph.constant(np.float32(bound)) for bound in (low, high)]
        graph.add("Clip", [pure, *bounds], clipped)
        if self.has_logits:
            graph.add("Sub", [clipped, graph.constant(np.float32(3))], clipped := f"l_{stride}")
        if self.has_nan:
            graph.add("Log", [clipped], f"log_{stride}")
            clipped = self._times_zero(graph, f"log_{stride}", stride)
        if self.fails_on_white:
            clipped = self._nan_of_white(graph, clipped, stride)
        graph.add("Reshape", [clipped, graph.constant(np.array([1, self.classes, -1]))], flat)
        if self._anchors == 1:
            return flat
        graph.add("Mul", [flat, graph.constant(np.float32(0))], f"zeros_{stride}")
        anchors = [flat, f"zeros_{stride}", f"zeros_{stride}"]
        graph.add("Concat", anchors, f"anchors_{stride}", axis=2)
        return f"anchors_{stride}"

    def _times_zero(self, graph: "_Graph", name: str, stride: int) -> str:
        """Multiply by zero; log(0) * 0 is NaN."""
        graph.add("Mul", [name, graph.constant(np.float32(0))], f"nan_{stride}")
        return f"nan_{stride}"

    def _nan_of_white(self, graph: "_Graph", name: str, stride: int) -> str:
        """Multiply every score by 0 / 0 where the image has a one."""
        graph.add("ReduceMax", ["images"], f"max_{stride}", keepdims=0)
        graph.add("Sub", [graph.constant(np.float32(1)), f"max_{stride}"], f"below_{stride}")
        graph.add("Div", [f"below_{stride}", f"below_{stride}"], f"one_{stride}")
        graph.add("Mul", [name, f"one_{stride}"], f"with_nan_{stride}")
        return f"with_nan_{stride}"

    def _model(self, graph: "_Graph") -> onnx.ModelProto:
        size = ("height", "width") if self.is_free else (self.height, self.width)
        image = helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, *size))
        names = ["output", "scores"] if self.more_outputs else ["output"]
        outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in names]
        proto = helper.make_graph(graph.nodes, "squares", [image], outputs, graph.constants)
        opset = [helper.make_opsetid("", 13)]
        model = helper.make_model(proto, ir_version=8, opset_imports=opset)
        if self.metadata is not None:
            helper.set_model_props(model, {"names": self.metadata})
        return model


class _Graph:
    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def add(self, operator: str, inputs: list[str], output: str, **attributes) -> None:
        self.nodes.append(helper.make_node(operator, inputs, [output], **attributes))

    def constant(self, values: np.ndarray | np.generic) -> str:
        array = np.asarray(values)
        array = array.astype(np.float32) if array.dtype == np.float64 else array
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(array, name))
        return name


SQUARES = {
    "yolov5": Squares("yolov5"),
    "yolox": Squares("yolox", is_decoded=False),
    "yolov8": Squares("yolov8"),
}


def squares_network(layout: str, **fields) -> Squares:
    """Return the network of a layout with changed fields."""
    return replace(SQUARES[layout], **fields)


def squares_image(
    squares: list[tuple[str, int, int, int]], width: int = 128, height: int = 96
) -> np.ndarray:
    """Return a black image [H, W, 3] uint8 RGB with squares: color, left, top, side in pixels."""
    image = np.zeros((height, width, 3), np.uint8)
    for color, left, top, side in squares:
        image[top : top + side, left : left + side, COLORS.index(color)] = 254
    return image
