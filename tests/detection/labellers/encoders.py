"""Tiny pair of ONNX encoders that embed images and texts in color space.

The embedding of an image is its mean color; that of a text is the sum of the colors it names.
"""

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

COLORS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1)}
MERGES = ("r e", "re d</w>", "g re", "gre e", "gree n</w>", "b l", "bl u", "blu e</w>")
CONTEXT = 16
SCALE = 20.0


@dataclass(frozen=True)
class ColorPair:
    """Pair of encoders; the fields describe valid variants and defects of the files."""

    side: int | str = 32
    channels: int = 3
    image_metadata: tuple[tuple[str, str], ...] = (
        ("mean", "[0, 0, 0]"),
        ("std", "1, 1, 1"),
        ("logit_scale", str(SCALE)),
    )
    image_dimensions: int = 3
    fails_on_white: bool = False
    has_hidden_state: bool = True
    has_mask: bool = True
    integer: int = TensorProto.INT64

    def image(self, path: Path) -> Path:
        weights = np.eye(self.channels, self.image_dimensions, dtype=np.float32)
        nodes = [
            helper.make_node("ReduceMean", ["pixels"], ["mean"], axes=[2, 3], keepdims=0),
            helper.make_node("MatMul", ["mean", "weights"], ["embedding"]),
        ]
        if self.fails_on_white:  # Division of zero by zero.
            nodes[-1] = helper.make_node("MatMul", ["mean", "weights"], ["color"])
            nodes += [
                helper.make_node("ReduceMin", ["color"], ["least"], axes=[1], keepdims=1),
                helper.make_node("Sub", ["one", "least"], ["below"]),
                helper.make_node("Div", ["below", "below"], ["unity"]),
                helper.make_node("Mul", ["color", "unity"], ["embedding"]),
            ]
        shape = ["N", self.channels, self.side, self.side]
        pixels = helper.make_tensor_value_info("pixels", TensorProto.FLOAT, shape)
        constants = {"weights": weights, "one": np.ones((1, 1), np.float32)}
        model = _model(nodes, [pixels], ["embedding"], constants)
        helper.set_model_props(model, dict(self.image_metadata))
        onnx.save(model, path)
        return path

    def text(self, path: Path) -> Path:
        table = np.full((512 + len(MERGES) + 2, 3), 0.001, np.float32)
        for color, position in COLORS.items():
            table[_token(color)] = position
        nodes = [
            helper.make_node("Gather", ["table", "tokens"], ["hidden"]),
            helper.make_node("ReduceSum", ["hidden", "along"], ["embedding"], keepdims=0),
        ]
        inputs = [helper.make_tensor_value_info("tokens", self.integer, ["N", CONTEXT])]
        if self.has_mask:
            mask = helper.make_tensor_value_info("attention_mask", self.integer, ["N", CONTEXT])
            inputs.append(mask)
        outputs = ["hidden", "embedding"] if self.has_hidden_state else ["embedding"]
        constants = {"table": table, "along": np.array([1])}
        onnx.save(_model(nodes, inputs, outputs, constants), path)
        return path


def vocabulary(path: Path, merges: tuple[str, ...] = MERGES) -> Path:
    with gzip.open(path, "wt", encoding="utf-8") as file:
        file.write("\n".join(("#version: of a test", *merges)) + "\n")
    return path


def embeddings(path: Path, **arrays: np.ndarray) -> Path:
    """Write embeddings of the colors; `arrays` replace or extend the arrays of the file."""
    rows = np.array([np.multiply(COLORS[name], 7.0) for name in COLORS], np.float32)
    np.savez(path, **{"names": np.array(tuple(COLORS)), "embeddings": rows, **arrays})
    return path


def plain_image(color: str, height: int = 20, width: int = 30, level: int = 255) -> np.ndarray:
    """Return a uniform image [height, width, 3] uint8 RGB."""
    image = np.zeros((height, width, 3), np.uint8)
    image[:] = np.multiply(COLORS[color], level)
    return image


def _token(color: str) -> int:
    """Return the token of the merge that completes the word."""
    ends = ["".join(merge.split()) for merge in MERGES]
    return 512 + ends.index(color + "</w>")


def _model(nodes, inputs, outputs, constants) -> onnx.ModelProto:
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
    initializers = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "colors", inputs, values, initializers)
    opset = [helper.make_opsetid("", 13)]
    return helper.make_model(graph, ir_version=8, opset_imports=opset)
