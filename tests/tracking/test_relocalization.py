from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.tracking import AlignConfig, PyramidConfig, pyramid_of
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import (
    KeyframeDatabase,
    KeyframeDatabaseConfig,
    KeyframeRecord,
    make_keyframe_record,
    make_thumbnail,
)
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.relocalization import RelocalizationConfig, Relocalizer
from ldo_service.tracking.tracking_quality import ResidualHistory, TrackingQualityConfig

T_AWAY = se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
T_NEAR = se3.exp(np.array([0.03, -0.15, 0.05, 0.15, 0.05, 0.1]))
T_BEHIND = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))


def relocalizer(config: RelocalizationConfig | None = None) -> Relocalizer:
    return Relocalizer(
        PyramidConfig(),
        AlignConfig(),
        FeatureConfig(),
        TrackingQualityConfig(),
        config or RelocalizationConfig(),
    )


def place_at(room, T_odom_keyframe: np.ndarray, number: int) -> KeyframeRecord:
    view = pyramid_of(room.view(T_odom_keyframe), PyramidConfig())
    keyframe = ReferenceKeyframe(view, T_odom_keyframe, number)
    return make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig())


@pytest.fixture(scope="module")
def places(large_room) -> KeyframeDatabase:
    return KeyframeDatabase((place_at(large_room, np.eye(4), 0), place_at(large_room, T_AWAY, 1)))


def found(places: KeyframeDatabase, frame: RgbdFrame, turn: int = 0, **fields):
    view = pyramid_of(frame, PyramidConfig())
    finder = relocalizer(RelocalizationConfig(**fields))
    return finder.find(view, places, turn, ResidualHistory())


def test_right_keyframe_is_found_whatever_its_age(large_room, places) -> None:
    for number, T_odom_keyframe in enumerate((np.eye(4), T_AWAY)):
        place = found(places, large_room.view(T_odom_keyframe @ T_NEAR))
        assert place is not None
        keyframe, candidate = place
        assert keyframe.id == number
        np.testing.assert_allclose(candidate.alignment.T_reference_camera, T_NEAR, atol=1e-3)


def test_unknown_place_is_not_recognized(large_room, places) -> None:
    assert found(places, large_room.view(T_BEHIND)) is None
    assert found(places, large_room.blank()) is None


def test_without_places_nothing_is_found(large_room) -> None:
    assert found(KeyframeDatabase(), large_room.view(np.eye(4))) is None


def test_each_place_has_its_turn_however_unlike_its_thumbnail(large_room) -> None:
    crowd = KeyframeDatabase(
        (
            *(place_at(large_room, T_BEHIND, number) for number in range(4)),
            place_at(large_room, np.eye(4), 4),
        )
    )
    frame = large_room.view(T_NEAR)
    options = {"alike": 0, "in_turn": 2, "across_scales": 0}
    turns = [found(crowd, frame, turn, **options) for turn in range(5)]
    assert [place is not None for place in turns] == [False, False, True, False, True]


def test_a_place_is_known_again_from_far_behind_it(large_room, places) -> None:
    T_far = se3.exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, -2.4]))
    frame = large_room.view(T_far)
    place = found(places, frame)
    assert place is not None
    np.testing.assert_allclose(place[1].alignment.T_reference_camera, T_far, atol=1e-3)
    assert found(places, frame, across_scales=0) is None, "ORB is enough"


def test_who_is_not_lost_is_looked_for_by_what_is_fast(large_room, places) -> None:
    view = pyramid_of(large_room.view(se3.exp(np.array([0, 0.05, 0, 0, 0, -2.4]))), PyramidConfig())
    assert relocalizer().find(view, places, 0, ResidualHistory(), is_lost=False) is None


def test_a_place_is_refused_when_features_and_images_disagree(large_room, places) -> None:
    assert found(places, large_room.view(T_NEAR), agreement_rad=1e-6) is None


def test_a_view_that_two_distant_places_explain_is_not_found(large_room, places) -> None:
    twin = replace(places.all[0], id=7, T_odom_keyframe=T_BEHIND)
    near = replace(places.all[0], id=7, T_odom_keyframe=se3.exp(np.full(6, 0.1)))
    frame = large_room.view(T_NEAR)
    assert found(KeyframeDatabase((*places.all, twin)), frame) is None
    assert found(KeyframeDatabase((*places.all, near)), frame) is not None, (
        "as far as odometry drifts"
    )


def test_likely_places_are_of_different_neighborhoods(large_room, places) -> None:
    here = places.all[0]
    crowd = [replace(here, id=k, T_odom_keyframe=se3.exp(np.full(6, 1e-3 * k))) for k in range(6)]
    view = pyramid_of(large_room.view(T_AWAY), PyramidConfig())
    finder, crowded = (
        relocalizer(RelocalizationConfig(alike=2)),
        KeyframeDatabase((*crowd, places.all[1])),
    )
    chosen = finder._distinct_candidates(
        crowded.all[index] for index in crowded.rank_by_similarity(view)
    )
    assert {place.id for place in chosen} >= {1}
    assert len(chosen) == 2


def test_another_place_is_not_familiar_and_a_darker_image_is(large_room) -> None:
    trusted = make_thumbnail(pyramid_of(large_room.view(np.eye(4)), PyramidConfig()))
    for frame, familiar in (
        (large_room.view(np.eye(4), 0.5, 10.0), True),
        (large_room.view(T_BEHIND), False),
        (large_room.blank(), False),
    ):
        assert (
            relocalizer().resembles_last_trusted(pyramid_of(frame, PyramidConfig()), trusted)
            is familiar
        )


@pytest.mark.parametrize(
    "fields",
    [
        {"alike": 0, "in_turn": 0},
        {"attempts": 0},
        {"min_geometric_inliers": 1.5},
        {"agreement_rad": 0.0},
    ],
)
def test_impossible_limits_are_refused(fields) -> None:
    with pytest.raises(ConfigError):
        RelocalizationConfig(**fields)
