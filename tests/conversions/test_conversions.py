"""Objects and observations of the map as messages."""

import numpy as np
from scipy.spatial.transform import Rotation

from ldo_service.conversions.objects import observations_to_messages
from ldo_service.conversions.poses import pose_from_message
from ldo_service.maps.publisher import ObjectPublisher
from ldo_service.schemas import MapObjects, Pose, decode, encode
from ldo_service.semantics.object_landmarks import distributions, entropies
from tests.semantics.scenes import NAMES, SCENE_OBJECTS, LabelledMap, poses


def test_object_and_observation_messages_equal_the_map() -> None:
    labelled_map = LabelledMap()
    updates = list(labelled_map.walk(SCENE_OBJECTS, poses(20)[:6]))
    table = labelled_map.objects.landmarks
    message = ObjectPublisher().message(labelled_map.objects, NAMES.names, 5, 3, stamp_ns=7)
    assert decode(encode(message), MapObjects) == message
    assert [one.id for one in message.objects] == table["id"].tolist() != []
    for one, landmark, p in zip(message.objects, table, distributions(table), strict=True):
        label = NAMES.find(one.name)
        assert one.confidence == p[label] == p.max()
        assert abs(dict(one.distribution)[one.name] - p[label]) < 1e-6
        np.testing.assert_array_equal(one.centroid, landmark["centroid"])
        np.testing.assert_array_equal(np.reshape(one.covariance, (3, 3)), landmark["covariance"])
        np.testing.assert_allclose(
            pose_from_message(one.T_map_object), landmark["T_map_object"], atol=1e-12
        )
        assert (one.observation_count, one.miss_count) == (landmark["seen"], landmark["missed"])
        assert 1 <= len(one.views) <= 3
    np.testing.assert_allclose([one.entropy for one in message.objects], entropies(table))
    for keyframe, observed in enumerate(updates):
        sent = observations_to_messages(observed, NAMES.names, keyframe, stamp_ns=7)
        assert [one.object for one in sent] == [seen.object for seen in observed.observations]
        assert all(one.keyframe == keyframe for one in sent)
    assert sent[0].box_px == tuple(updates[-1].observations[0].box)


def test_matrix_of_a_pose_message_equals_the_internal_pose() -> None:
    """Programs compose poses as matrices; SciPy is the reference for the rotation."""
    rng = np.random.default_rng(4)
    for quaternion in rng.normal(size=(20, 4)):
        quaternion /= np.linalg.norm(quaternion)
        pose = Pose(tuple(rng.normal(size=3).tolist()), tuple(quaternion.tolist()))
        rotation = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
        np.testing.assert_allclose(pose.matrix()[:3, :3], rotation, atol=1e-14)
        np.testing.assert_allclose(pose.matrix(), pose_from_message(pose), atol=1e-14)
