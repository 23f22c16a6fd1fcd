from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError
from ldo_service.evaluation import views
from ldo_service.gaussians import DensificationConfig, GaussianMap, densify, render
from ldo_service.gaussians.cells import QuadtreeCells, quadtree
from ldo_service.gaussians.densification import (
    correct_colors,
    densification_mask,
    tiles_of,
    with_small_holes_filled,
)
from ldo_service.gaussians.renderer import RenderMemory
from ldo_service.geometry import Camera, RgbdFrame, se3

CAMERA = Camera(120, 88, 100.0, 100.0, 59.5, 43.5)
T_MAP_CAMERA = se3.exp(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))


def corner_of_a_room(T_room_camera: np.ndarray | None = None) -> RgbdFrame:
    """Return a frame of a checkerboard wall at z = 2 m and a gradient floor at y = 0.7 m."""
    T = np.eye(4) if T_room_camera is None else T_room_camera
    rays = CAMERA.rays() @ T[:3, :3].T
    to_wall, to_floor = (2 - T[2, 3]) / rays[..., 2], (0.7 - T[1, 3]) / rays[..., 1]
    on_floor = (to_floor > 0) & (to_floor < to_wall)
    depth_m = np.where(on_floor, to_floor, to_wall).astype(np.float32)
    p = T[:3, 3] + rays * depth_m[..., None]
    checker = (np.floor(p[..., 0] / 0.4) + np.floor(p[..., 1] / 0.4)) % 2
    wall = np.stack([60 + 130 * checker, 90 + 60 * checker, np.full_like(checker, 120)], -1)
    floor = np.stack([40 * p[..., 2] + 60, 150 - 30 * p[..., 2], 90 + 20 * p[..., 0]], -1)
    color = np.where(on_floor[..., None], floor, wall)
    return RgbdFrame(np.clip(color, 0, 255).astype(np.uint8), depth_m, CAMERA)


def view(gaussians: GaussianMap, T_map_camera: np.ndarray):
    return render(gaussians.rows, CAMERA, se3.inverse(T_map_camera))


def psnr(color: np.ndarray, truth: np.ndarray) -> float:
    """Return the PSNR of a rendering in 0..1 against an image in 0..255."""
    return views.psnr(color, truth / np.float32(255))


def without_depth(frame: RgbdFrame, missing: np.ndarray) -> RgbdFrame:
    depth_m = np.where(missing, 0, frame.depth_m).astype(np.float32)
    return RgbdFrame(frame.color, depth_m, frame.camera)


def with_box(frame: RgbdFrame, columns: slice) -> RgbdFrame:
    """Return the frame with a red box at a depth of 1 m."""
    depth_m, color = frame.depth_m.copy(), frame.color.copy()
    depth_m[30:50, columns], color[30:50, columns] = 1.0, (255, 0, 0)
    return RgbdFrame(color, depth_m, CAMERA)


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_mean_of_cells_in_the_middle_rows_is_that_of_their_pixels(
    channels: tuple[int, ...], dtype: type
) -> None:
    """The first row of the cells is no multiple of the largest size."""
    image = np.random.default_rng(0).uniform(0, 255, (32, 24, *channels)).astype(dtype)
    row, column = np.array([8, 10, 7, 23]), np.array([4, 20, 23, 0])
    cells = QuadtreeCells(row, column, np.array([4, 2, 1, 1]))
    expected = [
        image[r : r + size, c : c + size].astype(float).mean(axis=(0, 1))
        for r, c, size in zip(row, column, cells.size, strict=True)
    ]
    np.testing.assert_allclose(cells.mean_of(image), expected, rtol=1e-5)


@pytest.mark.parametrize("size", [1, 4, 16, 32])
def test_tiles_of_cells_are_those_of_their_pixels(size: int) -> None:
    height, width, rng = 96, 160, np.random.default_rng(size)
    chosen = rng.uniform(size=(height // size, width // size)) < 0.0004 * size**2
    chosen[-1, -1] = True
    row, column = (size * place for place in np.nonzero(chosen))
    tiles = tiles_of(QuadtreeCells(row, column, np.full(len(row), size)), height, width)
    pixels = chosen.repeat(size, axis=0).repeat(size, axis=1)
    expected = pixels.reshape(height // 16, 16, width // 16, 16).any(axis=(1, 3))
    np.testing.assert_array_equal(tiles, expected)
    assert not tiles.all()


def test_colors_are_corrected_by_a_rendering_of_the_whole_image() -> None:
    """A map of one half of the image gets the other half, in tiles with and without cells."""
    frame, gaussians = corner_of_a_room(), GaussianMap()
    half = np.zeros(frame.depth_m.shape, bool)
    half[:, 60:] = True
    uncorrected = DensificationConfig(color_steps=0)
    densify(gaussians, frame, T_MAP_CAMERA, keyframe=0, config=uncorrected, ignore_mask=half)
    before = view(gaussians, T_MAP_CAMERA)
    ids = densify(gaussians, frame, T_MAP_CAMERA, keyframe=1, config=uncorrected)
    shown, first = view(gaussians, T_MAP_CAMERA), len(gaussians) - len(ids)
    depth_m = with_small_holes_filled(frame.depth_m, uncorrected.hole_px)
    wanted = densification_mask(frame, before, uncorrected) & (depth_m > 0)
    cells = quadtree(
        frame.color, depth_m, wanted, coarsest_px=4, max_contrast=0.3, max_depth_step=0.05
    )
    expected = gaussians.colors[first:].copy()
    correct_colors(expected, cells, frame, shown.color, uncorrected.max_color_step)

    again = GaussianMap()
    densify(again, frame, T_MAP_CAMERA, keyframe=0, config=uncorrected, ignore_mask=half)
    densify(again, frame, T_MAP_CAMERA, keyframe=1, memory=RenderMemory())
    np.testing.assert_array_equal(again.colors[first:], expected)
    assert not tiles_of(cells, *wanted.shape).all()


def test_densified_frame_is_rendered_as_observed() -> None:
    frame, gaussians = corner_of_a_room(), GaussianMap()
    ids = densify(gaussians, frame, T_MAP_CAMERA, keyframe=7)
    rendering = view(gaussians, T_MAP_CAMERA)
    assert psnr(rendering.color, frame.color) > 28
    assert np.mean(rendering.opacity > 0.8) > 0.99
    error = np.abs(rendering.median_depth_m / frame.depth_m - 1)
    assert np.mean(error < 0.02) > 0.94
    np.testing.assert_array_equal(gaussians.ids, ids)
    assert set(gaussians.anchors) == {7}


def test_rendering_from_another_pose_has_no_gaps() -> None:
    gaussians = GaussianMap()
    densify(gaussians, corner_of_a_room(), np.eye(4), 0)
    T = se3.exp(np.array([0.05, 0.06, 0.02, 0.1, -0.05, 0.3]))
    rendering, truth = view(gaussians, T), corner_of_a_room(T)
    inside = np.s_[12:-12, 12:-12]
    assert np.mean(rendering.opacity[inside] > 0.8) > 0.97
    assert psnr(rendering.color[inside], truth.color[inside]) > 24


def test_textured_areas_get_more_gaussians_than_uniform_areas() -> None:
    frame = corner_of_a_room()
    flat = RgbdFrame(np.full_like(frame.color, 128), np.full_like(frame.depth_m, 2), CAMERA)
    sparse, dense = GaussianMap(), GaussianMap()
    densify(sparse, flat, np.eye(4), 0)
    densify(dense, frame, np.eye(4), 0)
    assert len(sparse) == CAMERA.width * CAMERA.height // 16
    assert len(dense) > 1.5 * len(sparse)


def test_frame_of_mapped_surface_adds_almost_no_gaussians() -> None:
    frame, gaussians = corner_of_a_room(), GaussianMap()
    first_count = len(densify(gaussians, frame, T_MAP_CAMERA, 0))
    second_count = len(densify(gaussians, frame, T_MAP_CAMERA, 1))
    assert second_count < 0.02 * first_count


def test_pixels_without_depth_get_no_gaussians() -> None:
    frame = corner_of_a_room()
    missing = np.zeros(frame.depth_m.shape, bool)
    missing[:, 50:] = True
    gaussians = GaussianMap()
    densify(gaussians, without_depth(frame, missing), np.eye(4), 0, DensificationConfig(hole_px=0))
    u = CAMERA.project(gaussians.means)[:, 0]
    assert len(gaussians) > 100
    assert u.max() < 49.6
    assert len(densify(GaussianMap(), without_depth(frame, ~missing | missing), np.eye(4), 0)) == 0


def test_small_depth_holes_are_filled_with_background_depth() -> None:
    depth_m = np.full((60, 80), 2.0, np.float32)
    depth_m[:, :20] = 1.0
    depth_m[10:50, 20:23] = 0  # Missing depth next to the near surface.
    depth_m[10:50, 45:75] = 0
    filled = with_small_holes_filled(depth_m, 4)
    np.testing.assert_array_equal(filled[10:50, 20:23], 2.0)
    assert not filled[20:40, 52:68].any()
    np.testing.assert_array_equal(filled[depth_m > 0], depth_m[depth_m > 0])


def test_surface_in_front_of_the_map_is_added() -> None:
    frame, gaussians = corner_of_a_room(), GaussianMap()
    densify(gaussians, frame, np.eye(4), 0)
    ids = densify(gaussians, with_box(frame, slice(40, 70)), np.eye(4), 1)
    assert 30 < len(ids) < 1000
    rendering = view(gaussians, np.eye(4))
    np.testing.assert_allclose(rendering.median_depth_m[34:46, 44:66], 1.0, atol=0.02)
    assert rendering.color[34:46, 44:66, 0].min() > 0.85
    assert rendering.color[34:46, 44:66, 1].max() < 0.15


def test_displaced_depth_edge_adds_no_gaussians() -> None:
    frame, gaussians = corner_of_a_room(), GaussianMap()
    densify(gaussians, with_box(frame, slice(40, 70)), np.eye(4), 0)
    displaced = with_box(frame, slice(41, 72))
    copy = GaussianMap.restore(gaussians.snapshot())
    assert len(densify(copy, displaced, np.eye(4), 1, DensificationConfig(edge_px=0))) > 50
    assert len(densify(gaussians, displaced, np.eye(4), 1)) == 0


def test_thin_surface_in_front_of_the_map_is_added() -> None:
    frame, gaussians = corner_of_a_room(), GaussianMap()
    densify(gaussians, frame, np.eye(4), 0)
    pole = with_box(frame, slice(40, 42))
    assert len(densify(gaussians, pole, np.eye(4), 1)) > 30
    assert view(gaussians, np.eye(4)).color[32:48, 40:42, 1].max() < 0.3


def test_gaussians_are_flat_and_lie_in_the_surface() -> None:
    gaussians = GaussianMap()
    densify(gaussians, corner_of_a_room(), np.eye(4), 0)
    R, scales = se3.rotation(gaussians.quats.astype(float)), np.exp(gaussians.log_scales)
    thinnest = np.take_along_axis(R, scales.argmin(1)[:, None, None], axis=2)[..., 0]
    _, y, z = gaussians.means.T
    on_wall = (np.abs(z - 2) < 1e-3) & (y < 0.62)  # Excludes the corner with its mixed normals.
    on_floor = (np.abs(y - 0.7) < 1e-3) & (z < 1.85)
    assert np.all(scales.min(1) < 0.2 * scales.max(1))
    assert np.mean(np.abs(thinnest[on_wall, 2]) > 0.99) > 0.9
    assert np.mean(np.abs(thinnest[on_floor, 1]) > 0.99) > 0.9
    assert on_floor.sum() > 20


def test_color_criterion_densifies_repainted_surface() -> None:
    frame, config = corner_of_a_room(), DensificationConfig(max_color_error=0.1)
    depth_only, with_color = GaussianMap(), GaussianMap()
    for gaussians in (depth_only, with_color):
        densify(gaussians, frame, np.eye(4), 0)
    repainted = RgbdFrame(255 - frame.color, frame.depth_m, CAMERA)
    assert len(densify(depth_only, repainted, np.eye(4), 1)) < 20
    assert len(densify(with_color, repainted, np.eye(4), 1, config)) > 300


def test_result_is_bitwise_equal_for_any_thread_count() -> None:
    maps = [GaussianMap(), GaussianMap()]
    for gaussians, threads in zip(maps, (1, 3), strict=True):
        densify(gaussians, corner_of_a_room(), T_MAP_CAMERA, 0, threads=threads)
    assert maps[0].rows.tobytes() == maps[1].rows.tobytes()


def test_image_size_that_is_no_multiple_of_a_cell_is_covered() -> None:
    frame = corner_of_a_room()
    camera = Camera(117, 86, 100.0, 100.0, 59.5, 43.5)
    cropped = RgbdFrame(
        np.ascontiguousarray(frame.color[:86, :117]), frame.depth_m[:86, :117].copy(), camera
    )
    gaussians = GaussianMap()
    densify(gaussians, cropped, np.eye(4), 0)
    rendering = render(gaussians.rows, camera, np.eye(4))
    assert np.mean(rendering.opacity > 0.5) > 0.99


def test_image_of_one_pixel_gives_one_gaussian() -> None:
    camera = Camera(1, 1, 2.0, 2.0, 0.0, 0.0)
    frame = RgbdFrame(np.full((1, 1, 3), 99, np.uint8), np.ones((1, 1), np.float32), camera)
    gaussians = GaussianMap()
    densify(gaussians, frame, np.eye(4), 0)
    np.testing.assert_allclose(gaussians.means, [[0, 0, 1]])


@pytest.mark.parametrize(
    "settings",
    [
        {"coarsest_px": 3},
        {"opacity": 1.0},
        {"max_transmittance": 0.0},
        {"sigma_per_spacing": 0.4},
        {"max_stretch": 0.5},
        {"hole_px": -1},
        {"max_contrast": float("nan")},
    ],
)
def test_invalid_settings_raise_config_error(settings: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        DensificationConfig(**settings)


def test_real_room_is_rendered_well_between_keyframes(data: Path) -> None:
    apartment = open_sequence(str(data / "replica" / "apartment_floor1"))
    truth = apartment.truth()
    assert truth is not None
    T_map_camera = truth.T_world_camera
    gaussians = GaussianMap()
    for i in (0, 5, 20, 25):
        densify(gaussians, apartment[i], T_map_camera[i], i)
    for i in (2, 22):
        rendering = render(gaussians.rows, apartment.camera, se3.inverse(T_map_camera[i]))
        covered = rendering.opacity > 0.5
        assert covered.mean() > 0.95
        assert psnr(rendering.color[covered], apartment[i].color[covered]) > 25
    assert len(gaussians) < 80_000
