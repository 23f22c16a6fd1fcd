import cv2
import numpy as np
import pytest

from ldo_service.errors import FrameError
from ldo_service.geometry import Camera, RawFrame, Rectifier, se3
from ldo_service.geometry.registration import register_depth
from tests.geometry.cameras import CAMERA, COLOR_CAMERAS, FINER, FREIBURG1


def moved(x_m: float, *rotation_rad: float) -> np.ndarray:
    """Return T_color_depth of a color camera that is x_m to the right."""
    return se3.exp(np.array([*(rotation_rad or (0.0, 0.0, 0.0)), -x_m, 0.0, 0.0]))


def slanted(camera: Camera, T_camera_depth: np.ndarray) -> np.ndarray:
    """Return exact z [H, W] of a plane 2 m ahead of the depth camera, turned by 40 degrees."""
    return slanted_along(camera.rays(), T_camera_depth)


def slanted_along(rays_camera: np.ndarray, T_camera_depth: np.ndarray) -> np.ndarray:
    T_depth_plane = np.eye(4)
    T_depth_plane[2, 3] = 2.0
    T_depth_plane = T_depth_plane @ se3.exp(np.array([0.3, 0.6, 0, 0, 0, 0]))
    T_plane_camera = se3.inverse(T_camera_depth @ T_depth_plane)
    towards_plane = rays_camera @ T_plane_camera[2, :3]
    return (-T_plane_camera[2, 3] / towards_plane).astype(np.float32)


def noise(seed: int, camera: Camera = CAMERA) -> np.ndarray:
    """Return depth without any surface; a third of it is missing."""
    rng = np.random.default_rng(seed)
    depth_m = rng.uniform(0.5, 4.0, (camera.height, camera.width)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.33] = 0.0
    return depth_m


@pytest.mark.parametrize("distortion", [(), FREIBURG1])
def test_equal_cameras_leave_depth_bitwise_equal(distortion: tuple[float, ...]) -> None:
    camera = Camera(64, 48, 50.3, 49.7, 31.4, 23.9, distortion)
    registered = register_depth(noise(0), camera, camera, np.eye(4))
    assert registered.dtype == np.float32
    assert np.array_equal(registered, noise(0))


@pytest.mark.parametrize("side", [1, -1])
def test_foreground_hides_background_and_uncovers_nothing(side: int) -> None:
    """A post at 1 m and a wall at 2 m shift by 10 and 5 pixels at a baseline of 0.2 m."""
    depth_m = np.full((48, 64), 2.0, np.float32)
    depth_m[:, 30:38] = 1.0
    expected = np.zeros_like(depth_m)
    if side > 0:
        expected[:, :25], expected[:, 33:59], expected[:, 20:28] = 2.0, 2.0, 1.0
    else:
        expected[:, 5:35], expected[:, 43:], expected[:, 40:48] = 2.0, 2.0, 1.0
    registered = register_depth(depth_m, CAMERA, CAMERA, moved(0.2 * side))
    assert np.array_equal(registered, expected)


@pytest.mark.parametrize("color_camera", COLOR_CAMERAS.values(), ids=COLOR_CAMERAS.keys())
def test_plane_is_whole_at_any_resolution(color_camera: Camera) -> None:
    depth_m = np.full((48, 64), 1.5, np.float32)
    registered = register_depth(depth_m, CAMERA, color_camera, moved(0.0))
    assert registered.shape == (color_camera.height, color_camera.width)
    assert set(np.unique(registered)) <= {np.float32(0), np.float32(1.5)}
    assert np.all(registered[2:-2, 2:-2] == 1.5)


@pytest.mark.parametrize("x_m", [0.1, -0.1, 0.4, -0.4])
@pytest.mark.parametrize("color_camera", [CAMERA, FINER])
def test_slanted_surface_that_widens_has_no_pinholes(color_camera: Camera, x_m: float) -> None:
    T_color_depth = moved(x_m, 0.01, -0.02, 0.03)
    registered = register_depth(slanted(CAMERA, np.eye(4)), CAMERA, color_camera, T_color_depth)
    truth = slanted(color_camera, T_color_depth)
    is_seen = registered > 0
    closed = cv2.morphologyEx(is_seen.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    assert is_seen.mean() > 0.5
    assert np.array_equal(closed[3:-3, 3:-3] > 0, is_seen[3:-3, 3:-3])
    # A cell has one depth: half a cell of a surface this steep is 2 %.
    assert np.max(np.abs(registered - truth)[is_seen] / truth[is_seen]) < 0.03


def test_every_point_is_at_its_pixel_unless_a_nearer_one_is() -> None:
    """Each point is compared with the projection of the camera."""
    T_color_depth = moved(0.3, 0.05, -0.1, 0.2)
    depth_m = noise(1)
    registered = register_depth(depth_m, CAMERA, FINER, T_color_depth)
    points = se3.transform(T_color_depth, CAMERA.rays() * depth_m[..., None])[depth_m > 0]
    u, v = np.rint(FINER.project(points)).astype(int).T
    is_inside = (u >= 0) & (u < FINER.width) & (v >= 0) & (v < FINER.height)
    at_pixel = registered[v[is_inside], u[is_inside]]
    assert is_inside.sum() > 1000
    assert np.all((at_pixel > 0) & (at_pixel <= points[is_inside, 2] * (1 + 1e-6)))
    known = np.sort(points[:, 2])
    found = registered[registered > 0]
    nearest = known[np.clip(np.searchsorted(known, found * (1 - 1e-6)), 0, len(known) - 1)]
    np.testing.assert_allclose(found, nearest, rtol=2e-6)


def test_registration_to_color_and_back_returns_the_surface() -> None:
    T_color_depth = moved(0.05, 0.01, 0.02, -0.01)
    depth_m = slanted(CAMERA, np.eye(4))
    registered = register_depth(depth_m, CAMERA, FINER, T_color_depth)
    back = register_depth(registered, FINER, CAMERA, se3.inverse(T_color_depth))
    middle = np.s_[4:-4, 6:-6]
    assert np.all(back[middle] > 0)
    assert np.max(np.abs(back - depth_m)[middle] / depth_m[middle]) < 0.03


def test_both_lenses_are_accounted_for() -> None:
    """Depth and color have different lenses; the plane is at its depth after rectification."""
    depth_camera = Camera(320, 240, 290.0, 290.0, 158.0, 122.0, (-0.1, 0.08, 0.002, -0.001))
    color_camera = Camera(320, 240, 258.6, 258.2, 159.3, 127.6, FREIBURG1)
    T_color_depth = moved(0.025, 0.0, 0.01, 0.0)
    rays = cv2.undistortPoints(
        np.indices((240, 320), float)[::-1].reshape(2, -1).T.reshape(-1, 1, 2).copy(),
        depth_camera.matrix,
        np.array(depth_camera.distortion),
    ).reshape(240, 320, 2)
    measured = slanted_along(np.dstack([rays, np.ones((240, 320))]), np.eye(4))
    registered = register_depth(measured, depth_camera, color_camera, T_color_depth)
    raw = RawFrame(0, 0, np.zeros((240, 320, 3), np.uint8), registered, 1.0, color_camera)
    depth_m = Rectifier()(raw).depth_m
    truth = slanted(color_camera.rectified(), T_color_depth)
    error = np.abs(depth_m - truth)[40:-40, 50:-50] / truth[40:-40, 50:-50]
    without_lenses = register_depth(
        measured, depth_camera.rectified(), color_camera.rectified(), T_color_depth
    )
    assert np.all(depth_m[40:-40, 50:-50] > 0)
    assert error.max() < 0.006
    assert (np.abs(without_lenses - truth) / truth)[40:-40, 50:-50].max() > 0.012


def test_point_beyond_the_lens_does_not_fold_back_into_the_image() -> None:
    """This polynomial folds back at a radius of 1.05; the depth camera sees to 2."""
    wide = Camera(64, 48, 16.0, 16.0, 31.5, 23.5)
    lens = Camera(64, 48, 50.0, 50.0, 31.5, 23.5, (-0.3, 0.0, 0.0, 0.0))
    depth_m = np.full((48, 64), 2.0, np.float32)
    depth_m[16:32, 12:52] = 0.0  # The missing radius is 0.47 in v and 1.2 in u.
    registered = register_depth(depth_m, wide, lens, np.eye(4))
    assert np.all(registered[22:26] == 0)


@pytest.mark.parametrize("z_m", [-5.0, -2.0])
def test_points_behind_or_in_the_color_camera_are_not_seen(z_m: float) -> None:
    T_color_depth = np.eye(4)
    T_color_depth[2, 3] = z_m
    depth_m = np.full((48, 64), 2.0, np.float32)
    assert not np.any(register_depth(depth_m, CAMERA, CAMERA, T_color_depth))


def test_missing_depth_registers_to_missing_depth() -> None:
    depth_m = np.zeros((48, 64), np.float32)
    assert not np.any(register_depth(depth_m, CAMERA, FINER, moved(0.1)))


def test_depth_of_another_size_than_its_camera_is_an_error() -> None:
    with pytest.raises(FrameError, match="depth is 63x48 pixels, but its intrinsics are for 64x48"):
        register_depth(np.ones((48, 63), np.float32), CAMERA, FINER, np.eye(4))


def test_cells_that_cover_the_color_image_many_times_are_rejected() -> None:
    shrinking = (1e5, 0.0, 0.0, 0.0, 0.0, 7.9e5, 0.0, 0.0)  # By 7.9, just below the limit.
    color_camera = Camera(640, 480, 640.0, 480.0, 320.0, 240.0, shrinking)
    depth_camera = Camera(640, 480, 160.0, 120.0, 320.0, 240.0)
    with pytest.raises(FrameError, match="do not belong together"):
        register_depth(np.ones((480, 640), np.float32), depth_camera, color_camera, np.eye(4))


def test_cells_far_larger_than_a_depth_pixel_are_rejected() -> None:
    color_camera = Camera(640, 480, 64000.0, 48000.0, 320.0, 240.0)
    depth_camera = Camera(640, 480, 100.0, 75.0, 320.0, 240.0)
    with pytest.raises(FrameError, match="640 color pixels wide, must be at most 64"):
        register_depth(np.ones((480, 640), np.float32), depth_camera, color_camera, np.eye(4))
