import numpy as np
import pytest

from ldo_service.evaluation import contact_sheet, depth_picture, trajectory_picture
from ldo_service.evaluation.pictures import ESTIMATE, TRUTH
from ldo_service.geometry import Trajectory, se3


def circle(radius_m: float = 2.0) -> Trajectory:
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    poses = np.tile(np.eye(4), (100, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = radius_m * np.cos(angle), radius_m * np.sin(angle)
    return Trajectory(angle, poses)


def pixels_of(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Return rows and columns of the pixels of one color, below the legend."""
    return np.argwhere((picture == color).all(axis=-1)[40:])


def test_the_view_from_above_shows_a_circle_and_the_side_a_line() -> None:
    picture = trajectory_picture(circle(), None)
    above, side = np.split(picture, 2, axis=1)
    assert np.ptp(pixels_of(above, ESTIMATE), axis=0).min() > 300
    assert np.ptp(pixels_of(side, ESTIMATE)[:, 0]) < 8


def test_estimate_covers_the_truth_after_alignment() -> None:
    moved = Trajectory(circle().stamps_s, se3.exp(np.ones(6)) @ circle().T_world_camera)
    picture = trajectory_picture(moved, circle())
    assert len(pixels_of(picture, ESTIMATE)) > 500
    assert len(pixels_of(picture, TRUTH)) < 0.05 * len(pixels_of(picture, ESTIMATE))


def test_only_the_truth_of_the_time_of_the_estimate_is_drawn() -> None:
    quarter = Trajectory(circle().stamps_s[:25], circle().T_world_camera[:25])
    above, _ = np.split(trajectory_picture(quarter, circle()), 2, axis=1)
    # A quarter of the circle fills the picture. It would fill half of that of the whole circle.
    assert np.ptp(pixels_of(above, ESTIMATE), axis=0).min() > 300


def test_pictures_of_other_clocks_and_empty_estimates_are_drawn() -> None:
    late = Trajectory(circle().stamps_s + 1e4, circle().T_world_camera)
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    assert trajectory_picture(late, circle()).dtype == np.uint8
    assert len(pixels_of(trajectory_picture(empty, circle()), TRUTH)) > 500
    assert trajectory_picture(empty, None).ndim == 3


def test_trajectory_of_a_static_camera_is_drawn() -> None:
    still = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    assert trajectory_picture(still, still).shape == trajectory_picture(circle(), None).shape


def test_missing_depth_is_black_and_near_is_red() -> None:
    depth_m = np.linspace(1, 4, 50, dtype=np.float32).reshape(5, 10)
    depth_m[2, 2], depth_m[3, 3] = 0, np.nan
    picture = depth_picture(depth_m)
    assert not picture[2, 2].any()
    assert not picture[3, 3].any()
    assert picture[0, 0, 0] > picture[0, 0, 2]
    assert picture[4, 9, 2] > picture[4, 9, 1]
    assert not depth_picture(np.zeros((5, 10), np.float32)).any()


def test_contact_sheet_places_images_under_their_captions() -> None:
    red, blue = (np.full((20, 30, 3), color, np.uint8) for color in ((255, 0, 0), (0, 0, 255)))
    sheet = contact_sheet([[red, blue], [blue, red]], ["a", "b"])
    half = sheet.shape[1] // 2
    assert (sheet[30, half - 10] == (255, 0, 0)).all()
    assert (sheet[30, half + 10] == (0, 0, 255)).all()
    assert (sheet[-10, half - 10] == (0, 0, 255)).all()


def test_images_of_another_size_are_scaled_to_fit() -> None:
    small, tall = np.zeros((20, 30, 3), np.uint8), np.zeros((200, 100, 3), np.uint8)
    assert (
        contact_sheet([[small], [tall]], ["a"]).shape == contact_sheet([[small]] * 2, ["a"]).shape
    )


def test_row_with_another_number_of_images_than_captions_is_rejected() -> None:
    with pytest.raises(ValueError, match="one image per caption"):
        contact_sheet([[np.zeros((2, 2, 3), np.uint8)]], ["a", "b"])
