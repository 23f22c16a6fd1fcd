from dataclasses import replace

import numpy as np
import pytest

from ldo_service.gaussians.training_views import (
    TrainingView,
    covisibility_ratio,
    sample_training_views,
    sampled_surface,
)
from ldo_service.geometry import Camera, RgbdFrame, se3

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


def view_at(x_m: float, *, is_opposite: bool = False, depth_m: float = 2.0) -> TrainingView:
    """Return a view of a wall from x_m to the right, or of the opposite direction."""
    color, depth = np.zeros((48, 64, 3), np.uint8), np.full((48, 64), depth_m, np.float32)
    T = se3.exp(np.array([0, np.pi * 0.99 * is_opposite, 0, 0, 0, 0]))
    T[0, 3] = x_m
    return TrainingView.of(RgbdFrame(color, depth, CAMERA), T, round(100 * x_m))


def covisibility(newest: TrainingView, other: TrainingView) -> float:
    surface = sampled_surface(newest, step_px=4)
    return covisibility_ratio(surface, other.camera, other.T_map_camera)


def test_covisibility_is_one_with_itself_and_zero_with_opposite_view() -> None:
    assert covisibility(view_at(0), view_at(0)) == 1
    assert covisibility(view_at(0), view_at(0, is_opposite=True)) == 0
    assert covisibility(view_at(0, depth_m=0), view_at(0)) == 0


def test_covisibility_equals_image_overlap() -> None:
    # 1.28 m at 2 m depth are 32 of 64 pixels.
    np.testing.assert_allclose(covisibility(view_at(0), view_at(1.28)), 0.5, atol=0.07)


def sampled_views(
    seed: int = 0, *, iterations: int = 4000, newest: float, covisible: float, near=(2,)
):
    return sample_training_views(
        4,
        near,
        (0, 1, 2, 3),
        iterations,
        np.random.default_rng(seed),
        newest_share=newest,
        covisible_share=covisible,
    )


def test_sampled_fractions_match_the_settings() -> None:
    views = sampled_views(newest=0.3, covisible=0.5)
    fractions = np.bincount(views, minlength=5) / len(views)
    assert views[0] == 4
    np.testing.assert_allclose(fractions, [0.05, 0.05, 0.55, 0.05, 0.3], atol=0.03)


def test_newest_view_replaces_missing_covisible_views() -> None:
    assert set(sampled_views(newest=0.0, covisible=1.0, near=())) == {4}


def test_samples_depend_only_on_the_seed() -> None:
    one, same, other = (
        sampled_views(seed, iterations=50, newest=0.2, covisible=0.2) for seed in (3, 3, 4)
    )
    assert one == same
    assert one != other


def test_view_has_the_colors_of_its_frame() -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (48, 64, 3), np.uint8)
    frame = RgbdFrame(color, np.ones((48, 64), np.float32), CAMERA)
    view = TrainingView.of(frame, np.eye(4), 5)
    assert view.color.flags.c_contiguous
    np.testing.assert_array_equal(view.color[1], color[..., 1])


def test_halved_view_averages_blocks_of_four_pixels() -> None:
    rng = np.random.default_rng(0)
    camera = Camera(65, 49, 50.0, 50.0, 32.0, 24.0)  # The last row and column have no block.
    depth_m = np.full((49, 65), 2.0, np.float32)
    depth_m[10, 20], depth_m[30:32, 40:42] = 0.0, 0.0
    depth_m[20, 30] = 1.0  # The other three pixels of its block show a surface behind it.
    mask = np.ones((49, 65), np.uint8)
    mask[5, 7] = 0
    view = TrainingView(
        3, camera, rng.integers(0, 256, (3, 49, 65), np.uint8), depth_m, np.eye(4), mask=mask
    )
    half = view.halved()
    assert half.camera == camera.halved()
    means = view.color[:, :48, :64].reshape(3, 24, 2, 32, 2).mean(axis=(2, 4))
    assert np.abs(half.color - means).max() <= 0.5
    assert half.depth_m[10, 15] == pytest.approx(1.75)
    assert (half.depth_m[5, 10], half.depth_m[15, 20], half.depth_m[0, 0]) == (0.0, 0.0, 2.0)
    assert half.mask is not None
    assert list(zip(*np.nonzero(half.mask == 0), strict=True)) == [(2, 3)]
    assert replace(view, mask=None).halved().mask is None
