import numpy as np

from ldo_service.gaussians.views import View, schedule, shared_surface
from ldo_service.geometry import Camera, RgbdFrame, se3

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


def view_at(x_m: float, *, turned: bool = False, depth_m: float = 2.0) -> View:
    """A view of a wall, moved to the right; or of what is behind it."""
    color, depth = np.zeros((48, 64, 3), np.uint8), np.full((48, 64), depth_m, np.float32)
    T = se3.exp(np.array([0, np.pi * 0.99 * turned, 0, 0, 0, 0]))
    T[0, 3] = x_m
    return View.of(RgbdFrame(color, depth, CAMERA), T, round(100 * x_m))


def test_view_shares_all_with_itself_and_nothing_with_what_lies_behind() -> None:
    assert shared_surface(view_at(0), view_at(0), step_px=4) == 1
    assert shared_surface(view_at(0), view_at(0, turned=True), step_px=4) == 0
    assert shared_surface(view_at(0, depth_m=0), view_at(0), step_px=4) == 0


def test_shared_surface_is_the_overlap_of_the_images() -> None:
    # 1.28 m at 2 m depth are 32 of 64 pixels
    np.testing.assert_allclose(shared_surface(view_at(0), view_at(1.28), step_px=4), 0.5, atol=0.07)


def test_shares_of_a_schedule_are_those_asked_for() -> None:
    views = [view_at(x) for x in (9.0, 5.0, 0.3, 7.0, 0.0)]
    taken = schedule(views, 4000, np.random.default_rng(0), newest_share=0.3, covisible_share=0.5)
    share = np.bincount(taken, minlength=5) / len(taken)
    assert taken[0] == 4
    np.testing.assert_allclose(share, [0.04, 0.04, 0.54, 0.04, 0.34], atol=0.03)


def test_newest_stands_in_for_covisible_views_where_there_are_none() -> None:
    views = [view_at(9.0), view_at(0.0)]
    taken = schedule(views, 200, np.random.default_rng(0), newest_share=0.0, covisible_share=1.0)
    assert set(taken) == {1}


def test_schedule_is_that_of_its_generator() -> None:
    views = [view_at(0.1 * k) for k in range(6)]
    one, same, other = (
        schedule(views, 50, np.random.default_rng(seed), newest_share=0.2, covisible_share=0.2)
        for seed in (3, 3, 4)
    )
    assert one == same
    assert one != other


def test_colours_of_a_view_are_those_of_its_frame() -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (48, 64, 3), np.uint8)
    frame = RgbdFrame(color, np.ones((48, 64), np.float32), CAMERA)
    view = View.of(frame, np.eye(4), 5)
    assert view.color.flags.c_contiguous
    np.testing.assert_array_equal(view.color[1], color[..., 1])
