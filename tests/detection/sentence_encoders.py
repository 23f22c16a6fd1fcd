"""Tiny sentence encoder whose token vectors come from a table."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

# Axes: sitting, lying, music, anything unknown, and one for each other pair of synonyms.
WORDS = {
    name: tuple(np.eye(12)[axis])
    for axis, pair in enumerate(
        [
            ("sit",),
            ("lie",),
            ("piano",),
            (),
            ("bicycle", "bike"),
            ("airplane", "aeroplane"),
            ("cup", "mug"),
            ("refrigerator", "fridge"),
            ("person", "human"),
            ("tv", "television"),
            ("cat", "kitten"),
        ]
    )
    for name in pair
}
WORDS |= {
    "chair": (1, 0.1, *[0] * 10),
    "couch": (0.8, 0.6, *[0] * 10),
    "sofa": (0.8, 0.61, *[0] * 10),
}
SPECIAL = ("[PAD]", "[UNK]", "[CLS]", "[SEP]")


@dataclass(frozen=True)
class TinyEncoder:
    """Network and vocabulary; the fields describe valid variants and defects of the files."""

    inputs: tuple[str, ...] = ("input_ids", "attention_mask", "token_type_ids")
    length: int | str = "L"
    integer: int = TensorProto.INT64
    is_pooled: bool = False  # The output is [1, D], of the name `output`.
    output: str = "last_hidden_state"
    is_text: bool = False  # The output has strings.
    is_constant: bool = False  # Every text gets the same vector.

    def network(self, path: Path) -> Path:
        table = np.zeros((len(SPECIAL) + len(WORDS), 12), np.float32)
        table[0] = 100  # A padding that is not masked changes the result.
        table[1, 3] = 1
        table[len(SPECIAL) :] = tuple(WORDS.values())
        if self.is_constant:
            table[1:] = 1
        nodes = [helper.make_node("Gather", ["table", self.inputs[0]], ["hidden"])]
        if self.is_pooled:
            nodes.append(helper.make_node("ReduceMax", ["hidden"], ["out"], axes=[1], keepdims=0))
        else:
            nodes.append(helper.make_node("Identity", ["hidden"], ["out"]))
        kind = TensorProto.STRING if self.is_text else TensorProto.FLOAT
        nodes.append(helper.make_node("Cast", ["out"], [self.output], to=kind))
        inputs = [
            helper.make_tensor_value_info(name, self.integer, ["N", self.length])
            for name in self.inputs
        ]
        outputs = [helper.make_tensor_value_info(self.output, kind, None)]
        values = [numpy_helper.from_array(table, "table")]
        graph = helper.make_graph(nodes, "tiny", inputs, outputs, values)
        opset = [helper.make_opsetid("", 13)]
        onnx.save(helper.make_model(graph, ir_version=8, opset_imports=opset), path)
        return path


def write_vocabulary(path: Path) -> Path:
    path.write_text("\n".join((*SPECIAL, *WORDS)) + "\n")
    return path
