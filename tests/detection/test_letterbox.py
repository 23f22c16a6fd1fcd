"""Letterbox: image to network input, and boxes back to the image."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.detection.yolo import PADDING, Letterbox

SIDES = st.tuples(st.integers(8, 900), st.integers(8, 900))


@pytest.mark.parametrize(
    ("is_centered", "rows"), [(True, (16, 112)), (False, (0, 96))], ids=["centered", "corner"]
)
def test_letterbox_keeps_aspect_ratio_with_gray_padding(
    is_centered: bool, rows: tuple[int, int]
) -> None:
    letterbox = Letterbox.fit((640, 480), (128, 128), is_centered)
    canvas = letterbox.canvas(np.full((480, 640, 3), 7, np.uint8))
    assert canvas.shape == (128, 128, 3)
    expected = np.full((128, 128, 3), PADDING, np.uint8)
    expected[slice(*rows)] = 7
    np.testing.assert_array_equal(canvas, expected)


@given(image=SIDES, inputs=SIDES, is_centered=st.booleans())
def test_box_of_the_whole_image_is_restored(image, inputs, is_centered: bool) -> None:
    letterbox = Letterbox.fit(image, inputs, is_centered)
    (left, top), (width, height) = letterbox.offset_px, letterbox.inner_px
    assert width in (inputs[0], letterbox.inner_px[0])
    assert left + width <= inputs[0]
    assert top + height <= inputs[1]
    assert inputs[0] in (width,) or inputs[1] in (height,)
    whole = np.array([[left, top, left + width, top + height]], float)
    np.testing.assert_allclose(
        letterbox.to_image(whole), [[-0.5, -0.5, image[0] - 0.5, image[1] - 0.5]]
    )


@pytest.mark.parametrize("is_centered", [True, False])
@pytest.mark.parametrize("input_px", [(640, 480), (416, 416), (160, 320)])
def test_bright_patch_maps_back_to_its_box(is_centered: bool, input_px) -> None:
    """Compare the center of brightness, to a tenth of a pixel of the input."""
    image = np.zeros((240, 320, 3), np.uint8)
    image[60:120, 200:260] = 255
    letterbox = Letterbox.fit((320, 240), input_px, is_centered)
    canvas = letterbox.canvas(image).astype(float)[..., 0]
    canvas[canvas == PADDING] = 0
    rows, columns = (
        np.indices(canvas.shape) + 0.5
    )  # Pixel coordinates from the corner, as in networks.
    center = np.array([(columns * canvas).sum(), (rows * canvas).sum()]) / canvas.sum()
    (box,) = letterbox.to_image(np.r_[center, center][None])
    scale = 320 / letterbox.inner_px[0]
    np.testing.assert_allclose(box[:2], [229.5, 89.5], atol=0.1 * scale)


def test_boxes_are_clipped_to_the_image() -> None:
    letterbox = Letterbox.fit((320, 240), (640, 640), is_centered=True)
    boxes = letterbox.to_image(np.array([[-50.0, 0.0, 700.0, 1e9]]))
    np.testing.assert_array_equal(boxes, [[-0.5, -0.5, 319.5, 239.5]])
