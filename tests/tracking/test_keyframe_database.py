from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
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
from ldo_service.tracking.pose_candidates import align_hypothesis
from ldo_service.tracking.tracking_quality import ResidualHistory


def turned(angle_rad: float) -> np.ndarray:
    return se3.exp(np.array([0.0, angle_rad, 0.0, 0.0, 0.0, 0.0]))


def keyframe_at(room, T_odom_keyframe: np.ndarray, number: int = 0) -> ReferenceKeyframe:
    view = pyramid_of(room.view(T_odom_keyframe), PyramidConfig())
    return ReferenceKeyframe(view, T_odom_keyframe, number)


def place_at(room, T_odom_keyframe: np.ndarray, number: int = 0) -> KeyframeRecord:
    return make_keyframe_record(
        keyframe_at(room, T_odom_keyframe, number), FeatureConfig(), KeyframeDatabaseConfig()
    )


def test_a_frame_is_aligned_to_a_place_as_to_its_keyframe(make_room) -> None:
    room = make_room(640, 480)  # halved once to the working resolution, which a place keeps
    keyframe, T = keyframe_at(room, np.eye(4)), se3.exp(np.array([0, 0.03, 0, 0.02, 0, 0.01]))
    place = make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig())
    view = pyramid_of(room.view(T), PyramidConfig())
    for reference in (keyframe, place.keyframe(PyramidConfig())):
        candidate = align_hypothesis(reference, view, np.eye(4), "direct", AlignConfig())
        np.testing.assert_allclose(candidate.alignment.T_reference_camera, T, atol=1e-3)


def test_a_place_is_small_and_survives_packing_bit_for_bit(make_room) -> None:
    room = make_room(640, 480)
    place = place_at(room, np.eye(4))
    full = 640 * 480 * 5  # grey level and depth
    assert place.nbytes < full / 5
    again = KeyframeRecord.unpack(place.pack())
    assert again.keyframe(PyramidConfig()).view.gray.tobytes() == (
        place.keyframe(PyramidConfig()).view.gray.tobytes()
    )
    assert again.camera == place.camera


def test_features_of_a_place_all_have_a_point_that_projects_to_them(large_room) -> None:
    features = place_at(large_room, np.eye(4)).features
    assert len(features.pixels) > 100
    assert (features.points_camera[:, 2] > 0).all()
    assert (features.pixels > -1).all()
    assert (features.pixels < [321, 241]).all()


def test_a_thumbnail_knows_neither_brightness_nor_contrast(large_room) -> None:
    plain = make_thumbnail(pyramid_of(large_room.view(np.eye(4)), PyramidConfig()))
    dark = make_thumbnail(pyramid_of(large_room.view(np.eye(4), 0.6, 20.0), PyramidConfig()))
    assert np.abs(plain.astype(int) - dark).max() <= 2
    blank = make_thumbnail(pyramid_of(large_room.blank(), PyramidConfig()))
    assert not blank.any()


def test_the_place_that_looks_like_the_view_comes_first(room) -> None:
    angles = (0.0, 0.8, 1.6, 2.4, 3.2)
    places = KeyframeDatabase(tuple(place_at(room, turned(a), k) for k, a in enumerate(angles)))
    for number, angle in enumerate(angles):
        view = pyramid_of(room.view(turned(angle + 0.03), 1.2, 5.0), PyramidConfig())
        ranked = places.rank_by_similarity(view)
        assert ranked[0] == number
        assert sorted(ranked) == list(range(len(angles)))


def test_a_full_memory_thins_the_path_where_it_is_densest(room) -> None:
    config, places = KeyframeDatabaseConfig(count=4), KeyframeDatabase()
    for number, angle in enumerate((0.0, 0.3, 0.6, 0.65, 0.9, 1.2)):
        places = places.with_record(place_at(room, turned(angle), number), config)
    assert len(places) == 4
    kept = [place.id for place in places.all]
    assert kept[0] == 0, "the first stays"
    assert kept[-1] == 5, "and the newest"
    assert not {2, 3} <= set(kept), "of two that are nearly one, one is enough"


def test_on_a_round_the_newest_look_at_a_place_stays_and_no_more(room) -> None:
    config, places = KeyframeDatabaseConfig(recent=2), KeyframeDatabase()
    angles, offsets = (0.0, 0.3, 0.6, 0.9, 1.2), (0.0, 0.02, -0.02)
    around = [angle + offset for offset in offsets for angle in angles]
    for number, angle in enumerate(around):
        places = places.with_record(place_at(room, turned(angle), number), config)
    assert [place.id for place in places.all] == [10, 11, 12, 13, 14]


def test_what_is_half_a_step_away_or_in_another_submap_is_another_place(room) -> None:
    config = KeyframeDatabaseConfig(recent=0)
    first = place_at(room, np.eye(4), 0)
    places = KeyframeDatabase((first, replace(first, id=1, submap=1)))
    places = places.with_record(place_at(room, turned(config.same + 0.01), 2), config)
    assert [place.id for place in places.all] == [0, 1, 2]
    places = places.with_record(place_at(room, turned(0.01), 3), config)
    assert [place.id for place in places.all] == [1, 2, 3]


def test_a_memory_of_two_places_is_refused() -> None:
    with pytest.raises(ConfigError, match="count"):
        KeyframeDatabaseConfig(count=2)


def test_a_place_knows_the_noise_of_its_surroundings(room) -> None:
    past = ResidualHistory((3.0, 9.0, 4.0), (1.0, 0.5, 2.0))
    place = make_keyframe_record(
        keyframe_at(room, np.eye(4)), FeatureConfig(), KeyframeDatabaseConfig(), past
    )
    assert place.history(ResidualHistory()) == ResidualHistory((4.0,), (1.0,))
    assert place_at(room, np.eye(4)).history(past) is past, "the first of all knows none"


def test_a_place_keeps_nothing_of_what_moves(room) -> None:
    view = pyramid_of(room.view(np.eye(4)), PyramidConfig())
    left_out = np.zeros(view.levels[0].depth_m.shape, bool)
    left_out[:, :80] = True
    place = make_keyframe_record(
        ReferenceKeyframe(view, np.eye(4), 0, ignore_mask=left_out),
        FeatureConfig(),
        KeyframeDatabaseConfig(),
    )
    rebuilt = place.keyframe(PyramidConfig()).view.levels[0].texels
    assert not rebuilt[:, :80].any()
    assert rebuilt[5:-5, 90:, 3].all()
    columns = place.camera.project(place.points_camera.astype(np.float64))[:, 0]
    assert len(columns) > 20
    assert columns.min() > 79
