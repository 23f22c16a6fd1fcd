import numpy as np
import pytest

from ldo_service.errors import FrameError
from ldo_service.geometry import Camera, RgbdFrame

CAMERA = Camera(4, 3, 3, 3, 1.5, 1)
COLOR, DEPTH = np.zeros((3, 4, 3), np.uint8), np.ones((3, 4), np.float32)


def test_frame_with_holes_in_its_depth_is_accepted() -> None:
    assert RgbdFrame(COLOR, DEPTH * 0, CAMERA).depth_m.max() == 0


@pytest.mark.parametrize(
    ("color", "depth_m", "word"),
    [
        (COLOR[:2], DEPTH, "color"),
        (COLOR.astype(float), DEPTH, "color is float64"),
        (COLOR, DEPTH[:, :2], "depth"),
        (COLOR, DEPTH.astype(np.float64), "depth is float64"),
        (COLOR, DEPTH * np.float32("nan"), "finite"),
        (COLOR, DEPTH * np.float32("inf"), "finite"),
        (COLOR, -DEPTH, "at least 0"),
    ],
)
def test_arrays_that_do_not_match_are_named(
    color: np.ndarray, depth_m: np.ndarray, word: str
) -> None:
    with pytest.raises(FrameError, match=f"frame 7.*{word}"):
        RgbdFrame(color, depth_m, CAMERA, index=7)


def test_one_nan_among_good_depth_is_rejected() -> None:
    depth_m = DEPTH.copy()
    depth_m[1, 2] = np.nan
    with pytest.raises(FrameError, match="finite"):
        RgbdFrame(COLOR, depth_m, CAMERA)
