import numpy as np
import pytest

from ldo_service.gaussians import render
from ldo_service.gaussians.visibility import BEHIND, BoundingSpheres, MaxDepthGrid, PlacedCamera
from ldo_service.geometry import Camera, se3

CAMERA = Camera(160, 120, 120.0, 110.0, 75.0, 62.0)


def is_hidden(depth_m: np.ndarray, centers: list, radius_m: float = 0.1) -> list[bool]:
    radii_m = np.full(len(centers), radius_m)
    return MaxDepthGrid.of(depth_m).occludes(CAMERA, np.array(centers, float), radii_m).tolist()


def wall(z_m: float) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), z_m, np.float32)


def test_sphere_entirely_behind_a_wall_is_hidden() -> None:
    depths_m = [1, 2, 2.05, (1 + BEHIND) * 2 + 0.09, (1 + BEHIND) * 2 + 0.11, 9, np.nan]
    hidden = [False, False, False, False, True, True, False]
    assert is_hidden(wall(2), [(0, 0, z) for z in depths_m]) == hidden


def test_sphere_visible_through_a_door_is_not_hidden() -> None:
    depth_m = wall(2)
    depth_m[:, 100:120] = 6
    through_m = (110 - CAMERA.cx) / CAMERA.fx * 5
    centers = [(through_m, 0, 5), (through_m - 0.9, 0, 5), (through_m - 0.4, 0, 5), (0, 0, 5)]
    assert is_hidden(depth_m, centers) == [False, True, False, True]
    assert is_hidden(depth_m, centers, radius_m=0.8) == [False, False, False, True]


def test_only_large_depth_holes_leave_spheres_visible() -> None:
    depth_m = wall(2)
    depth_m[60:63, 20:150] = 0  # A narrow hole in the depth.
    assert is_hidden(depth_m, [(0, 0, 5)]) == [True]
    depth_m[40:80, 60:100] = 0
    assert is_hidden(depth_m, [(0, 0, 5), (2.5, 0, 5)]) == [False, True]


@pytest.mark.parametrize("seed", range(4))
def test_hidden_gaussians_are_never_rendered_before_the_measured_surface(seed: int) -> None:
    """Random Gaussians and a measured surface with steps.

    Each rendered pixel of a hidden Gaussian lies behind the surface.
    """
    rng = np.random.default_rng(seed)
    blocks = rng.uniform(1, 6, (6, 8)).astype(np.float32)
    depth_m = blocks.repeat(20, axis=0).repeat(20, axis=1)
    rows = np.zeros((2000, 16), np.float32)
    rows[:, 0:3] = rng.uniform((-5, -4, 0.5), (5, 4, 9), (2000, 3))
    rows[:, 3:6] = rng.uniform(-5, -2.5, (2000, 3))
    rows[:, 6], rows[:, 10] = 1, 8
    spheres = BoundingSpheres.around(rows, np.arange(2000, dtype=np.int32))
    T_map_camera = se3.exp(np.array([0.1, -0.2, 0.1, 0.2, -0.1, 0.3]))
    camera_without_horizon = PlacedCamera(CAMERA, T_map_camera)
    camera_with_horizon = PlacedCamera(CAMERA, T_map_camera, MaxDepthGrid.of(depth_m))
    in_view = camera_without_horizon.may_see(spheres.centers, spheres.radii_m)
    seen = camera_with_horizon.may_see(spheres.centers, spheres.radii_m)
    assert not np.any(seen & ~in_view)
    hidden = in_view & ~seen
    assert 0.2 < hidden.sum() / in_view.sum() < 0.9
    shown = render(np.ascontiguousarray(rows[hidden]), CAMERA, se3.inverse(T_map_camera))
    is_drawn = shown.median_depth_m > 0
    assert is_drawn.mean() > 0.03
    assert np.all(shown.median_depth_m[is_drawn] > depth_m[is_drawn])
