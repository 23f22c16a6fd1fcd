from dataclasses import replace

import numpy as np

from ldo_service.tracking import PyramidConfig, pyramid_of
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import (
    KeyframeDatabase,
    KeyframeDatabaseConfig,
    make_keyframe_record,
)
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.motion_segmentation import MotionEvidence
from ldo_service.tracking.state import OdometryState, pack, unpack


def keyframe_of(room, number: int = 0) -> ReferenceKeyframe:
    return ReferenceKeyframe(pyramid_of(room.view(np.eye(4)), PyramidConfig()), np.eye(4), number)


def test_empty_state_survives_packing() -> None:
    restored = unpack(pack(OdometryState()), PyramidConfig())
    assert restored.keyframe is None
    assert len(restored.places) == 0


def test_keyframe_and_places_survive_packing(room) -> None:
    place = make_keyframe_record(keyframe_of(room, 3), FeatureConfig(), KeyframeDatabaseConfig())
    state = OdometryState(
        KeyframeDatabase((place,)), keyframe_of(room, 5), place, frames_since_keyframe=4
    )
    restored = unpack(pack(state), PyramidConfig())
    assert [place.id for place in restored.places.all] == [3]
    assert restored.keyframe is not None
    assert restored.keyframe.id == 5
    assert restored.mapping_keyframe is not None
    assert restored.mapping_keyframe.id == 3
    assert restored.frames_since_keyframe == 4


def test_what_moved_survives_packing(room) -> None:
    mask = np.eye(120, 160) > 0
    moved = replace(keyframe_of(room), moved_mask=mask, ignore_mask=~mask)
    suspicion = MotionEvidence(mask, mask.astype(np.uint8))
    state = OdometryState(keyframe=moved, dynamic_mask=~mask, motion_evidence=suspicion)
    restored = unpack(pack(state), PyramidConfig())
    assert restored.keyframe is not None
    np.testing.assert_array_equal(restored.keyframe.moved_mask, mask)
    np.testing.assert_array_equal(restored.keyframe.ignore_mask, ~mask)
    np.testing.assert_array_equal(restored.dynamic_mask, ~mask)
    np.testing.assert_array_equal(restored.motion_evidence.gone, suspicion.gone)


def test_a_keyframe_made_from_a_place_keeps_the_features_of_the_place(room) -> None:
    place = make_keyframe_record(keyframe_of(room), FeatureConfig(), KeyframeDatabaseConfig())
    state = OdometryState(keyframe=place.keyframe(PyramidConfig()))
    restored = unpack(pack(state), PyramidConfig()).keyframe
    assert restored is not None
    kept = restored.features(FeatureConfig())
    np.testing.assert_array_equal(kept.descriptors, place.descriptors)
    np.testing.assert_array_equal(kept.points_camera, place.points_camera)


def test_what_has_not_changed_is_the_same_object_when_packed_again(room) -> None:
    place = make_keyframe_record(keyframe_of(room), FeatureConfig(), KeyframeDatabaseConfig())
    state = OdometryState(places=KeyframeDatabase((place,)), keyframe=keyframe_of(room))
    before, after = pack(state), pack(state)
    assert before["places"][0] is after["places"][0]
    assert before["keyframe"] is after["keyframe"]
