"""Loop candidates that the objects of the map contradict or confirm."""

import msgspec
import numpy as np
import pytest

from ldo_service.actors.loop_closer import LoopCloser
from ldo_service.conversions.frames import camera_from_message
from ldo_service.conversions.poses import pose_from_message, pose_to_message
from ldo_service.geometry import se3
from ldo_service.schemas import Array, Keyframe, MapObject, MapObjects, encode
from ldo_service.storage.state_codec import decode_state, encode_state
from tests.actors.conftest import handle_all
from tests.actors.loop_walks import DRIFT, candidates, closures, with_empty_detections

BALL_M = 0.12  # Radius of an object.


def map_objects(*centers_m: np.ndarray, name: str = "vase", size_m: float = BALL_M) -> MapObjects:
    """Return balls at points of the map frame."""
    covariance = (size_m**2 / 3 * np.eye(3)).ravel()
    return MapObjects(
        stamp_ns=0,
        version=1,
        graph_version=0,
        objects=tuple(
            MapObject(
                id=number,
                name=name,
                confidence=1.0,
                centroid=tuple(center.tolist()),
                covariance=tuple(covariance.tolist()),
                T_map_object=pose_to_message(np.eye(4)),
                size=(2 * size_m, 2 * size_m, 2 * size_m),
                distribution=((name, 1.0),),
                entropy=0.0,
                observation_count=3,
                miss_count=0,
                first_keyframe=0,
                last_keyframe=3,
            )
            for number, center in enumerate(centers_m)
        ),
    )


def with_ball(keyframe: Keyframe, p_map: np.ndarray) -> Keyframe:
    """Return a keyframe whose depth shows a ball at a point of the map frame, if it is in view."""
    camera = camera_from_message(keyframe.camera)
    center = se3.transform(se3.inverse(pose_from_message(keyframe.T_odom_keyframe)), p_map)
    rays, depth_m = camera.rays(), keyframe.depth_m.numpy()
    dd, dc = np.sum(rays * rays, axis=-1), rays @ center
    inside = dc**2 - dd * (center @ center - BALL_M**2)
    ball_m = (dc - np.sqrt(np.maximum(inside, 0))) / dd
    is_ball = (inside > 0) & (ball_m > 0) & (ball_m < depth_m)
    changed = Array.of(np.where(is_ball, ball_m, depth_m).astype(np.float32))
    return msgspec.structs.replace(keyframe, depth_m=changed)


@pytest.fixture(scope="module")
def ball_m(first_walk) -> np.ndarray:
    """Return a point in free space, in front of the middle keyframe of the first walk."""
    T_odom_keyframe = pose_from_message(first_walk[len(first_walk) // 2].T_odom_keyframe)
    return se3.transform(T_odom_keyframe, np.array([0.0, 0.0, 1.0]))


def test_place_where_an_object_is_missing_is_rejected(first_walk, second_walk, ball_m) -> None:
    """The first walk shows a ball and the second one does not, as in a similar room."""
    old = [with_ball(keyframe, ball_m) for keyframe in first_walk]
    messages = with_empty_detections([*old, *second_walk])
    without = handle_all(LoopCloser(), messages)
    found = handle_all(LoopCloser(), [map_objects(ball_m), *messages])
    reasons = {c.rejected_reason for c in candidates(found)}
    assert "1 objects are missing and 0 replaced, in 1 tests" in reasons
    assert len(closures(found)) < len(closures(without))


@pytest.mark.parametrize("name", ["vase", "person"])
def test_present_or_moving_object_rejects_no_closure(
    first_walk, second_walk, ball_m, name: str
) -> None:
    in_map = with_empty_detections([*first_walk, *second_walk])
    expected = len(closures(handle_all(LoopCloser(), in_map)))
    if name == "vase":
        ball_in_second = se3.transform(DRIFT, ball_m)
        old = [with_ball(keyframe, ball_m) for keyframe in first_walk]
        new = [with_ball(keyframe, ball_in_second) for keyframe in second_walk]
        in_map = with_empty_detections([*old, *new])
    found = handle_all(LoopCloser(), [map_objects(ball_m, name=name), *in_map])
    assert len(closures(found)) == expected > 0


def test_objects_are_part_of_the_state(first_walk, second_walk, ball_m) -> None:
    old = [with_ball(keyframe, ball_m) for keyframe in first_walk]
    before = [map_objects(ball_m), *with_empty_detections(old)]
    after = with_empty_detections(second_walk)
    first, second = LoopCloser(), LoopCloser()
    handle_all(first, before)
    state = {name: decode_state(encode_state(part)) for name, part in first.snapshot().items()}
    second.restore(state)
    expected, got = (handle_all(actor, after) for actor in (first, second))
    assert [encode(m) for m in got] == [encode(m) for m in expected]
    assert any("missing" in c.rejected_reason for c in candidates(got))
    older = LoopCloser()
    older.restore({name: part for name, part in state.items() if name != "objects"})
    assert not any("missing" in c.rejected_reason for c in candidates(handle_all(older, after)))
