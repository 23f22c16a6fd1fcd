"""Convolutional networks written once and read twice: by JAX to train them, as ONNX to ship them.

A network is a function of a reader and its input. The readers have the same methods; `JaxNetwork`
holds arrays [N, H, W, C], `Graph` names of tensors [1, C, H, W].
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Weights = dict[str, np.ndarray]
Statistics = Mapping[str, tuple[np.ndarray, np.ndarray]]  # mean and variance by layer

EPSILON = 1e-3  # of variances
UNFOLDED_PX = 9  # of an image up to which a product is faster to train than XLA's convolution
OPSET, IR_VERSION = 17, 8  # what onnxruntime 1.18 reads


class JaxNetwork:
    """Arrays. Missing weights are drawn when there is a generator for them.

    weights     by name
    statistics  mean and variance of each normalised layer; without, those of the batch
    observed    mean and variance that this reading saw, of each normalised layer
    """

    def __init__(
        self,
        weights: Mapping,
        statistics: Mapping | None = None,
        rng: np.random.Generator | None = None,
    ) -> None:
        self.weights = dict(weights)
        self.observed: dict = {}
        self._statistics = statistics
        self._rng = rng

    def conv(self, x, name: str, channels: int, stride: int = 1, size: int = 3):
        """Convolution, normalised over the batch, then ReLU."""
        y = self._convolved(x, name, channels, stride, size)
        mean, variance = self._moments(y, name)
        gain = self._weight(f"{name}.gain", np.ones(channels))
        bias = self._weight(f"{name}.bias", np.zeros(channels))
        return jax.nn.relu((y - mean) * (gain * jax.lax.rsqrt(variance + EPSILON)) + bias)

    def linear(self, x, name: str, channels: int, bias: float = 0.0):
        """A convolution of one pixel as it is: what a network tells."""
        y = self._convolved(x, name, channels, 1, 1)
        return y + self._weight(f"{name}.bias", np.full(channels, bias))

    def add(self, a, b):
        return a + b

    def join(self, parts: list):
        return jnp.concatenate(parts, axis=-1)

    def folded(self, x, side: int):
        """Squares of pixels become channels of one."""
        n, height, width, channels = x.shape
        x = x.reshape(n, height // side, side, width // side, side, channels)
        x = x.transpose(0, 1, 3, 2, 4, 5)
        return x.reshape(n, height // side, width // side, side * side * channels)

    def enlarged(self, x):
        """Twice as large, each pixel four times."""
        return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)

    def widest(self, x):
        """The largest of 5x5 pixels."""
        window = (1, 5, 5, 1)
        return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, window, (1, 1, 1, 1), "SAME")

    def mean(self, x):
        """Over all pixels [N, 1, 1, C]."""
        return x.mean(axis=(1, 2), keepdims=True)

    def _convolved(self, x, name: str, channels: int, stride: int, size: int):
        fan_in = size * size * x.shape[-1]
        shape = (size, size, x.shape[-1], channels)
        kernel = self._weight(f"{name}.kernel", (2 / fan_in) ** 0.5, shape)
        if size == 1:
            return x @ kernel[0, 0]
        if x.shape[1] * x.shape[2] <= UNFOLDED_PX * stride**2:
            return unfolded(x, size, stride) @ kernel.reshape(-1, channels)
        form = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(
            x, kernel, (stride, stride), pads(size), dimension_numbers=form
        )

    def _moments(self, y, name: str):
        if self._statistics is not None:
            return self._statistics[name]
        mean = y.mean(axis=(0, 1, 2))
        moments = mean, ((y - mean) ** 2).mean(axis=(0, 1, 2))
        self.observed[name] = moments
        return moments

    def _weight(self, name: str, start, shape: tuple[int, ...] | None = None):
        if name not in self.weights:
            if self._rng is None:
                raise KeyError(name)
            values = start if shape is None else start * self._rng.standard_normal(shape)
            self.weights[name] = np.asarray(values, np.float32)
        return self.weights[name]


class Graph:
    """ONNX nodes, with normalisation folded into the convolutions."""

    def __init__(self, weights: Weights, statistics: Statistics) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._weights = weights
        self._statistics = statistics

    def beside(self, weights: Weights, statistics: Statistics) -> "Graph":
        """To add another network's nodes to the same graph."""
        other = Graph(weights, statistics)
        other.nodes, other.constants = self.nodes, self.constants
        return other

    def conv(self, x: str, name: str, _: int, stride: int = 1, **__: int) -> str:
        mean, variance = (np.asarray(part, np.float64) for part in self._statistics[name])
        factor = self._weights[f"{name}.gain"] / np.sqrt(variance + EPSILON)
        kernel = self._weights[f"{name}.kernel"] * factor
        bias = self._weights[f"{name}.bias"] - mean * factor
        return self.node("Relu", self._convolved(x, kernel, bias, stride))

    def linear(self, x: str, name: str, *_: float) -> str:
        kernel, start = (self._weights[f"{name}.{part}"] for part in ("kernel", "bias"))
        return self._convolved(x, kernel, start, 1)

    def add(self, a: str, b: str) -> str:
        return self.node("Add", a, b)

    def join(self, parts: list[str]) -> str:
        return self.node("Concat", *parts, axis=1)

    def folded(self, x: str, side: int) -> str:
        return self.node("SpaceToDepth", x, blocksize=side)

    def enlarged(self, x: str) -> str:
        scales = self.constant(np.array([1, 1, 2, 2], np.float32))
        form = {"mode": "nearest", "nearest_mode": "floor"}
        form |= {"coordinate_transformation_mode": "asymmetric"}
        return self.node("Resize", x, "", scales, **form)

    def widest(self, x: str) -> str:
        return self.node("MaxPool", x, kernel_shape=[5, 5], pads=[2] * 4)

    def mean(self, x: str) -> str:
        return self.node("GlobalAveragePool", x)

    def mirrored(self, x: str) -> str:
        """Left and right exchanged."""
        ends = (self.integers(value) for value in (-1, -(2**31), 3, -1))
        return self.node("Slice", x, *ends)

    def node(self, kind: str, *inputs: str, output: str = "", **attributes) -> str:
        """Add a node; the name of what it gives."""
        output = output or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def split(self, x: str, sizes: tuple[int, ...], axis: int = 1) -> list[str]:
        """Parts of so many channels."""
        outputs = [f"{x}.{k}" for k in range(len(sizes))]
        parts = self.integers(*sizes)
        self.nodes.append(helper.make_node("Split", [x, parts], outputs, axis=axis))
        return outputs

    def halves(self, x: str) -> tuple[str, str]:
        """The first half of a batch and the second."""
        outputs = f"{x}.first", f"{x}.second"
        self.nodes.append(helper.make_node("Split", [x], outputs, axis=0))
        return outputs

    def integers(self, *values: int) -> str:
        return self.constant(np.array(values, np.int64))

    def number(self, value: float) -> str:
        return self.constant(np.array(value, np.float32))

    def halved(self, values: np.ndarray) -> str:
        """A constant kept in half precision: it is read once, and the file is half as large."""
        return self.node("Cast", self.constant(values.astype(np.float16)), to=TensorProto.FLOAT)

    def constant(self, values: np.ndarray) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(values, name))
        return name

    def save(
        self,
        path: Path,
        inputs: tuple[str, tuple],
        outputs: tuple[str, tuple],
        about: Mapping[str, str],
    ) -> None:
        """Write the file: name and shape of its input and output, and its metadata."""
        ends = [
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)]
            for name, shape in (inputs, outputs)
        ]
        graph = helper.make_graph(self.nodes, path.stem, *ends, self.constants)
        opset = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opset, producer_name="ldo-slam")
        model.ir_version = IR_VERSION
        helper.set_model_props(model, dict(about))
        onnx.checker.check_model(model, full_check=True)
        onnx.save(model, path)

    def _convolved(self, x: str, kernel: np.ndarray, bias: np.ndarray, stride: int) -> str:
        size = kernel.shape[0]
        planes = np.ascontiguousarray(kernel.transpose(3, 2, 0, 1), np.float32)
        parts = self.halved(planes), self.constant(bias.astype(np.float32))
        form = {"kernel_shape": [size, size], "strides": [stride] * 2, "pads": [size // 2] * 4}
        return self.node("Conv", x, *parts, **form)


def pads(size: int) -> list[tuple[int, int]]:
    """Of rows and columns, as ONNX has them: alike on both sides."""
    return [(size // 2, size // 2)] * 2


def unfolded(x, size: int, stride: int):
    """Of each pixel that a convolution gives all that it is made of: [N, H, W, size * size * C]."""
    x = jnp.pad(x, [(0, 0), *pads(size), (0, 0)])
    rows, columns = (range(0, side - size + 1, stride) for side in x.shape[1:3])
    parts = [
        x[:, v : rows[-1] + v + 1 : stride, u : columns[-1] + u + 1 : stride]
        for v in range(size)
        for u in range(size)
    ]
    return jnp.concatenate(parts, axis=-1)


def merged(net: JaxNetwork | Graph, x, name: str, channels: int, side: int = 2):
    """Squares of pixels become one, each by all of them: Liu et al., ConvNeXt, CVPR 2022. Beside a
    convolution of 3x3 pixels with stride 2, a quarter of the time of training."""
    return net.conv(net.folded(x, side), name, channels, size=1)


def residual(net: JaxNetwork | Graph, x, name: str, channels: int):
    """A bottleneck beside the way straight through."""
    inner = net.conv(x, f"{name}.in", channels // 2, size=1)
    return net.add(x, net.conv(inner, f"{name}.out", channels))
