"""What is set apart in a keyframe, in rooms whose depth and colours are exact."""

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
FLOOR_M, WALL_M = 0.9, 4.0  # below the camera, and before it


def room() -> np.ndarray:
    """Depth of a floor and a wall [H, W]."""
    below = (np.arange(240) - CAMERA.cy) / CAMERA.fy
    floor = FLOOR_M / np.maximum(below, 1e-6)
    return np.broadcast_to(np.minimum(floor, WALL_M)[:, None], SHAPE).astype(np.float32).copy()


def box(depth_m: np.ndarray, near_m: float, x_m: tuple[float, float], top_m: float) -> np.ndarray:
    """Put a box of 0.5 m depth on the floor; which pixels show it. `top_m` below the camera."""
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


def painted(where: np.ndarray | None = None) -> np.ndarray:
    color = np.full((*SHAPE, 3), WALL, np.uint8)
    if where is not None:
        color[where] = RED
    return color


def best_iou(found: list[np.ndarray], truth: np.ndarray) -> float:
    shares = [np.count_nonzero(m & truth) / np.count_nonzero(m | truth) for m in found]
    return max(shares, default=0.0)


def masks(color: np.ndarray, depth_m: np.ndarray, kind: Kind) -> list[np.ndarray]:
    found = segment_geometry(color, depth_m, CAMERA, GeometricSegmentationConfig())
    return [segment.part.image(SHAPE) for segment in found if segment.kind == kind]


def noisy(depth_m: np.ndarray, seed: int = 0) -> np.ndarray:
    """As a Kinect measures: 0.0014 / m of inverse depth."""
    rng = np.random.default_rng(seed)
    return (1 / (1 / depth_m + 0.0014 * rng.standard_normal(SHAPE))).astype(np.float32)


def test_a_bare_room_has_nothing_to_name() -> None:
    bare = segment_geometry(painted(), room(), CAMERA, GeometricSegmentationConfig())
    assert [one.kind for one in bare] == ["room", "room"], "floor and wall"
    assert np.sum([one.part.image(SHAPE) for one in bare], axis=0).max() == 1
    assert np.mean([one.part.image(SHAPE).mean() for one in bare]) > 0.4
    assert (
        segment_geometry(
            painted(), np.zeros(SHAPE, np.float32), CAMERA, GeometricSegmentationConfig()
        )
        == []
    )


@pytest.mark.parametrize("measured", [np.copy, noisy])
def test_a_picture_is_set_apart_from_its_wall_by_color_alone(measured) -> None:
    picture = np.zeros(SHAPE, bool)
    picture[30:90, 120:200] = True
    color = painted(picture)
    color[50:70, 140:180] = WALL
    found = masks(color, measured(room()), "flat")
    assert best_iou(found, picture) > 0.8, "with what in it looks like the wall"
    assert len(found) == 1
    assert masks(painted(), measured(room()), "flat") == []


@pytest.mark.parametrize("measured", [np.copy, noisy])
def test_a_front_as_large_as_a_wall_is_a_thing(measured) -> None:
    depth_m = room()
    cabinet = box(depth_m, 2.4, (-0.9, 0.8), -0.3)
    assert np.mean(cabinet) > 0.2
    assert best_iou(masks(painted(), measured(depth_m), "apart"), cabinet) > 0.85


def test_structure_is_the_floor_and_the_wall_and_no_front_or_top() -> None:
    depth_m, config = room(), PlaneConfig()
    truth = room()
    cabinet = box(depth_m, 2.4, (-0.9, 0.8), -0.3)
    seen = compute_depth_features(depth_m, CAMERA, config)
    of_room = structural_planes(seen, planes(seen, config), config) > 0
    assert np.mean(of_room[cabinet]) < 0.1
    far = ~cabinet & (np.abs(depth_m - truth) == 0)
    assert np.mean(of_room[far]) > 0.8


def test_what_stands_on_a_thing_is_set_apart_from_it() -> None:
    depth_m = room()
    table = box(depth_m, 2.4, (-0.6, 0.6), 0.4)
    cup = np.zeros(SHAPE, bool)
    cup[125:162, 150:180] = True
    depth_m[cup] = 2.5
    assert best_iou(masks(painted(), depth_m, "standing"), cup) > 0.4, "but for its edges"
    assert best_iou(masks(painted(), depth_m, "apart"), table | cup) > 0.8


def test_a_concave_crease_divides() -> None:
    """A low box against a high one: they hang together, and meet in a concave crease."""
    depth_m = room()
    high = box(depth_m, 3.0, (-0.6, 0.6), -0.4)
    low = box(depth_m, 2.5, (-0.6, 0.6), 0.4)
    assert len(masks(painted(), depth_m, "apart")) == 1
    convex = masks(painted(), depth_m, "convex")
    assert max(best_iou(convex, high & ~low), best_iou(convex, low)) > 0.7
    assert masks(painted(), room(), "convex") == []


def test_any_size_of_image_is_taken() -> None:
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
    "wrong",
    [
        lambda: GeometricSegmentationConfig(min_px=0),
        lambda: PlaneConfig(behind=2),
        lambda: PlaneConfig(gap_px=(5, 3)),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong) -> None:
    with pytest.raises(ConfigError):
        wrong()
