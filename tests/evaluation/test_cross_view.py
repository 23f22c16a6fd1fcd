"""Agreement of labels between two cameras 0.1 m apart, before a wall at 2 m."""

import numpy as np
import pytest

from ldo_service.evaluation.label_measures import Agreement, agreement, correspondences
from ldo_service.geometry import Camera, RgbdFrame, se3

CAMERA = Camera(20, 10, 100.0, 100.0, 9.5, 4.5)  # The wall moves by 5 px between the cameras.
T_SECOND_FIRST = se3.inverse(se3.exp(np.array([0, 0, 0, 0.1, 0, 0])))  # A step to the right.
CHAIR, COUCH = 2, 3


def wall(depth_m: float = 2.0) -> RgbdFrame:
    size = (CAMERA.height, CAMERA.width)
    depth = np.full(size, depth_m, np.float32)
    return RgbdFrame(np.zeros((*size, 3), np.uint8), depth, CAMERA)


def columns(first: int, last: int, label: int = CHAIR) -> np.ndarray:
    image = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    image[:, first : last + 1] = label
    return image


def agreement_of(first, second, first_view=None, second_view=None) -> Agreement:
    views = first_view or wall(), second_view or wall()
    return agreement(first, second, correspondences(*views, T_SECOND_FIRST))


def test_object_labelled_on_the_same_surface_agrees_everywhere() -> None:
    found = agreement_of(columns(8, 11), columns(3, 6))
    assert found == Agreement(40, 40)
    assert found.share == 1


def test_label_at_the_same_pixels_agrees_only_where_it_overlaps() -> None:
    # Columns 8..11 are at 3..6, and 8..11 of the second view are at 13..16 of the first.
    assert agreement_of(columns(8, 11), columns(8, 11)) == Agreement(0, 80)
    # Columns 8..15 are at 3..10: 8..10 are both; 11..15 are seen from 16..19, one out of view.
    assert agreement_of(columns(8, 15), columns(8, 15)) == Agreement(30, 120)


def test_two_names_for_one_object_disagree() -> None:
    assert agreement_of(columns(8, 11), columns(3, 6, COUCH)) == Agreement(0, 40)


def test_pixels_outside_the_second_view_are_not_counted() -> None:
    assert agreement_of(columns(0, 6), columns(0, 1)) == Agreement(20, 20)


def test_pixels_of_another_surface_or_without_depth_are_not_counted() -> None:
    images = columns(8, 11), columns(3, 6)
    assert agreement_of(*images, second_view=wall(2.1)).objects == 0
    assert agreement_of(*images, second_view=wall(2.03)).objects == 40
    assert agreement_of(*images, second_view=wall(0)).objects == 0
    assert agreement_of(*images, first_view=wall(0)).objects == 0


def test_background_alone_has_no_agreement() -> None:
    assert np.isnan(agreement_of(columns(1, 0), columns(1, 0)).share)


def test_counts_of_pairs_are_pooled() -> None:
    assert (Agreement(30, 40) + Agreement(0, 20)).share == pytest.approx(0.5)
