from dataclasses import replace

import numpy as np

from ldo_service.tracking import PyramidConfig
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import KeyframeDatabase
from ldo_service.tracking.motion_segmentation import MotionEvidence
from ldo_service.tracking.state import OdometryState, pack, unpack
from tests.tracking.scenes import keyframe_at, record_at


def test_empty_state_survives_packing() -> None:
    restored = unpack(pack(OdometryState()), PyramidConfig())
    assert restored.keyframe is None
    assert len(restored.database) == 0


def test_keyframe_and_records_survive_packing(room) -> None:
    record = record_at(room, np.eye(4), 3)
    state = OdometryState(
        KeyframeDatabase((record,)),
        keyframe_at(room, np.eye(4), 5),
        record,
        frames_since_keyframe=4,
    )
    restored = unpack(pack(state), PyramidConfig())
    assert [record.id for record in restored.database.all] == [3]
    assert restored.keyframe is not None
    assert restored.keyframe.id == 5
    assert restored.mapping_keyframe is not None
    assert restored.mapping_keyframe.id == 3
    assert restored.frames_since_keyframe == 4


def test_motion_masks_survive_packing(room) -> None:
    mask = np.eye(120, 160) > 0
    keyframe = replace(keyframe_at(room, np.eye(4)), moved_mask=mask, ignore_mask=~mask)
    evidence = MotionEvidence(mask, mask.astype(np.uint8))
    state = OdometryState(keyframe=keyframe, dynamic_mask=~mask, motion_evidence=evidence)
    restored = unpack(pack(state), PyramidConfig())
    assert restored.keyframe is not None
    np.testing.assert_array_equal(restored.keyframe.moved_mask, mask)
    np.testing.assert_array_equal(restored.keyframe.ignore_mask, ~mask)
    np.testing.assert_array_equal(restored.dynamic_mask, ~mask)
    np.testing.assert_array_equal(restored.motion_evidence.gone, evidence.gone)


def test_keyframe_of_a_record_keeps_the_features_of_the_record(room) -> None:
    record = record_at(room, np.eye(4))
    state = OdometryState(keyframe=record.keyframe(PyramidConfig()))
    restored = unpack(pack(state), PyramidConfig()).keyframe
    assert restored is not None
    kept = restored.features(FeatureConfig())
    np.testing.assert_array_equal(kept.descriptors, record.descriptors)
    np.testing.assert_array_equal(kept.points_camera, record.points_camera)


def test_unchanged_parts_are_the_same_objects_when_packed_again(room) -> None:
    record = record_at(room, np.eye(4))
    state = OdometryState(
        database=KeyframeDatabase((record,)), keyframe=keyframe_at(room, np.eye(4))
    )
    before, after = pack(state), pack(state)
    assert before["places"][0] is after["places"][0]
    assert before["keyframe"] is after["keyframe"]
