"""Layers of convolutional networks, for training in JAX and for export to ONNX.

A network is a function of a backend `net` and an image. The function calls a method of the backend
for each layer. Two backends have the same methods: `JaxNetwork` computes arrays [N, H, W, C] for
training, and `Graph` adds ONNX nodes and returns the names of tensors [N, C, H, W].
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Weights = dict[str, np.ndarray]
Statistics = Mapping[str, tuple[np.ndarray, np.ndarray]]  # Mean and variance by layer.

EPSILON = 1e-3  # Added to variances.
# Maximum number of output pixels for which a matrix product trains faster than XLA's convolution.
UNFOLDED_PX = 9
OPSET, IR_VERSION = 17, 8  # Versions that onnxruntime 1.18 supports.


class JaxNetwork:
    """Backend of a network that computes JAX arrays.

    Attributes:
        weights: Weights by name, including those that the backend initialized.
        observed: Mean and variance of the batch in each normalized layer, by name.
    """

    def __init__(
        self,
        weights: Mapping,
        statistics: Mapping | None = None,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Create a backend.

        Args:
            weights: Weights by name.
            statistics: Mean and variance for the normalization of each layer, by name. None uses
                the mean and variance of each batch.
            rng: Random generator that initializes missing weights. None: a missing weight raises
                KeyError.
        """
        self.weights = dict(weights)
        self.observed: dict = {}
        self._statistics = statistics
        self._rng = rng

    def conv(self, x, name: str, channels: int, stride: int = 1, size: int = 3):
        """Apply a convolution with a `size` x `size` kernel, batch normalization and ReLU."""
        y = self._convolved(x, name, channels, stride, size)
        mean, variance = self._moments(y, name)
        gain = self._weight(f"{name}.gain", np.ones(channels))
        bias = self._weight(f"{name}.bias", np.zeros(channels))
        return jax.nn.relu((y - mean) * (gain * jax.lax.rsqrt(variance + EPSILON)) + bias)

    def linear(self, x, name: str, channels: int, bias: float = 0.0):
        """Apply a 1x1 convolution with bias and without normalization, as the output layer."""
        y = self._convolved(x, name, channels, 1, 1)
        return y + self._weight(f"{name}.bias", np.full(channels, bias))

    def add(self, a, b):
        return a + b

    def join(self, parts: list):
        return jnp.concatenate(parts, axis=-1)

    def folded(self, x, side: int):
        """Merge each square of `side` x `side` pixels into the channels of one pixel.

        This is the ONNX operation SpaceToDepth.
        """
        n, height, width, channels = x.shape
        x = x.reshape(n, height // side, side, width // side, side, channels)
        x = x.transpose(0, 1, 3, 2, 4, 5)
        return x.reshape(n, height // side, width // side, side * side * channels)

    def enlarged(self, x):
        """Enlarge an image to twice its size by nearest-neighbor upsampling."""
        return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)

    def widest(self, x):
        """Replace each pixel by the maximum of the 5x5 pixels around it, per channel."""
        window = (1, 5, 5, 1)
        return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, window, (1, 1, 1, 1), "SAME")

    def mean(self, x):
        """Average an image over all its pixels, per channel; the result is [N, 1, 1, C]."""
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
    """Backend of a network that builds an ONNX graph.

    The convolution of a layer includes the normalization of the layer. The class has the same
    methods for layers as `JaxNetwork`, but they take and return names of tensors.
    """

    def __init__(self, weights: Weights, statistics: Statistics) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._weights = weights
        self._statistics = statistics

    def beside(self, weights: Weights, statistics: Statistics) -> "Graph":
        """Return a `Graph` that has other weights and adds its nodes to the same ONNX graph."""
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
        """Mirror an image left to right."""
        ends = (self.integers(value) for value in (-1, -(2**31), 3, -1))
        return self.node("Slice", x, *ends)

    def node(self, kind: str, *inputs: str, output: str = "", **attributes) -> str:
        """Add a node and return the name of its output."""
        output = output or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def split(self, x: str, sizes: tuple[int, ...], axis: int = 1) -> list[str]:
        """Split a tensor along an axis into parts of these sizes."""
        outputs = [f"{x}.{k}" for k in range(len(sizes))]
        parts = self.integers(*sizes)
        self.nodes.append(helper.make_node("Split", [x, parts], outputs, axis=axis))
        return outputs

    def halves(self, x: str) -> tuple[str, str]:
        """Return the first and the second half of a batch."""
        outputs = f"{x}.first", f"{x}.second"
        self.nodes.append(helper.make_node("Split", [x], outputs, axis=0))
        return outputs

    def integers(self, *values: int) -> str:
        return self.constant(np.array(values, np.int64))

    def number(self, value: float) -> str:
        return self.constant(np.array(value, np.float32))

    def halved(self, values: np.ndarray) -> str:
        """Add a constant in half precision, which halves the file's size, and a cast to float32."""
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
        """Check the model and write it.

        Args:
            path: File to write.
            inputs: Name and shape of the only input.
            outputs: Name and shape of the only output.
            about: Metadata of the model.
        """
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
    """Return the padding of rows and columns for a kernel of side `size`.

    The padding is symmetric, as in the ONNX nodes of `Graph`.
    """
    return [(size // 2, size // 2)] * 2


def unfolded(x, size: int, stride: int):
    """Gather the input values of each output pixel of a convolution (im2col).

    Args:
        x: Image [N, H, W, C].
        size: Side of the kernel.
        stride: Stride of the convolution.

    Returns:
        An array [N, H / stride, W / stride, size * size * C].
    """
    x = jnp.pad(x, [(0, 0), *pads(size), (0, 0)])
    rows, columns = (range(0, side - size + 1, stride) for side in x.shape[1:3])
    parts = [
        x[:, v : rows[-1] + v + 1 : stride, u : columns[-1] + u + 1 : stride]
        for v in range(size)
        for u in range(size)
    ]
    return jnp.concatenate(parts, axis=-1)


def merged(net: JaxNetwork | Graph, x, name: str, channels: int, side: int = 2):
    """Apply a patchify convolution: each square of `side` x `side` pixels becomes one pixel.

    See Liu et al., ConvNeXt, CVPR 2022. Training of this layer takes a quarter of the time of a 3x3
    convolution with stride 2.
    """
    return net.conv(net.folded(x, side), name, channels, size=1)


def residual(net: JaxNetwork | Graph, x, name: str, channels: int):
    """Apply a bottleneck with a residual connection.

    A 1x1 convolution halves the channels, a 3x3 convolution restores them, and the input is added.
    """
    inner = net.conv(x, f"{name}.in", channels // 2, size=1)
    return net.add(x, net.conv(inner, f"{name}.out", channels))
