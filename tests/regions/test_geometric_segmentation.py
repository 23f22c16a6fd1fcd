"""Geometric segmentation of synthetic rooms with exact depth and color."""

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera
from ldo_service.regions.geometric_segmentation import (
    GeometricSegmentationConfig,
    Kind,
    segment_geometry,
)
from ldo_service.regions.planes import (
    PlaneConfig,
    compute_depth_features,
    planes,
    structural_planes,
)

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
SHAPE = 240, 320
WALL, RED = (200, 205, 190), (180, 60, 50)
FLOOR_M, WALL_M = 0.9, 4.0  # Distances below and in front of the camera.


def room_depth() -> np.ndarray:
    """Return the depth [H, W] of a floor and a wall."""
    below = (np.arange(240) - CAMERA.cy) / CAMERA.fy
    floor = FLOOR_M / np.maximum(below, 1e-6)
    return np.broadcast_to(np.minimum(floor, WALL_M)[:, None], SHAPE).astype(np.float32).copy()


def draw_box(
    depth_m: np.ndarray, near_m: float, x_m: tuple[float, float], top_m: float
) -> np.ndarray:
    """Draw a box of 0.5 m depth on the floor into `depth_m`.

    Args:
        depth_m: Depth image [H, W] to draw into, meters.
        near_m: Depth of the front of the box.
        x_m: Left and right end of the box.
        top_m: Distance of its top below the camera.

    Returns:
        The mask [H, W] of the pixels that show the box.
    """
    v, u = np.indices(SHAPE)
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    hits = []
    for z in (near_m, top_m / np.maximum(y, 1e-6)):
        at_x, at_y = x * z, y * z
        is_on = (at_x > x_m[0]) & (at_x < x_m[1]) & (at_y > top_m - 1e-6) & (at_y < FLOOR_M)
        is_on &= (z > near_m - 1e-6) & (z < near_m + 0.5)
        hits.append(np.where(is_on, z, np.inf))
    z = np.minimum(*hits)
    shown = z < depth_m
    depth_m[shown] = z[shown]
    return shown


def color_image(is_red: np.ndarray | None = None) -> np.ndarray:
    color = np.full((*SHAPE, 3), WALL, np.uint8)
    if is_red is not None:
        color[is_red] = RED
    return color


def best_iou(found: list[np.ndarray], truth: np.ndarray) -> float:
    ious = [np.count_nonzero(m & truth) / np.count_nonzero(m | truth) for m in found]
    return max(ious, default=0.0)


def masks(color: np.ndarray, depth_m: np.ndarray, kind: Kind) -> list[np.ndarray]:
    found = segment_geometry(color, depth_m, CAMERA, GeometricSegmentationConfig())
    return [segment.part.image(SHAPE) for segment in found if segment.kind == kind]


def noisy(depth_m: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return depth with the noise of a Kinect: 0.0014 1/m of inverse depth."""
    rng = np.random.default_rng(seed)
    return (1 / (1 / depth_m + 0.0014 * rng.standard_normal(SHAPE))).astype(np.float32)


def test_bare_room_has_only_room_segments() -> None:
    bare = segment_geometry(color_image(), room_depth(), CAMERA, GeometricSegmentationConfig())
    assert [segment.kind for segment in bare] == ["room", "room"], "floor and wall"
    assert np.sum([segment.part.image(SHAPE) for segment in bare], axis=0).max() == 1
    assert np.mean([segment.part.image(SHAPE).mean() for segment in bare]) > 0.4
    assert (
        segment_geometry(
            color_image(), np.zeros(SHAPE, np.float32), CAMERA, GeometricSegmentationConfig()
        )
        == []
    )


@pytest.mark.parametrize("measure", [np.copy, noisy])
def test_picture_is_segmented_from_its_wall_by_color(measure) -> None:
    picture = np.zeros(SHAPE, bool)
    picture[30:90, 120:200] = True
    color = color_image(picture)
    color[50:70, 140:180] = WALL
    found = masks(color, measure(room_depth()), "flat")
    assert best_iou(found, picture) > 0.8, "the mask includes the part with the color of the wall"
    assert len(found) == 1
    assert masks(color_image(), measure(room_depth()), "flat") == []


@pytest.mark.parametrize("measure", [np.copy, noisy])
def test_large_front_is_segmented_as_an_object(measure) -> None:
    depth_m = room_depth()
    cabinet = draw_box(depth_m, 2.4, (-0.9, 0.8), -0.3)
    assert np.mean(cabinet) > 0.2
    assert best_iou(masks(color_image(), measure(depth_m), "apart"), cabinet) > 0.85


def test_structural_planes_are_floor_and_wall_not_furniture() -> None:
    depth_m, config = room_depth(), PlaneConfig()
    truth = room_depth()
    cabinet = draw_box(depth_m, 2.4, (-0.9, 0.8), -0.3)
    seen = compute_depth_features(depth_m, CAMERA, config)
    is_structure = structural_planes(seen, planes(seen, config), config) > 0
    assert np.mean(is_structure[cabinet]) < 0.1
    is_background = ~cabinet & (np.abs(depth_m - truth) == 0)
    assert np.mean(is_structure[is_background]) > 0.8


def test_object_on_furniture_is_segmented_separately() -> None:
    depth_m = room_depth()
    table = draw_box(depth_m, 2.4, (-0.6, 0.6), 0.4)
    cup = np.zeros(SHAPE, bool)
    cup[125:162, 150:180] = True
    depth_m[cup] = 2.5
    assert best_iou(masks(color_image(), depth_m, "standing"), cup) > 0.4, (
        "the mask lacks the edges"
    )
    assert best_iou(masks(color_image(), depth_m, "apart"), table | cup) > 0.8


def test_concave_crease_separates_touching_objects() -> None:
    """A low and a high box touch and meet in a concave crease."""
    depth_m = room_depth()
    high = draw_box(depth_m, 3.0, (-0.6, 0.6), -0.4)
    low = draw_box(depth_m, 2.5, (-0.6, 0.6), 0.4)
    assert len(masks(color_image(), depth_m, "apart")) == 1
    convex = masks(color_image(), depth_m, "convex")
    assert max(best_iou(convex, high & ~low), best_iou(convex, low)) > 0.7
    assert masks(color_image(), room_depth(), "convex") == []


def test_odd_image_size_is_segmented() -> None:
    camera = Camera(643, 481, 520.0, 520.0, 321.0, 240.0)
    depth_m = np.full((481, 643), 3.0, np.float32)
    depth_m[200:300, 300:400] = 2.0
    color = np.full((481, 643, 3), 128, np.uint8)
    found = [
        s.part
        for s in segment_geometry(color, depth_m, camera, GeometricSegmentationConfig())
        if s.kind == "apart"
    ]
    assert [part.mask.shape for part in found] == [pytest.approx((98, 98), abs=6)]


@pytest.mark.parametrize(
    "make_config",
    [
        lambda: GeometricSegmentationConfig(min_px=0),
        lambda: PlaneConfig(behind=2),
        lambda: PlaneConfig(gap_px=(5, 3)),
    ],
)
def test_invalid_settings_raise_config_error(make_config) -> None:
    with pytest.raises(ConfigError):
        make_config()
