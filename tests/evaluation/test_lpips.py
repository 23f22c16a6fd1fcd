"""LPIPS with small networks made for the tests: input layout and rejected networks."""

from pathlib import Path

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.evaluation.lpips import Lpips

from .onnx_file import write_network

IMAGES = {"in0": (1, 3, "height", "width"), "in1": (1, 3, "height", "width")}
A, B = np.random.default_rng(0).random((2, 20, 30, 3))


def distance_nodes(compare: str = "Sub") -> list[tuple[str, str, str]]:
    """Return nodes for the mean of w (a^2 - b^2)^2.

    This distance depends on the order of channels, and on the range being -1..1, not 0..1.
    """
    return [
        ("Mul", "in0 in0", "aa"),
        ("Mul", "in1 in1", "bb"),
        (compare, "aa bb", "d"),
        ("Mul", "d d", "dd"),
        ("Mul", "dd channel_weights", "weighted"),
        ("ReduceMean", "weighted", "distance"),
    ]


def test_network_receives_rgb_planes_in_minus_one_to_one(tmp_path: Path) -> None:
    lpips = Lpips(write_network(tmp_path / "net.onnx", distance_nodes(), IMAGES))
    expected = np.mean([1, 2, 4] * ((2 * A - 1) ** 2 - (2 * B - 1) ** 2) ** 2)
    assert lpips(A, B) == pytest.approx(expected, rel=1e-5)
    assert lpips(A.astype(np.float32), A) == pytest.approx(0, abs=1e-9)
    assert lpips(A[:12], B[:12]) > 0, "another size"


def error_message(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        Lpips(path)(A, B)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_missing_file_or_one_without_a_network_is_rejected(tmp_path: Path) -> None:
    assert "must name an existing file" in error_message(tmp_path / "absent.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    assert "cannot be opened" in error_message(tmp_path / "text.onnx")


@pytest.mark.parametrize(
    ("inputs", "nodes"),
    [
        ({"in0": IMAGES["in0"]}, [("ReduceMean", "in0", "out")]),
        ({"in0": (1, "h", "w", 3), "in1": (1, 3)}, [("ReduceMean", "in0", "out")]),
        ({"in0": (1, 64, "h", "w"), "in1": (1, 64, "h", "w")}, [("Sub", "in0 in1", "out")]),
        (IMAGES, [("Sub", "in0 in1", "out")]),
    ],
    ids=["one image", "no planes", "64 channels", "an image as output"],
)
def test_another_layout_is_rejected_with_the_one_expected(tmp_path: Path, inputs, nodes) -> None:
    message = error_message(write_network(tmp_path / "net.onnx", nodes, inputs))
    assert "Expected: two inputs float32 [1, 3, H, W]" in message


def test_network_with_a_distance_of_equal_images_is_rejected(tmp_path: Path) -> None:
    message = error_message(write_network(tmp_path / "net.onnx", distance_nodes("Add"), IMAGES))
    assert "distance of two equal images" in message


def test_network_of_fixed_image_size_names_the_size_it_cannot_take(tmp_path: Path) -> None:
    fixed = dict.fromkeys(IMAGES, (1, 3, 64, 64))
    message = error_message(write_network(tmp_path / "net.onnx", distance_nodes(), fixed))
    assert "30x20 pixels" in message
    assert "dynamic height and width" in message
