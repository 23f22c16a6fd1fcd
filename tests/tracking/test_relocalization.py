from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.tracking import AlignConfig, PyramidConfig, pyramid_of
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import (
    KeyframeDatabase,
    make_thumbnail,
)
from ldo_service.tracking.relocalization import RelocalizationConfig, Relocalizer
from ldo_service.tracking.tracking_quality import ResidualHistory, TrackingQualityConfig
from tests.tracking.scenes import record_at

T_AWAY = se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
T_NEAR = se3.exp(np.array([0.03, -0.15, 0.05, 0.15, 0.05, 0.1]))
T_BEHIND = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))


def make_relocalizer(config: RelocalizationConfig | None = None) -> Relocalizer:
    return Relocalizer(
        PyramidConfig(),
        AlignConfig(),
        FeatureConfig(),
        TrackingQualityConfig(),
        config or RelocalizationConfig(),
    )


@pytest.fixture(scope="module")
def database(large_room) -> KeyframeDatabase:
    return KeyframeDatabase((record_at(large_room, np.eye(4), 0), record_at(large_room, T_AWAY, 1)))


def find_match(database: KeyframeDatabase, frame: RgbdFrame, turn: int = 0, **fields):
    view = pyramid_of(frame, PyramidConfig())
    relocalizer = make_relocalizer(RelocalizationConfig(**fields))
    return relocalizer.find(view, database, turn, ResidualHistory())


def test_right_keyframe_is_found_whatever_its_age(large_room, database) -> None:
    for number, T_odom_keyframe in enumerate((np.eye(4), T_AWAY)):
        match = find_match(database, large_room.view(T_odom_keyframe @ T_NEAR))
        assert match is not None
        keyframe, candidate = match
        assert keyframe.id == number
        np.testing.assert_allclose(candidate.alignment.T_reference_camera, T_NEAR, atol=1e-3)


def test_unknown_view_is_not_relocalized(large_room, database) -> None:
    assert find_match(database, large_room.view(T_BEHIND)) is None
    assert find_match(database, large_room.blank()) is None


def test_empty_database_gives_no_match(large_room) -> None:
    assert find_match(KeyframeDatabase(), large_room.view(np.eye(4))) is None


def test_every_record_is_tried_in_turn_even_with_another_thumbnail(large_room) -> None:
    crowd = KeyframeDatabase(
        (
            *(record_at(large_room, T_BEHIND, number) for number in range(4)),
            record_at(large_room, np.eye(4), 4),
        )
    )
    frame = large_room.view(T_NEAR)
    options = {"appearance_candidates": 0, "in_turn": 2, "across_scales": 0}
    turns = [find_match(crowd, frame, turn, **options) for turn in range(5)]
    assert [match is not None for match in turns] == [False, False, True, False, True]


def test_record_is_found_from_far_behind_it(large_room, database) -> None:
    T_far = se3.exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, -2.4]))
    frame = large_room.view(T_far)
    match = find_match(database, frame)
    assert match is not None
    np.testing.assert_allclose(match[1].alignment.T_reference_camera, T_far, atol=1e-3)
    assert find_match(database, frame, across_scales=0) is None, "ORB alone must not find it"


def test_sift_is_not_used_while_the_camera_is_not_lost(large_room, database) -> None:
    view = pyramid_of(large_room.view(se3.exp(np.array([0, 0.05, 0, 0, 0, -2.4]))), PyramidConfig())
    assert make_relocalizer().find(view, database, 0, ResidualHistory(), is_lost=False) is None


def test_record_is_rejected_when_features_and_images_disagree(large_room, database) -> None:
    assert find_match(database, large_room.view(T_NEAR), agreement_rad=1e-6) is None


def test_view_that_two_distant_records_explain_is_rejected(large_room, database) -> None:
    distant = replace(database.all[0], id=7, T_odom_keyframe=T_BEHIND)
    nearby = replace(database.all[0], id=7, T_odom_keyframe=se3.exp(np.full(6, 0.1)))
    frame = large_room.view(T_NEAR)
    assert find_match(KeyframeDatabase((*database.all, distant)), frame) is None
    assert find_match(KeyframeDatabase((*database.all, nearby)), frame) is not None, (
        "the records are closer than the drift of odometry"
    )


def test_candidates_are_of_different_neighborhoods(large_room, database) -> None:
    here = database.all[0]
    crowd = [replace(here, id=k, T_odom_keyframe=se3.exp(np.full(6, 1e-3 * k))) for k in range(6)]
    view = pyramid_of(large_room.view(T_AWAY), PyramidConfig())
    relocalizer, crowded_database = (
        make_relocalizer(RelocalizationConfig(appearance_candidates=2)),
        KeyframeDatabase((*crowd, database.all[1])),
    )
    candidates = relocalizer._distinct_candidates(
        crowded_database.all[index] for index in crowded_database.rank_by_similarity(view)
    )
    assert {record.id for record in candidates} >= {1}
    assert len(candidates) == 2


def test_darker_image_resembles_the_last_trusted_view_and_another_does_not(large_room) -> None:
    trusted = make_thumbnail(pyramid_of(large_room.view(np.eye(4)), PyramidConfig()))
    for frame, familiar in (
        (large_room.view(np.eye(4), 0.5, 10.0), True),
        (large_room.view(T_BEHIND), False),
        (large_room.blank(), False),
    ):
        assert (
            make_relocalizer().resembles_last_trusted(pyramid_of(frame, PyramidConfig()), trusted)
            is familiar
        )


@pytest.mark.parametrize(
    "fields",
    [
        {"appearance_candidates": 0, "in_turn": 0},
        {"attempts": 0},
        {"min_geometric_inliers": 1.5},
        {"agreement_rad": 0.0},
    ],
)
def test_impossible_limits_are_rejected(fields) -> None:
    with pytest.raises(ConfigError):
        RelocalizationConfig(**fields)
