"""The mapper's messages reproduce its map, and corrections move it rigidly."""

import shutil
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from ldo_service.actors.mapper import Mapper, MapperConfig
from ldo_service.actors.optimizer import Optimizer
from ldo_service.conversions.frames import frame_from_message, mask_from_array, mask_to_array
from ldo_service.conversions.poses import (
    correction_to_message,
    keyframe_poses_from_correction,
    matrix6_to_message,
    measurements_from_message,
    pose_from_message,
    pose_to_message,
)
from ldo_service.evaluation.views import psnr
from ldo_service.gaussians import (
    DensificationConfig,
    GaussianOptimizerConfig,
    PruningConfig,
    render,
)
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.gaussians.visibility import OffloadConfig
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.maps.replica import MapReplica
from ldo_service.runtime.actor import FlowStatus
from ldo_service.runtime.delivery_state import LoggedInput, RestoredState, restore_actor
from ldo_service.schemas import (
    Detection,
    DetectionBoxes,
    Keyframe,
    KeyframeRefinement,
    MapDelta,
    MapRendering,
    MapSnapshot,
    RefineMap,
    encode,
)
from ldo_service.schemas.topics import KEYFRAME_NEW
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.semantics.semantic_fusion import SemanticFusionConfig
from ldo_service.semantics.semantic_map import SemanticMapConfig
from ldo_service.storage.state_codec import decode_state, encode_state

CONFIG = MapperConfig(
    iterations=2,
    changed_keyframes=3,
    snapshot_keyframes=2,
    part_gaussians=3000,
    snapshot_growth=0.0,
)


SLOW_CHECKPOINTS = replace(CONFIG, checkpoint_keyframes=5)


def handled(mapper: Mapper, messages) -> list:
    return [out for message in messages for out in mapper.handle(message)]


def changes(messages) -> list[MapDelta | MapSnapshot]:
    return [message for message in messages if isinstance(message, MapDelta | MapSnapshot)]


def deltas_of(messages) -> list[MapDelta]:
    return [message for message in messages if isinstance(message, MapDelta)]


def followed(messages, follower: MapReplica | None = None) -> MapReplica:
    follower = follower or MapReplica()
    for message in changes(messages):
        follower.apply(message)
    return follower


def last_snapshot_part(messages) -> MapSnapshot:
    return [message for message in messages if isinstance(message, MapSnapshot)][-1]


def shifted(keyframes, xi):
    """A correction that moves each keyframe a little more than the one before."""
    return correction_to_message(
        0,
        1,
        {
            k.keyframe: se3.exp(np.array(xi) * (1 + k.keyframe))
            @ pose_from_message(k.T_odom_keyframe)
            for k in keyframes
        },
    )


@pytest.fixture(scope="module")
def correction(keyframes):
    return shifted(keyframes, [0, 0.01, 0, 0.02, 0, 0])


def test_the_view_shows_what_the_camera_saw(keyframes) -> None:
    for message in handled(Mapper(CONFIG), keyframes):
        if isinstance(message, MapRendering):
            frame = frame_from_message(keyframes[message.keyframe])
            assert psnr(message.color.numpy(), frame.color) > 25
            seen = (message.depth_m.numpy() > 0) & (frame.depth_m > 0)
            assert seen.mean() > 0.95
            error = np.abs(message.depth_m.numpy() - frame.depth_m)[seen]
            assert np.median(error / frame.depth_m[seen]) < 0.01


def test_what_is_explained_is_not_inserted_again(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handled(mapper, keyframes[:1])
    first = mapper.metrics()["gaussians"]
    handled(mapper, keyframes[1:2])
    assert mapper.metrics()["gaussians"] < 1.6 * first


def test_following_every_delta_gives_equal_arrays(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    messages = handled(mapper, [*keyframes[:-1], correction, keyframes[-1]])
    deltas = deltas_of([*messages, *mapper.on_stop()])
    assert any(delta.motions for delta in deltas)
    assert any(len(delta.changed.ids.numpy()) for delta in deltas)
    assert_equal_maps(followed(deltas), mapper)


def test_followers_hold_to_the_bit_what_sleeps_and_wakes(keyframes) -> None:
    """Through corrections: what is 3 m away sleeps, and wakes where a camera comes near."""
    sleep = OffloadConfig(max_active=500, reach_m=3.0, clump_m=0.5)
    builder = MapBuilderConfig(sleep=sleep, recent_cameras=1)
    config = replace(CONFIG, builder=builder, changed_keyframes=1, iterations=1, least_iterations=1)
    mapper, follower = Mapper(replace(config, mended_at_end=0)), MapReplica()
    for version, keyframe in enumerate(keyframes, 1):
        poses = {
            0: se3.exp(0.01 * version * np.ones(6))
            @ pose_from_message(keyframes[0].T_odom_keyframe)
        }
        correction = correction_to_message(0, version, poses)
        followed(deltas_of(handled(mapper, [keyframe, correction])), follower)
    assert mapper.metrics()["gaussians_offloaded"] > 1000
    assert mapper.metrics()["gaussians_loaded_total"] > 1000
    assert_equal_maps(follower, mapper)


def test_what_gaussians_became_is_told_now_and_then(keyframes) -> None:
    """Else every keyframe would send all that is in view."""
    config = replace(CONFIG, snapshot_keyframes=100)
    mapper, told = Mapper(config), []
    for keyframe in keyframes[:7]:
        deltas = deltas_of(mapper.handle(keyframe))
        told.append(any(len(delta.changed.ids.numpy()) for delta in deltas))
        assert all(len(d.added.ids.numpy()) <= config.part_gaussians for d in deltas)
    assert told == [False, False, False, True, False, False, True]


def test_gaussians_that_were_pruned_leave_the_followers(keyframes) -> None:
    builder = MapBuilderConfig(
        prune_keyframes=1, pruning=PruningConfig(min_opacity=0.9), insertion=DensificationConfig()
    )
    mapper = Mapper(replace(CONFIG, builder=builder, iterations=4))
    deltas = deltas_of([*handled(mapper, keyframes[:5]), *mapper.on_stop()])
    assert any(len(delta.removed.numpy()) for delta in deltas)
    assert_equal_maps(followed(deltas), mapper)


def test_fewer_iterations_when_keyframes_wait(keyframes) -> None:
    mapper = Mapper(replace(CONFIG, iterations=12, least_iterations=3))
    spent = []
    for keyframe, waiting in zip(keyframes, (0, 1, 3), strict=False):
        before = mapper.metrics()["iterations"]
        mapper.situation = FlowStatus(backlog={KEYFRAME_NEW: waiting})
        list(mapper.handle(keyframe))
        spent.append(mapper.metrics()["iterations"] - before)
    assert spent[0] > spent[1] > spent[2]
    assert spent[0] > 2 * spent[2]


def test_a_request_to_refine_makes_the_map_better_and_is_told(keyframes) -> None:
    mapper = Mapper(CONFIG)
    messages = handled(mapper, keyframes[:4])
    before = followed(deltas_of([*messages, *mapper.on_stop()]))
    rows = before.map.rows.copy()
    asked = RefineMap(stamp_ns=0, iterations=40, initial_rate=1.0, final_rate=0.2)
    deltas = deltas_of(mapper.handle(asked))
    after = followed(deltas, before)
    assert_equal_maps(after, mapper)
    frame, T = frame_from_message(keyframes[1]), pose_from_message(keyframes[1].T_odom_keyframe)
    assert seen_psnr(after.map.rows, frame, T) > seen_psnr(rows, frame, T) + 1


def test_what_was_refined_is_in_the_checkpoint_at_once(keyframes) -> None:
    mapper = Mapper(SLOW_CHECKPOINTS)
    handled(mapper, keyframes[:2])
    before = mapper.snapshot()
    assert mapper.snapshot()["map"] is before["map"], "no keyframe was added"
    list(mapper.handle(RefineMap(stamp_ns=0, iterations=5)))
    assert mapper.snapshot()["map"] is not before["map"]


def test_keyframes_that_the_renderer_moved_are_measured_anew(keyframes) -> None:
    optimizer = GaussianOptimizerConfig(rotation_rate_rad=1e-3, translation_rate_m=1e-3)
    builder = MapBuilderConfig(optimiser=optimizer)
    mapper = Mapper(replace(CONFIG, builder=builder, iterations=6))
    known = {}
    for keyframe in keyframes[:5]:
        known[keyframe.keyframe] = keyframe
        for message in mapper.handle(keyframe):
            if isinstance(message, KeyframeRefinement):
                for pose in message.poses:
                    measured = {m.a: m for m in measurements_from_message(known[pose.keyframe])}
                    before = measured[pose.reference]
                    assert pose.information == matrix6_to_message(before.information)
                    moved = se3.log(
                        se3.inverse(before.T_a_b) @ pose_from_message(pose.T_reference_keyframe)
                    )
                    assert 1e-5 < np.linalg.norm(moved) < 0.02
                    known[pose.keyframe, "refined"] = pose
    assert len(known) > 5, "nothing was refined"


def test_a_correction_that_knows_nothing_of_a_refinement_does_not_undo_it(keyframes) -> None:
    optimizer = GaussianOptimizerConfig(rotation_rate_rad=1e-3, translation_rate_m=1e-3)
    builder = MapBuilderConfig(optimiser=optimizer)
    mapper, optimizer = Mapper(replace(CONFIG, builder=builder, iterations=6)), Optimizer()
    for keyframe in keyframes[:4]:
        made = list(mapper.handle(keyframe))
        (before,) = optimizer.handle(keyframe)
        refinements = [m for m in made if isinstance(m, KeyframeRefinement)]
        assert list(mapper.handle(before)) == [], "it was on its way when the renderer moved them"
        for refinement in refinements:
            (after,) = optimizer.handle(refinement)
            assert after.last_refinement == refinement.number
            assert list(mapper.handle(after)) == [], "the graph agrees with the renderer"
    assert after.last_refinement > 1
    turned = {
        k: se3.exp(np.array([0, 0, 0, 0.1, 0, 0])) @ T
        for k, T in keyframe_poses_from_correction(after).items()
    }
    far = correction_to_message(0, after.graph_version + 1, turned, after.last_refinement)
    (delta,) = mapper.handle(far)
    assert len(delta.motions) == 4


def test_a_map_that_no_longer_grows_is_still_sent_whole_now_and_then(keyframes) -> None:
    config = replace(CONFIG, snapshot_growth=100.0, snapshot_keyframes_max=3)
    made = [list(mapper_made) for mapper_made in map(Mapper(config).handle, keyframes[:8])]
    whole = [any(isinstance(m, MapSnapshot) for m in messages) for messages in made]
    assert whole == [True, False, False, True, False, False, True, False]


def seen_psnr(rows: np.ndarray, frame: RgbdFrame, T_map_camera: np.ndarray) -> float:
    image = render(rows, frame.camera, se3.inverse(T_map_camera)).color.clip(0, 1)
    return psnr(image, frame.color / np.float32(255))


def test_a_late_joiner_ends_with_equal_arrays(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    messages = changes(handled(mapper, [*keyframes, correction]))
    late = messages[messages.index(last_snapshot_part(messages)) + 1 :]
    follower = followed(late)
    assert follower.version == 0, "it has not had a whole snapshot yet"
    followed(mapper.on_stop(), follower)
    assert_equal_maps(follower, mapper)


def test_a_missed_delta_is_noticed_and_mended_by_the_next_snapshot(keyframes) -> None:
    mapper = Mapper(CONFIG)
    messages = changes(handled(mapper, keyframes))
    deltas = [m for m in messages if isinstance(m, MapDelta)]
    follower = followed([*deltas[:1], *deltas[2:]])
    assert follower.is_behind
    followed(mapper.on_stop(), follower)
    assert not follower.is_behind
    assert_equal_maps(follower, mapper)


def test_a_correction_moves_gaussians_with_their_keyframes(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    before = followed(changes([*handled(mapper, keyframes), *mapper.on_stop()]))
    means, anchors = before.map.means.copy(), before.map.anchors.copy()
    after = followed(changes(handled(mapper, [correction])), before)
    for k in keyframes:
        mine = anchors == k.keyframe
        T = se3.exp(np.array([0, 0.01, 0, 0.02, 0, 0]) * (1 + k.keyframe))
        np.testing.assert_allclose(after.map.means[mine], se3.transform(T, means[mine]), atol=1e-5)


def around_again(keyframes, T_drift: np.ndarray, first: int) -> list[Keyframe]:
    """The same views, as a camera that has drifted makes them; ids from `first` on."""
    poses = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes}
    again, before, T_before = [], keyframes[-1].keyframe, poses[keyframes[-1].keyframe]
    for k in keyframes:
        T = T_drift @ poses[k.keyframe]
        again.append(
            msgspec.structs.replace(
                k,
                keyframe=first + k.keyframe,
                reference=before,
                T_reference_keyframe=pose_to_message(se3.inverse(T_before) @ T),
                T_odom_keyframe=pose_to_message(T),
                window_measurements=(),
            )
        )
        before, T_before = first + k.keyframe, T
    return again


def test_surface_that_a_correction_lays_over_itself_is_held_once(keyframes) -> None:
    """The second time around is 10 cm off, so it is mapped again; then the loop is closed."""
    T_drift = se3.exp(np.array([0, 0, 0, 0, 0.1, 0]))
    second = around_again(keyframes[:3], T_drift, first=100)
    poses = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes[:3]}
    closed = correction_to_message(0, 1, poses | {100 + k: T for k, T in poses.items()})
    frame, T_map_camera = frame_from_message(keyframes[0]), poses[keyframes[0].keyframe]
    added, quality = {}, {}
    for mended in (0, 10):
        mapper = Mapper(replace(CONFIG, mended_at_end=mended))
        messages = handled(mapper, keyframes[:3])
        once = mapper.metrics()["gaussians"]
        messages += handled(mapper, [*second, closed])
        held_twice = mapper.metrics()["gaussians"]
        messages += mapper.on_stop()
        assert mapper.metrics()["keyframes_to_deduplicate"] == 3 * (mended == 0)
        held = mapper.metrics()["gaussians"]
        assert held_twice - held >= mapper.metrics()["gaussians_deduplicated"]
        added[mended] = held - once
        follower = followed(messages)
        assert follower.map.rows.tobytes() == mapper._map.gaussians.all().rows.tobytes()
        quality[mended] = seen_psnr(follower.map.rows, frame, T_map_camera)
    assert added[10] < 0.6 * added[0]
    assert quality[10] > quality[0] - 0.3


def torn(keyframes, config: MapperConfig) -> Mapper:
    """Three keyframes, the same again after drift, and the correction that lays them together."""
    T_drift = se3.exp(np.array([0, 0.02, 0, 0, 0.1, 0]))
    second = around_again(keyframes[:3], T_drift, first=100)
    poses = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes[:3]}
    closed = correction_to_message(0, 1, poses | {100 + k: T for k, T in poses.items()})
    mapper = Mapper(config)
    handled(mapper, [*keyframes[:3], *second, closed])
    return mapper


def psnr_of(mapper: Mapper, keyframe: Keyframe) -> float:
    T_map_camera = pose_from_message(keyframe.T_odom_keyframe)
    return seen_psnr(mapper._map.gaussians.rows, frame_from_message(keyframe), T_map_camera)


def test_what_a_correction_has_torn_fits_as_before_after_the_iterations_that_are_due(
    keyframes,
) -> None:
    whole = Mapper(CONFIG)
    handled(whole, keyframes[:3])
    mapper = torn(keyframes, CONFIG)
    facts = mapper.metrics()
    assert facts["iterations_pending"] == 3 * CONFIG.due_iterations
    assert psnr_of(mapper, keyframes[1]) < psnr_of(whole, keyframes[1]) - 1
    handled(mapper, [RefineMap(stamp_ns=0, iterations=30)])
    assert mapper.metrics()["iterations_pending"] == 6
    handled(mapper, [RefineMap(stamp_ns=0, iterations=6)])
    assert mapper.metrics()["iterations_pending"] == 0
    assert mapper.metrics()["iterations"] == facts["iterations"] + 36
    assert psnr_of(mapper, keyframes[1]) > psnr_of(whole, keyframes[1])


def test_a_keyframe_is_due_no_more_however_often_it_moves(keyframes) -> None:
    poses = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes[:4]}
    mapper = Mapper(CONFIG)
    handled(mapper, keyframes[:4])
    for version in range(1, 4):
        T_turned = se3.exp(np.array([0, 0.02 * version, 0, 0, 0, 0]))
        moved = {k: T if k < 2 else T_turned @ T for k, T in poses.items()}
        handled(mapper, [correction_to_message(0, version, moved)])
        assert mapper.metrics()["iterations_pending"] == 2 * CONFIG.due_iterations


def test_a_map_that_moves_as_a_whole_is_as_good_as_before(keyframes) -> None:
    T_moved = se3.exp(np.array([0, 0.3, 0, 1, 0, 0]))
    moved = {k.keyframe: T_moved @ pose_from_message(k.T_odom_keyframe) for k in keyframes}
    mapper = Mapper(CONFIG)
    handled(mapper, [*keyframes, correction_to_message(0, 1, moved)])
    assert mapper.metrics()["iterations_pending"] == 0
    assert mapper.metrics()["keyframes_to_deduplicate"] == len(keyframes)


def test_iterations_that_are_due_are_done_while_no_keyframe_waits(keyframes, tmp_path) -> None:
    config = replace(CONFIG, due_iterations=4, paid_iterations=6, folder=str(tmp_path))
    mapper = torn(keyframes, config)
    never = torn(keyframes, replace(config, paid_iterations=0, folder=""))
    due, more = [], []
    for i, k in enumerate(around_again(keyframes[3:7], np.eye(4), first=200)):
        if i == 2:
            predecessor, mapper = mapper, Mapper(config)
            mapper.restore(predecessor.checkpoint())
        before = [m.metrics()["iterations"] for m in (mapper, never)]
        for one in (mapper, never):
            one.situation = FlowStatus(backlog={KEYFRAME_NEW: int(i == 1)})
            handled(one, [k])
        done, usual = (
            m.metrics()["iterations"] - n for m, n in zip((mapper, never), before, strict=True)
        )
        due.append(mapper.metrics()["iterations_pending"])
        more.append(done - usual)
    assert due == [6, 6, 0, 0]
    assert more == [6, 0, 6, 0]
    assert never.metrics()["iterations_pending"] == 12


def test_a_state_that_knows_of_no_iterations_is_gone_on_from(keyframes) -> None:
    state = torn(keyframes, CONFIG).checkpoint()
    del state["map"]["due"]
    mapper = Mapper(CONFIG)
    mapper.restore(state)
    assert mapper.metrics()["iterations_pending"] == 0
    assert mapper.metrics()["keyframes_to_deduplicate"] == 3


def test_a_correction_that_moves_nothing_says_nothing(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handled(mapper, keyframes)
    same = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes}
    assert handled(mapper, [correction_to_message(0, 1, same)]) == []


def test_a_keyframe_sent_twice_counts_once(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handled(mapper, keyframes[:2])
    assert handled(mapper, keyframes[1:2]) == []
    assert mapper.metrics()["keyframes_repeated"] == 1


def test_a_follower_of_a_killed_mapper_ends_with_the_successors_map(keyframes) -> None:
    """The successor lacks what came after the checkpoint, and inserts other Gaussians."""
    first, second = Mapper(SLOW_CHECKPOINTS), Mapper(SLOW_CHECKPOINTS)
    follower = MapReplica()
    for keyframe in keyframes[:4]:  # the checkpoint holds the first keyframe only
        followed(changes(list(first.handle(keyframe))), follower)
        state = first.snapshot()
    second.restore(state)
    assert second.metrics()["gaussians"] < first.metrics()["gaussians"]
    followed(changes(handled(second, keyframes[4:])), follower)
    followed(second.on_stop(), follower)
    assert_equal_maps(follower, second)


def test_a_checkpoint_on_request_has_the_whole_map(keyframes) -> None:
    first, second = Mapper(CONFIG), Mapper(CONFIG)
    for keyframe in keyframes[:3]:
        list(first.handle(keyframe))
    second.restore(first.checkpoint())
    assert second.metrics()["gaussians"] == first.metrics()["gaussians"]


def test_a_successor_with_the_same_folder_goes_on_as_its_predecessor(keyframes, tmp_path) -> None:
    """Bit for bit: the keyframes it optimises against are on disk."""
    config = replace(CONFIG, folder=str(tmp_path / "keyframes"), iterations=4)
    first = Mapper(config)
    handled(first, keyframes[:5])
    state = decode_state(encode_state(first.checkpoint()))
    handled(first, keyframes[5:8])
    shutil.copytree(tmp_path / "keyframes", tmp_path / "copy")
    second = Mapper(replace(config, folder=str(tmp_path / "copy")))
    second.restore(state)
    handled(second, keyframes[5:8])
    assert (
        followed(second.on_stop()).map.rows.tobytes()
        == followed(first.on_stop()).map.rows.tobytes()
    )


def test_what_was_taken_since_the_checkpoint_gives_the_same_bits_again(
    keyframes, correction, tmp_path
) -> None:
    """Gaussians, keyframes, objects and the numbers of what is to come."""
    config = replace(LABELLING, folder=str(tmp_path / "keyframes"), checkpoint_keyframes=100)
    first = Mapper(config)
    taken = [m for k in keyframes[:6] for m in (k, boxes_of(k))]
    taken.insert(9, correction)
    handled(first, taken[:1])
    state = decode_state(encode_state(first.snapshot()))
    told = handled(first, taken[1:])
    shutil.copytree(tmp_path / "keyframes", tmp_path / "copy")
    config = replace(config, folder=str(tmp_path / "copy"))
    past = RestoredState(state, taken=tuple(map(as_taken, taken[1:])))
    second = restore_actor(Mapper(config), past, lambda: Mapper(config))
    one, other = first.checkpoint()["map"], second.checkpoint()["map"]
    for part in ("map", "semantics", "poses", "links", "to_mend", "due"):
        assert encode_state(one[part]) == encode_state(other[part]), part
    version = max(delta.version for delta in deltas_of(told))
    assert all(delta.version > version for delta in deltas_of(second.on_restored()))


def as_taken(message) -> LoggedInput:
    (port,) = (port for port in Mapper.inputs if port.topic.message is type(message))
    return LoggedInput.of(port.topic.name, encode(message), FlowStatus())


def test_a_successor_first_shows_its_whole_map(keyframes) -> None:
    first, second = Mapper(CONFIG), Mapper(CONFIG)
    follower = followed(changes(handled(first, keyframes[:3])))
    second.restore(first.checkpoint())
    words = list(second.on_restored())
    followed(changes(words), follower)
    assert_equal_maps(follower, second)
    assert_equal_maps(followed(changes(words)), second)
    assert list(Mapper(CONFIG).on_restored()) == []


def test_corrections_too_small_to_send_add_up(keyframes) -> None:
    mapper = Mapper(CONFIG)
    follower = followed(changes(handled(mapper, keyframes[:1])))
    before = follower.map.means.copy()
    for step in range(1, 101):
        T = pose_from_message(keyframes[0].T_odom_keyframe)
        T[0, 3] += step * 0.4e-4
        followed(mapper.handle(correction_to_message(0, step, {0: T})), follower)
    moved = follower.map.means[:, 0] - before[:, 0]
    assert abs(float(np.median(moved)) - 40e-4) < 1.01e-4


def test_a_correction_without_a_map_is_harmless() -> None:
    assert list(Mapper(CONFIG).handle(correction_to_message(0, 1, {0: np.eye(4)}))) == []


def test_between_checkpoints_the_state_is_the_same_object(keyframes) -> None:
    mapper = Mapper(replace(CONFIG, checkpoint_keyframes=3))
    list(mapper.handle(keyframes[0]))
    first = mapper.snapshot()["map"]
    list(mapper.handle(keyframes[1]))
    assert mapper.snapshot()["map"] is first


def test_a_follower_notices_that_the_mapper_began_anew(keyframes) -> None:
    """Before its first snapshot: the first change is one of an empty map."""
    config = replace(CONFIG, snapshot_keyframes=100)
    follower = followed(changes(handled(Mapper(config), keyframes[:4])))
    assert follower.version > 1
    anew = Mapper(config)
    followed(deltas_of([*handled(anew, keyframes[1:3]), *anew.on_stop()]), follower)
    assert_equal_maps(follower, anew)


def assert_equal_maps(follower: MapReplica, mapper: Mapper) -> None:
    """Of one that heard everything so far: nothing is left to tell it."""
    last_words = list(mapper.on_stop())
    assert deltas_of(last_words) == []
    snapshot = followed(last_words)
    assert follower.version == snapshot.version
    np.testing.assert_array_equal(follower.map.ids, snapshot.map.ids)
    np.testing.assert_array_equal(follower.map.anchors, snapshot.map.anchors)
    np.testing.assert_array_equal(follower.map.rows, snapshot.map.rows)
    np.testing.assert_array_equal(follower.map.labels, snapshot.map.labels)
    assert follower.label_names == snapshot.label_names


def test_what_a_keyframe_says_is_moving_does_not_count_in_the_map(keyframes) -> None:
    first = keyframes[0]
    dynamic_mask = np.zeros((first.camera.height, first.camera.width), bool)
    dynamic_mask[40:80, 30:70] = True
    camera = frame_from_message(first).camera
    said = msgspec.structs.replace(
        first, dynamic_mask=mask_to_array(dynamic_mask[::2, ::2], camera)
    )
    mapper = Mapper(CONFIG)
    handled(mapper, [said])
    (view,) = (mapper._map.views[k] for k in mapper._map.views.poses)
    np.testing.assert_array_equal(view.mask == 0, dynamic_mask)


def test_nothing_that_moves_travels_as_an_empty_mask(keyframes) -> None:
    camera = frame_from_message(keyframes[0]).camera
    for nothing in (None, np.zeros((8, 8), bool)):
        assert mask_from_array(mask_to_array(nothing, camera)) is None


# --- labels -----------------------------------------------------------------------------------
def boxes_of(keyframe, label: str = "chair", network: str = "test") -> DetectionBoxes:
    """One, in the middle of the image."""
    camera = keyframe.camera
    x, y = camera.width / 4, camera.height / 4
    box = Detection(label=label, score=0.8, box_px=(x, y, 3 * x, 3 * y))
    return DetectionBoxes(
        stamp_ns=keyframe.stamp_ns,
        keyframe=keyframe.keyframe,
        width=camera.width,
        height=camera.height,
        detections=(box,) if network else (),
        network=network,
    )


LABELLING = replace(CONFIG, semantics=SemanticMapConfig(SemanticFusionConfig(region="box")))


def test_followers_hold_labels_to_the_bit_and_know_their_names(keyframes) -> None:
    mapper, follower = Mapper(LABELLING), MapReplica()
    for keyframe in keyframes[:6]:
        boxes = boxes_of(keyframe, "lava lamp" if keyframe.keyframe > 2 else "chair")
        followed(deltas_of(handled(mapper, [keyframe, boxes])), follower)
    followed(deltas_of(mapper.on_stop()), follower)
    assert_equal_maps(follower, mapper)
    assert follower.label_names[-1] == "lava lamp"
    known = {follower.label_names[k] for k in np.unique(top_labels(follower.map.labels))}
    assert known == {"background", "chair", "lava lamp"}


def test_names_travel_when_there_are_new_ones(keyframes) -> None:
    mapper, told = Mapper(replace(LABELLING, snapshot_keyframes=100)), []
    for keyframe in keyframes[:4]:
        made = handled(mapper, [keyframe, boxes_of(keyframe)])
        told.append(sum(bool(delta.label_names) for delta in deltas_of(made)))
    assert told == [0, 1, 0, 0]


def test_where_nobody_looked_nothing_is_labelled_or_missed(keyframes) -> None:
    mapper = Mapper(LABELLING)
    messages = handled(mapper, [keyframes[0], boxes_of(keyframes[0], network="")])
    follower = followed([*changes(messages), *mapper.on_stop()])
    assert not follower.map.labels.any()
    assert follower.label_names == ()


def test_labels_change_nothing_else_of_the_map(keyframes) -> None:
    mapper, plain = Mapper(LABELLING), Mapper(LABELLING)
    for keyframe in keyframes[:5]:
        handled(mapper, [keyframe, boxes_of(keyframe)])
        handled(plain, [keyframe])
    labelled, without = followed(mapper.on_stop()).map, followed(plain.on_stop()).map
    assert top_labels(labelled.labels).any()
    assert labelled.rows.tobytes() == without.rows.tobytes()


def test_a_successor_has_the_labels_and_answers_nothing_twice(keyframes, tmp_path) -> None:
    config = replace(LABELLING, folder=str(tmp_path / "keyframes"))
    first = Mapper(config)
    for keyframe in keyframes[:4]:
        handled(first, [keyframe, boxes_of(keyframe)])
    state = decode_state(encode_state(first.checkpoint()))
    shutil.copytree(tmp_path / "keyframes", tmp_path / "copy")
    second = Mapper(replace(config, folder=str(tmp_path / "copy")))
    second.restore(state)
    handled(second, [boxes_of(keyframes[3])])
    assert second.metrics()["boxes_repeated"] == 1
    ends = []
    for mapper in (first, second):
        handled(mapper, [boxes_of(keyframes[4]), keyframes[4]])
        ends.append(followed(mapper.on_stop()))
    assert ends[0].map.labels.tobytes() == ends[1].map.labels.tobytes()
    assert ends[0].label_names == ends[1].label_names
    assert top_labels(ends[0].map.labels).any()
