"""Tests of surfaces and foregrounds against the reference, with every instruction set."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from ldo_service.geometry import Camera
from ldo_service.kernels import _foreground
from ldo_service.regions.foreground import ForegroundConfig, SmoothSurfaces
from tests.reference.foreground import foreground_reference, surfaces_reference

CONFIG = ForegroundConfig()
# Whole and partial vectors and words, and sides below the nine pixels that a pair of normals reads.
SIZES = ((120, 160), (64, 128), (97, 131), (9, 70), (33, 5), (4, 4), (3, 8), (2, 17), (1, 40))
SIZES += ((40, 1), (1, 1))
COMPARE_ALL = """
from ldo_service.geometry import Camera
from ldo_service.regions.foreground import ForegroundConfig, SmoothSurfaces, foreground, surfaces
for name in {key.split("/")[0] for key in given}:
    depth_m, plain = given[f"{name}/depth_m"], given[f"{name}/labels"]
    h, w = depth_m.shape
    told = Camera(w, h, 0.9 * w, 1.1 * h, 0.47 * w, 0.51 * h), ForegroundConfig()
    found = surfaces(depth_m, *told)
    result |= {f"{name}/labels": found.labels, f"{name}/sizes": found.sizes}
    plain = SmoothSurfaces(plain, np.bincount(plain.ravel()))
    for k, box in enumerate(given[f"{name}/boxes"]):
        result[f"{name}/mask{k}"] = foreground(box, depth_m, plain, *told).mask
"""


def camera(height: int, width: int) -> Camera:
    return Camera(width, height, 0.9 * width, 1.1 * height, 0.47 * width, 0.51 * height)


def scene(height: int, width: int) -> np.ndarray:
    """Return depth of a slanted wall with a crease and boxes in front of it.

    The left has noise; the right has holes and invalid values.
    """
    rng = np.random.default_rng(height * width)
    v, u = np.indices((height, width))
    depth_m = 2.5 + 0.8 * np.abs(u / width - 0.4) + 0.3 * v / height
    for _ in range(8):
        low = rng.uniform(0, [height, width]).astype(int)
        high = low + 1 + rng.uniform(0, [height / 2, width / 2]).astype(int)
        depth_m[low[0] : high[0], low[1] : high[1]] = rng.uniform(0.6, 2.2)
    depth_m *= 1 + 0.004 * rng.normal(size=depth_m.shape) * (u < width / 3)
    gone = (rng.random(depth_m.shape) < 0.03) & (u > width / 2)
    depth_m[gone] = rng.choice([0, -1, np.nan, np.inf, 1e-9], np.count_nonzero(gone))
    return depth_m.astype(np.float32)


def boxes(height: int, width: int) -> np.ndarray:
    """Return boxes within the image, across its border, around it and next to it."""
    rng = np.random.default_rng(width)
    low = rng.uniform(-0.2, 0.8, (12, 2)) * [width, height]
    some = np.concatenate([low, low + rng.uniform(0.1, 0.6, (12, 2)) * [width, height]], axis=1)
    whole, beside = [-9, -9, width + 9, height + 9], [width + 3, 0, width + 9, height]
    return np.concatenate([some, [whole, beside]])


def plain(height: int, width: int) -> tuple[np.ndarray, SmoothSurfaces]:
    """Return the depth of the scene, and the surfaces that the reference implementation finds."""
    depth_m = scene(height, width)
    return depth_m, surfaces_reference(depth_m, camera(height, width), CONFIG)


@pytest.fixture(scope="module")
def by_kernel(with_isa: Callable) -> dict[str, np.ndarray]:
    """Return labels, sizes and masks of every scene by the kernels."""
    given = {}
    for size in SIZES:
        name, (depth_m, found) = "{}x{}".format(*size), plain(*size)
        given |= {f"{name}/depth_m": depth_m, f"{name}/labels": found.labels}
        given[f"{name}/boxes"] = boxes(*size)
    return with_isa(COMPARE_ALL, given)


@pytest.mark.parametrize("size", SIZES)
def test_surfaces_are_those_of_the_plain_twin(size: tuple[int, int], by_kernel: dict) -> None:
    _, wanted = plain(*size)
    labels = by_kernel["{}x{}/labels".format(*size)]
    # Rounding decides where a cosine is at its threshold.
    differ = (labels > 0) != (wanted.labels > 0)
    assert np.count_nonzero(differ) <= 1e-4 * differ.size
    if not differ.any():
        np.testing.assert_array_equal(labels, wanted.labels)


@pytest.mark.parametrize("size", SIZES)
def test_pieces_are_numbered_and_counted_as_opencv_does(
    size: tuple[int, int], by_kernel: dict
) -> None:
    labels = by_kernel["{}x{}/labels".format(*size)]
    _, wanted = cv2.connectedComponents((labels > 0).astype(np.uint8), connectivity=4)
    np.testing.assert_array_equal(labels, wanted)
    np.testing.assert_array_equal(
        by_kernel["{}x{}/sizes".format(*size)], np.bincount(labels.ravel())
    )


@pytest.mark.parametrize("size", SIZES)
def test_foregrounds_are_those_of_the_plain_twin(size: tuple[int, int], by_kernel: dict) -> None:
    depth_m, found = plain(*size)
    for k, box in enumerate(boxes(*size)):
        wanted = foreground_reference(box, depth_m, found, camera(*size), CONFIG)
        np.testing.assert_array_equal(by_kernel["{}x{}/mask{}".format(*size, k)], wanted.mask)


def test_scenes_have_steps_creases_holes_and_things() -> None:
    """Check that the scenes make the comparisons above meaningful."""
    depth_m, found = plain(97, 131)
    assert len(found.sizes) > 8
    assert 0.2 < np.mean(found.labels > 0) < 0.9
    sizes = [
        np.count_nonzero(foreground_reference(b, depth_m, found, camera(97, 131), CONFIG).mask)
        for b in boxes(97, 131)
    ]
    assert np.count_nonzero(sizes) >= 4
    assert 0 in sizes


def test_pieces_hang_together_by_sides_alone_however_they_wind() -> None:
    """Check that the pieces are the connected components of OpenCV.

    In a random pattern of blocks of 3x3 pixels with and without depth, only the middle of a block
    and the pixels that connect it to the next block with depth are smooth.
    """
    labyrinth = np.random.default_rng(0).random((40, 60)) < 0.6
    depth_m = np.kron(labyrinth, np.ones((3, 3))).astype(np.float32)
    labels = np.empty(depth_m.shape, np.int32)
    sizes = _foreground.surfaces(depth_m, 200.0, 200.0, 90.0, 60.0, 0.05, 0.0, labels)
    _, wanted = cv2.connectedComponents((labels > 0).astype(np.uint8), connectivity=4)
    assert wanted.max() > 20
    np.testing.assert_array_equal(labels, wanted)
    np.testing.assert_array_equal(sizes, np.bincount(wanted.ravel()))


def given_to_foreground(**changes: object) -> tuple:
    """Return valid arguments of `_foreground.foreground`, in order, with some changed."""
    depth_m, labels = np.ones((20, 30), np.float32), np.zeros((20, 30), np.int32)
    common = {
        "depth_m": depth_m,
        "focal_px": 20.0,
        "labels": labels,
        "sizes": np.array([600]),
        "row": 5,
        "column": 5,
        "min_inside": 0.5,
        "max_gap": 0.15,
        "depth_bin": 0.05,
        "near_mode": 0.1,
        "grow_px": 2,
        "mask": np.ones((10, 10), np.uint8),
    }
    return tuple((common | changes).values())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth_m": np.ones((20, 30))}, "float32"),
        ({"labels": np.zeros((19, 30), np.int32)}, "shape"),
        ({"labels": np.full((20, 30), -1, np.int32)}, "sizes"),
        ({"labels": np.full((20, 30), 1, np.int32)}, "sizes"),
        ({"sizes": np.ones(1, np.int32)}, "int64"),
        ({"row": -1}, "within the image"),
        ({"column": 21}, "within the image"),
        ({"mask": np.ones((0, 10), np.uint8)}, "shape"),
        ({"focal_px": 0.0}, "positive"),
        ({"depth_bin": 1e-9}, "1e-4"),
        ({"max_gap": np.nan}, "max_gap must lie in 0..1e6"),
        ({"max_gap": np.inf}, "max_gap must lie in 0..1e6"),
        ({"near_mode": np.inf}, "near_mode must lie in 0..1e6"),
    ],
)
def test_what_does_not_fit_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _foreground.foreground(*given_to_foreground(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": 0.0}, "positive focal lengths"),
        ({"cy": np.nan}, "finite"),
        ({"max_step": -0.1}, "max_step must lie in 0..1e6"),
        ({"min_cosine": 1.1}, "min_cosine"),
        ({"labels": np.zeros((20, 29), np.int32)}, "labels must have shape"),
    ],
)
def test_what_does_not_fit_a_depth_image_is_refused(changes: dict, message: str) -> None:
    common = {
        "depth_m": np.ones((20, 30), np.float32),
        **dict.fromkeys(("fx", "fy", "cx", "cy"), 20.0),
        "max_step": 0.05,
        "min_cosine": 0.9,
        "labels": np.zeros((20, 30), np.int32),
    }
    with pytest.raises(ValueError, match=message):
        _foreground.surfaces(*(common | changes).values())


def test_a_mask_is_written_whole() -> None:
    common = given_to_foreground()
    _foreground.foreground(*common)
    assert common[-1].all()  # The depth is constant, and all pixels are on edges.
    nothing = given_to_foreground(depth_m=np.zeros((20, 30), np.float32))
    _foreground.foreground(*nothing)
    assert not nothing[-1].any()
