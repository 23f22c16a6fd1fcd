"""The two builds of a network: JAX computes what the ONNX file computes."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import onnxruntime
import pytest

pytest.importorskip("jax", reason="needs the trainer's libraries: pip install --group train")


HALF_PRECISION = 2e-3  # Kernels are stored in half precision.


@pytest.fixture
def layers(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "training")
    import layers

    yield layers
    del sys.modules["layers"]


def test_jax_and_onnx_compute_the_same(layers: ModuleType, tmp_path: Path) -> None:
    def network(net, image):
        x = net.conv(net.folded(image, 2), "stem", 8, size=1)
        small = layers.residual(net, layers.merged(net, x, "merge", 8), "block", 8)
        small = net.add(small, net.conv(x, "down", 8, stride=2))
        joined = net.join([x, net.enlarged(net.widest(small))])
        return net.linear(net.mean(net.conv(joined, "out", 6)), "result", 3, 0.5)

    rng = np.random.default_rng(0)
    image = rng.random((1, 16, 24, 3), np.float32)
    drawn = layers.JaxNetwork({}, rng=rng)
    network(drawn, image)
    moments = {name: tuple(map(np.asarray, pair)) for name, pair in drawn.observed.items()}
    by_jax = np.asarray(network(layers.JaxNetwork(drawn.weights, moments), image))[0, 0, 0]

    graph = layers.Graph(drawn.weights, moments)
    result = graph.node("Flatten", network(graph, "image"), output="result")
    graph.save(tmp_path / "net.onnx", ("image", (1, 3, 16, 24)), (result, (1, 3)), {})
    session = onnxruntime.InferenceSession(tmp_path / "net.onnx")
    by_onnx = np.asarray(session.run(None, {"image": image.transpose(0, 3, 1, 2).copy()})[0])[0]
    np.testing.assert_allclose(by_onnx, by_jax, atol=HALF_PRECISION)


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("side", [2, 3, 4, 7])
def test_product_with_an_unfolded_image_is_a_convolution(
    layers: ModuleType, side: int, stride: int
) -> None:
    rng = np.random.default_rng(0)
    image, kernel = (rng.random(shape, np.float32) for shape in ((2, side, side, 5), (3, 3, 5, 4)))
    product = layers.unfolded(image, 3, stride) @ kernel.reshape(-1, 4)
    form = ("NHWC", "HWIO", "NHWC")
    expected = layers.jax.lax.conv_general_dilated(
        image, kernel, (stride, stride), layers.pads(3), dimension_numbers=form
    )
    np.testing.assert_allclose(product, expected, atol=1e-4)


def test_mirrored_image_and_halves_of_a_batch(layers: ModuleType, tmp_path: Path) -> None:
    graph = layers.Graph({}, {})
    both = graph.node("Concat", "image", graph.mirrored("image"), axis=0)
    first, second = graph.halves(both)
    result = graph.node("Sub", first, second, output="result")
    shape = ("n", 3, 4, 5)
    graph.save(tmp_path / "net.onnx", ("image", shape), (result, shape), {})
    image = np.random.default_rng(0).random((2, 3, 4, 5), np.float32)
    by_onnx = onnxruntime.InferenceSession(tmp_path / "net.onnx").run(None, {"image": image})[0]
    np.testing.assert_array_equal(np.asarray(by_onnx), image - image[..., ::-1])
