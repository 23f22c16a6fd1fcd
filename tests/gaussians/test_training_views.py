import numpy as np

from ldo_service.gaussians.training_views import (
    TrainingView,
    covisibility_ratio,
    sample_training_views,
    sampled_surface,
)
from ldo_service.geometry import Camera, RgbdFrame, se3

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


def view_at(x_m: float, *, turned: bool = False, depth_m: float = 2.0) -> TrainingView:
    """A view of a wall, moved to the right; or of what is behind it."""
    color, depth = np.zeros((48, 64, 3), np.uint8), np.full((48, 64), depth_m, np.float32)
    T = se3.exp(np.array([0, np.pi * 0.99 * turned, 0, 0, 0, 0]))
    T[0, 3] = x_m
    return TrainingView.of(RgbdFrame(color, depth, CAMERA), T, round(100 * x_m))


def shared(newest: TrainingView, other: TrainingView) -> float:
    surface = sampled_surface(newest, step_px=4)
    return covisibility_ratio(surface, other.camera, other.T_map_camera)


def test_view_shares_all_with_itself_and_nothing_with_what_lies_behind() -> None:
    assert shared(view_at(0), view_at(0)) == 1
    assert shared(view_at(0), view_at(0, turned=True)) == 0
    assert shared(view_at(0, depth_m=0), view_at(0)) == 0


def test_shared_surface_is_the_overlap_of_the_images() -> None:
    # 1.28 m at 2 m depth are 32 of 64 pixels
    np.testing.assert_allclose(shared(view_at(0), view_at(1.28)), 0.5, atol=0.07)


def planned(seed: int = 0, *, iterations: int = 4000, newest: float, covisible: float, near=(2,)):
    return sample_training_views(
        4,
        near,
        (0, 1, 2, 3),
        iterations,
        np.random.default_rng(seed),
        newest_share=newest,
        covisible_share=covisible,
    )


def test_shares_of_a_schedule_are_those_asked_for() -> None:
    taken = planned(newest=0.3, covisible=0.5)
    share = np.bincount(taken, minlength=5) / len(taken)
    assert taken[0] == 4
    np.testing.assert_allclose(share, [0.05, 0.05, 0.55, 0.05, 0.3], atol=0.03)


def test_newest_stands_in_for_covisible_keyframes_where_there_are_none() -> None:
    assert set(planned(newest=0.0, covisible=1.0, near=())) == {4}


def test_schedule_is_that_of_its_generator() -> None:
    one, same, other = (
        planned(seed, iterations=50, newest=0.2, covisible=0.2) for seed in (3, 3, 4)
    )
    assert one == same
    assert one != other


def test_colors_of_a_view_are_those_of_its_frame() -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (48, 64, 3), np.uint8)
    frame = RgbdFrame(color, np.ones((48, 64), np.float32), CAMERA)
    view = TrainingView.of(frame, np.eye(4), 5)
    assert view.color.flags.c_contiguous
    np.testing.assert_array_equal(view.color[1], color[..., 1])
