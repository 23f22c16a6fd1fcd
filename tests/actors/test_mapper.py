"""The mapper's messages reproduce its map, and corrections move it rigidly."""

import numpy as np
import pytest

from ldo_service.actors.mapper import Mapper, MapperConfig
from ldo_service.evaluation.rendering import psnr
from ldo_service.geometry import se3
from ldo_service.map_follower import MapFollower
from ldo_service.schemas import MapDelta, MapSnapshot, ModelView
from ldo_service.wire import correction_message, rgbd_of, transform

CONFIG = MapperConfig(snapshot_keyframes=2, part_gaussians=3000, snapshot_growth=0.0)


def handled(mapper: Mapper, messages) -> list:
    return [out for message in messages for out in mapper.handle(message)]


def changes(messages) -> list[MapDelta | MapSnapshot]:
    return [message for message in messages if isinstance(message, MapDelta | MapSnapshot)]


def followed(messages, follower: MapFollower | None = None) -> MapFollower:
    follower = follower or MapFollower()
    for message in messages:
        follower.take(message)
    return follower


def last_snapshot_part(messages) -> MapSnapshot:
    return [message for message in messages if isinstance(message, MapSnapshot)][-1]


def shifted(keyframes, xi):
    """A correction that moves each keyframe a little more than the one before."""
    return correction_message(
        0,
        1,
        {
            k.keyframe: se3.exp(np.array(xi) * (1 + k.keyframe)) @ transform(k.T_odom_keyframe)
            for k in keyframes
        },
    )


@pytest.fixture(scope="module")
def correction(keyframes):
    return shifted(keyframes, [0, 0.01, 0, 0.02, 0, 0])


def test_the_view_shows_what_the_camera_saw(keyframes) -> None:
    for message in handled(Mapper(CONFIG), keyframes):
        if isinstance(message, ModelView):
            frame = rgbd_of(keyframes[message.keyframe])
            assert psnr(message.color.numpy(), frame.color) > 25
            seen = (message.depth_m.numpy() > 0) & (frame.depth_m > 0)
            assert seen.mean() > 0.95
            error = np.abs(message.depth_m.numpy() - frame.depth_m)[seen]
            assert np.median(error / frame.depth_m[seen]) < 0.01


def test_what_is_explained_is_not_inserted_again(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handled(mapper, keyframes[:1])
    first = mapper.facts()["gaussians"]
    handled(mapper, keyframes[1:2])
    assert mapper.facts()["gaussians"] < 1.6 * first


def test_following_every_delta_gives_equal_arrays(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    messages = handled(mapper, [*keyframes[:-1], correction, keyframes[-1]])
    deltas = [message for message in messages if isinstance(message, MapDelta)]
    follower = followed(deltas)
    assert any(delta.motions for delta in deltas)
    assert_equal_maps(follower, mapper)


def test_a_late_joiner_ends_with_equal_arrays(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    messages = changes(handled(mapper, [*keyframes, correction]))
    late = messages[messages.index(last_snapshot_part(messages)) + 1 :]
    follower = followed(late)
    assert follower.version == 0, "it has not had a whole snapshot yet"
    followed(mapper.finish(), follower)
    assert_equal_maps(follower, mapper)


def test_a_missed_delta_is_noticed_and_mended_by_the_next_snapshot(keyframes) -> None:
    mapper = Mapper(CONFIG)
    messages = changes(handled(mapper, keyframes))
    deltas = [m for m in messages if isinstance(m, MapDelta)]
    follower = followed([deltas[0], deltas[2]])
    assert follower.is_behind
    followed(mapper.finish(), follower)
    assert not follower.is_behind
    assert_equal_maps(follower, mapper)


def test_a_correction_moves_gaussians_with_their_keyframes(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    before = followed(changes(handled(mapper, keyframes)))
    means, anchors = before.map.means.copy(), before.map.anchors.copy()
    after = followed(changes(handled(mapper, [correction])), before)
    for k in keyframes:
        mine = anchors == k.keyframe
        T = se3.exp(np.array([0, 0.01, 0, 0.02, 0, 0]) * (1 + k.keyframe))
        np.testing.assert_allclose(after.map.means[mine], se3.transform(T, means[mine]), atol=1e-5)


def test_a_correction_that_moves_nothing_says_nothing(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handled(mapper, keyframes)
    same = {k.keyframe: transform(k.T_odom_keyframe) for k in keyframes}
    assert handled(mapper, [correction_message(0, 1, same)]) == []


def test_a_keyframe_sent_twice_counts_once(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handled(mapper, keyframes[:2])
    assert handled(mapper, keyframes[1:2]) == []
    assert mapper.facts()["keyframes_repeated"] == 1


def test_a_follower_of_a_killed_mapper_ends_with_the_successors_map(keyframes) -> None:
    """The successor lacks what came after the checkpoint, and inserts other Gaussians."""
    first, second = Mapper(), Mapper()
    follower = MapFollower()
    for keyframe in keyframes[:4]:  # the checkpoint holds the first keyframe only
        followed(changes(list(first.handle(keyframe))), follower)
        state = first.snapshot()
    second.restore(state)
    assert second.facts()["gaussians"] < first.facts()["gaussians"]
    followed(changes(handled(second, keyframes[4:])), follower)
    followed(second.finish(), follower)
    assert_equal_maps(follower, second)


def test_a_checkpoint_on_request_has_the_whole_map(keyframes) -> None:
    first, second = Mapper(), Mapper()
    for keyframe in keyframes[:3]:
        list(first.handle(keyframe))
    second.restore(first.checkpoint())
    assert second.facts()["gaussians"] == first.facts()["gaussians"]


def test_corrections_too_small_to_send_add_up(keyframes) -> None:
    mapper = Mapper(CONFIG)
    follower = followed(changes(handled(mapper, keyframes[:1])))
    before = follower.map.means.copy()
    for step in range(1, 101):
        T = transform(keyframes[0].T_odom_keyframe)
        T[0, 3] += step * 0.4e-6
        followed(mapper.handle(correction_message(0, step, {0: T})), follower)
    moved = follower.map.means[:, 0] - before[:, 0]
    assert abs(float(np.median(moved)) - 40e-6) < 2e-6


def test_a_correction_without_a_map_is_harmless() -> None:
    assert list(Mapper(CONFIG).handle(correction_message(0, 1, {0: np.eye(4)}))) == []


def test_between_checkpoints_the_state_is_the_same_object(keyframes) -> None:
    mapper = Mapper(MapperConfig(checkpoint_keyframes=3))
    list(mapper.handle(keyframes[0]))
    first = mapper.snapshot()["map"]
    list(mapper.handle(keyframes[1]))
    assert mapper.snapshot()["map"] is first


def test_a_follower_notices_that_the_mapper_began_anew(keyframes) -> None:
    """Before its first snapshot: the first change is one of an empty map."""
    config = MapperConfig(snapshot_keyframes=100)
    follower = followed(changes(handled(Mapper(config), keyframes[:4])))
    assert follower.version > 1
    anew = Mapper(config)
    deltas = [m for m in handled(anew, keyframes[1:3]) if isinstance(m, MapDelta)]
    followed(deltas, follower)
    assert_equal_maps(follower, anew)


def assert_equal_maps(follower: MapFollower, mapper: Mapper) -> None:
    snapshot = followed(mapper.finish())
    assert follower.version == snapshot.version
    np.testing.assert_array_equal(follower.map.ids, snapshot.map.ids)
    np.testing.assert_array_equal(follower.map.anchors, snapshot.map.anchors)
    np.testing.assert_array_equal(follower.map.rows, snapshot.map.rows)
