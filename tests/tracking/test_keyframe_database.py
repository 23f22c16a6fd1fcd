from dataclasses import replace

import numpy as np
import pytest

from ldo_service.calibration.correction import CameraCorrection, CorrectionChange
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
from tests.tracking.scenes import keyframe_at, record_at, yaw


def test_frame_aligns_to_a_record_as_to_its_keyframe(make_room) -> None:
    room = make_room(640, 480)  # The working resolution, which a record keeps, is half of it.
    keyframe, T = keyframe_at(room, np.eye(4)), se3.exp(np.array([0, 0.03, 0, 0.02, 0, 0.01]))
    record = make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig())
    view = pyramid_of(room.view(T), PyramidConfig())
    for reference in (keyframe, record.keyframe(PyramidConfig())):
        candidate = align_hypothesis(reference, view, np.eye(4), "direct", AlignConfig())
        np.testing.assert_allclose(candidate.alignment.T_reference_camera, T, atol=1e-3)


def test_record_is_small_and_packs_bitwise_equal(make_room) -> None:
    room = make_room(640, 480)
    record = record_at(room, np.eye(4))
    full = 640 * 480 * 5  # Bytes of gray levels and depth.
    assert record.nbytes < full / 5
    restored = KeyframeRecord.unpack(record.pack())
    assert restored.keyframe(PyramidConfig()).view.gray.tobytes() == (
        record.keyframe(PyramidConfig()).view.gray.tobytes()
    )
    assert restored.camera == record.camera


def test_record_features_have_depth_and_lie_within_the_image(large_room) -> None:
    features = record_at(large_room, np.eye(4)).features
    assert len(features.pixels) > 100
    assert (features.points_camera[:, 2] > 0).all()
    assert (features.pixels > -1).all()
    assert (features.pixels < [321, 241]).all()


def test_thumbnail_ignores_brightness_and_contrast(large_room) -> None:
    plain = make_thumbnail(pyramid_of(large_room.view(np.eye(4)), PyramidConfig()))
    dark = make_thumbnail(pyramid_of(large_room.view(np.eye(4), 0.6, 20.0), PyramidConfig()))
    assert np.abs(plain.astype(int) - dark).max() <= 2
    blank = make_thumbnail(pyramid_of(large_room.blank(), PyramidConfig()))
    assert not blank.any()


def test_most_similar_record_is_ranked_first(room) -> None:
    angles = (0.0, 0.8, 1.6, 2.4, 3.2)
    database = KeyframeDatabase(tuple(record_at(room, yaw(a), k) for k, a in enumerate(angles)))
    for number, angle in enumerate(angles):
        view = pyramid_of(room.view(yaw(angle + 0.03), 1.2, 5.0), PyramidConfig())
        ranked = database.rank_by_similarity(view)
        assert ranked[0] == number
        assert sorted(ranked) == list(range(len(angles)))


def test_full_database_drops_records_where_they_are_densest(room) -> None:
    config, database = KeyframeDatabaseConfig(count=4), KeyframeDatabase()
    for number, angle in enumerate((0.0, 0.3, 0.6, 0.65, 0.9, 1.2)):
        database = database.with_record(record_at(room, yaw(angle), number), config)
    assert len(database) == 4
    kept = [record.id for record in database.all]
    assert kept[0] == 0, "the first stays"
    assert kept[-1] == 5, "the newest stays"
    assert not {2, 3} <= set(kept), "one of two similar records is dropped"


def test_repeated_loop_keeps_only_the_newest_record_of_each_view(room) -> None:
    config, database = KeyframeDatabaseConfig(recent=2), KeyframeDatabase()
    angles, offsets = (0.0, 0.3, 0.6, 0.9, 1.2), (0.0, 0.02, -0.02)
    around = [angle + offset for offset in offsets for angle in angles]
    for number, angle in enumerate(around):
        database = database.with_record(record_at(room, yaw(angle), number), config)
    assert [record.id for record in database.all] == [10, 11, 12, 13, 14]


def test_distant_record_or_one_of_another_submap_is_not_replaced(room) -> None:
    config = KeyframeDatabaseConfig(recent=0)
    first = record_at(room, np.eye(4), 0)
    database = KeyframeDatabase((first, replace(first, id=1, submap=1)))
    database = database.with_record(record_at(room, yaw(config.same + 0.01), 2), config)
    assert [record.id for record in database.all] == [0, 1, 2]
    database = database.with_record(record_at(room, yaw(0.01), 3), config)
    assert [record.id for record in database.all] == [1, 2, 3]


def test_database_of_two_records_is_rejected() -> None:
    with pytest.raises(ConfigError, match="count"):
        KeyframeDatabaseConfig(count=2)


def test_record_stores_the_median_of_earlier_residuals(room) -> None:
    past = ResidualHistory((3.0, 9.0, 4.0), (1.0, 0.5, 2.0))
    record = make_keyframe_record(
        keyframe_at(room, np.eye(4)), FeatureConfig(), KeyframeDatabaseConfig(), past
    )
    assert record.history(ResidualHistory()) == ResidualHistory((4.0,), (1.0,))
    assert record_at(room, np.eye(4)).history(past) is past, (
        "the first record has no history of its own"
    )


def test_record_excludes_masked_pixels(room) -> None:
    view = pyramid_of(room.view(np.eye(4)), PyramidConfig())
    ignore_mask = np.zeros(view.levels[0].depth_m.shape, bool)
    ignore_mask[:, :80] = True
    record = make_keyframe_record(
        ReferenceKeyframe(view, np.eye(4), 0, ignore_mask=ignore_mask),
        FeatureConfig(),
        KeyframeDatabaseConfig(),
    )
    rebuilt = record.keyframe(PyramidConfig()).view.levels[0].texels
    assert not rebuilt[:, :80].any()
    assert rebuilt[5:-5, 90:, 3].all()
    columns = record.camera.project(record.points_camera.astype(np.float64))[:, 0]
    assert len(columns) > 20
    assert columns.min() > 79


def changes() -> tuple[CorrectionChange, CorrectionChange]:
    nothing = CameraCorrection()
    first = CameraCorrection((0.01, 0.0, -0.01), ((-0.3, 0.1, 0.0),) * 3)
    second = CameraCorrection((0.02, 0.01, -0.01), ((-0.4, 0.1, 0.0),) * 3)
    return CorrectionChange(nothing, first), CorrectionChange(first, second)


def test_record_converts_its_images_and_points_to_the_last_correction(large_room) -> None:
    record, (first, second) = record_at(large_room, np.eye(4)), changes()
    changed = record.recorrected(first).recorrected(second)
    whole = CorrectionChange(first.old, second.new)
    before, after = record.keyframe(PyramidConfig()), changed.keyframe(PyramidConfig())
    camera = record.camera
    assert np.array_equal(after.view.gray, whole.gray(before.view.gray, camera))
    assert np.array_equal(after.view.depth_m, whole.depth_m(before.view.depth_m, camera))
    assert not np.array_equal(after.view.depth_m, before.view.depth_m)
    assert np.array_equal(
        changed.features.points_camera, whole.points(record.features.points_camera, camera)
    )
    restored = KeyframeRecord.unpack(changed.pack())
    assert restored.change == whole
    assert np.array_equal(restored.depth_m, changed.depth_m)


def test_masking_keeps_the_correction_of_a_record(large_room) -> None:
    first, _ = changes()
    record = record_at(large_room, np.eye(4)).recorrected(first)
    mask = np.zeros((record.camera.height, record.camera.width), bool)
    mask[:20] = True
    masked = record.without(mask)
    assert not masked.depth_m[:20].any()
    # Depth is stored in steps of half a millimeter.
    np.testing.assert_allclose(masked.depth_m[20:], record.depth_m[20:], atol=0.26e-3)
    assert masked.recorrected(first).change == first
