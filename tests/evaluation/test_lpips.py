"""The networks are made up: what is tested is how images reach them, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.evaluation.lpips import Lpips

from .onnx_file import write_network

IMAGES = {"in0": (1, 3, "height", "width"), "in1": (1, 3, "height", "width")}
A, B = np.random.default_rng(0).random((2, 20, 30, 3))


def distance_nodes(compare: str = "Sub") -> list[tuple[str, str, str]]:
    """mean of w (a^2 - b^2)^2, which knows channels apart, and 0..1 from -1..1."""
    return [
        ("Mul", "in0 in0", "aa"),
        ("Mul", "in1 in1", "bb"),
        (compare, "aa bb", "d"),
        ("Mul", "d d", "dd"),
        ("Mul", "dd channel_weights", "weighted"),
        ("ReduceMean", "weighted", "distance"),
    ]


def test_the_network_gets_rgb_planes_within_minus_one_and_one(tmp_path: Path) -> None:
    lpips = Lpips(write_network(tmp_path / "net.onnx", distance_nodes(), IMAGES))
    expected = np.mean([1, 2, 4] * ((2 * A - 1) ** 2 - (2 * B - 1) ** 2) ** 2)
    assert lpips(A, B) == pytest.approx(expected, rel=1e-5)
    assert lpips(A.astype(np.float32), A) == pytest.approx(0, abs=1e-9)
    assert lpips(A[:12], B[:12]) > 0, "another size"


def refusal(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        Lpips(path)(A, B)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_file_that_is_absent_or_no_network_is_refused(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "absent.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    assert "cannot be opened" in refusal(tmp_path / "text.onnx")


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
def test_another_layout_is_refused_with_the_one_expected(tmp_path: Path, inputs, nodes) -> None:
    message = refusal(write_network(tmp_path / "net.onnx", nodes, inputs))
    assert "Expected: two inputs float32 [1, 3, H, W]" in message


def test_a_network_that_tells_equal_images_apart_is_no_distance(tmp_path: Path) -> None:
    message = refusal(write_network(tmp_path / "net.onnx", distance_nodes("Add"), IMAGES))
    assert "an image to itself" in message


def test_a_network_of_one_image_size_says_which_it_cannot_take(tmp_path: Path) -> None:
    fixed = dict.fromkeys(IMAGES, (1, 3, 64, 64))
    message = refusal(write_network(tmp_path / "net.onnx", distance_nodes(), fixed))
    assert "30x20 pixels" in message
    assert "dynamic height and width" in message
