"""Foreground of a keyframe in front of the background that older keyframes measured."""

import numpy as np
import pytest

from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.tracking import OdometryConfig
from ldo_service.tracking.background import with_foreground
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import (
    KeyframeDatabase,
    KeyframeDatabaseConfig,
    make_keyframe_record,
)
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.pyramid import Pyramid, pyramid_of
from ldo_service.tracking.tracking_quality import TrackingStatus
from ldo_service.tracking.tracking_result import TrackedFrame

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
CONFIG = OdometryConfig()
WALL_M, PERSON_M = 3.0, 2.2
STANDING = np.s_[60:220, 100:160]  # Pixels of a person who stands still.
WALKING = np.s_[60:220, 240:300]  # Pixels of a person who walks.


def view_of(*people: tuple[slice, slice]) -> Pyramid:
    """Return a view of a textured wall with people in front of it."""
    depth_m = np.full((240, 320), WALL_M, np.float32)
    for person in people:
        depth_m[person] = PERSON_M
    gray = np.random.default_rng(0).integers(40, 200, (240, 320, 1))
    color = np.repeat(gray, 3, axis=2).astype(np.uint8)
    return pyramid_of(RgbdFrame(color, depth_m, CAMERA), CONFIG.pyramid)


def record_of(view: Pyramid, number: int, T_odom_keyframe: np.ndarray):
    keyframe = ReferenceKeyframe(view, T_odom_keyframe, number)
    return make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig())


def mask_of(*regions: tuple[slice, slice]) -> np.ndarray:
    mask = np.zeros((240, 320), bool)
    for region in regions:
        mask[region] = True
    return mask


def frame_with(dynamic_mask: np.ndarray | None) -> TrackedFrame:
    return TrackedFrame(
        TrackingStatus.OK, "direct", np.eye(4), dynamic_mask=dynamic_mask, depth_noise_scale=0.5
    )


def test_person_who_stands_still_is_masked_while_another_one_walks() -> None:
    view = view_of(STANDING, WALKING)
    empty = record_of(view_of(), 0, np.eye(4))
    recent = record_of(view_of(STANDING), 7, np.eye(4))
    tracked = with_foreground(
        frame_with(mask_of(WALKING)), view, KeyframeDatabase((recent, empty)), CONFIG
    )
    assert tracked.dynamic_mask is not None
    people = mask_of(STANDING, WALKING)
    assert tracked.dynamic_mask[people].mean() > 0.95
    assert tracked.dynamic_mask[~people].mean() < 0.05


def test_standing_object_is_mapped_if_nothing_moves() -> None:
    empty = record_of(view_of(), 0, np.eye(4))
    still = frame_with(mask_of())
    assert with_foreground(still, view_of(STANDING), KeyframeDatabase((empty,)), CONFIG) is still


@pytest.mark.parametrize("known", ["no record", "a far record", "a wrong pose", "the same people"])
def test_mask_stays_without_a_background(known: str) -> None:
    far = se3.exp(np.array([0.0, 0.8, 0.0, 0.0, 0.0, 0.0]))
    wrong = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.12]))  # Drift of odometry.
    records = {
        "no record": [],
        "a wrong pose": [record_of(view_of(), 0, wrong)],
        "a far record": [record_of(view_of(), 0, far)],
        "the same people": [record_of(view_of(STANDING, WALKING), 0, np.eye(4))],
    }[known]
    tracked = frame_with(mask_of(WALKING))
    found = with_foreground(
        tracked, view_of(STANDING, WALKING), KeyframeDatabase(tuple(records)), CONFIG
    )
    assert found.dynamic_mask is not None
    assert np.array_equal(found.dynamic_mask, mask_of(WALKING))


def test_masked_people_stay_ignored_when_more_surface_has_moved() -> None:
    view = view_of(STANDING, WALKING)
    keyframe = ReferenceKeyframe(view, np.eye(4), 0, ignore_mask=mask_of(STANDING))
    moved = keyframe.with_moved(mask_of(WALKING), CONFIG.moving)
    assert moved.ignore_mask is not None
    assert moved.ignore_mask[STANDING].all()
    assert moved.ignore_mask[WALKING].all()
