"""Map messages of the mapper, which reproduce its map, and effects of corrections."""

import shutil
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from ldo_service.actors import mapper_config
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.actors.optimizer import Optimizer
from ldo_service.conversions.frames import (
    frame_from_message,
    keyframe_measurements_message,
    mask_from_array,
    mask_to_array,
)
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
from ldo_service.gaussians.loop_refit import LoopRefitConfig
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.gaussians.visibility import OffloadConfig
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.maps.publisher import PublishConfig
from ldo_service.maps.replica import MapReplica
from ldo_service.runtime.actor import FlowStatus
from ldo_service.runtime.delivery_state import LoggedInput, RestoredState, restore_actor
from ldo_service.schemas import (
    Array,
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
from tests.actors.conftest import handle_all, replicate

CONFIG = MapperConfig(
    iterations=2,
    publish=PublishConfig(
        max_gaussians_per_message=3000,
        update_interval_keyframes=3,
        snapshot_interval_keyframes=2,
        min_snapshot_growth=0.0,
    ),
)

RARE_SNAPSHOTS = replace(CONFIG.publish, snapshot_interval_keyframes=100)

SLOW_CHECKPOINTS = replace(CONFIG, checkpoint_keyframes=5)


def changes(messages) -> list[MapDelta | MapSnapshot]:
    return [message for message in messages if isinstance(message, MapDelta | MapSnapshot)]


def deltas_of(messages) -> list[MapDelta]:
    return [message for message in messages if isinstance(message, MapDelta)]


def last_snapshot_part(messages) -> MapSnapshot:
    return [message for message in messages if isinstance(message, MapSnapshot)][-1]


def shifted(keyframes, xi):
    """Return a correction that moves each keyframe a little more than the one before."""
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
def keyframes(keyframes: list[Keyframe]) -> list[Keyframe]:
    """The keyframes of the room with every second pixel, which are mapped faster."""
    return [halved(keyframe) for keyframe in keyframes]


def halved(keyframe: Keyframe) -> Keyframe:
    camera = keyframe.camera
    half = {name: getattr(camera, name) / 2 for name in ("fx", "fy", "cx", "cy")}
    size = {"width": camera.width // 2, "height": camera.height // 2}
    color, depth_m = (array.numpy()[::2, ::2] for array in (keyframe.color, keyframe.depth_m))
    return msgspec.structs.replace(
        keyframe,
        camera=msgspec.structs.replace(camera, **half, **size),
        color=Array.of(color),
        depth_m=Array.of(depth_m),
    )


@pytest.fixture(scope="module")
def correction(keyframes):
    return shifted(keyframes, [0, 0.01, 0, 0.02, 0, 0])


def test_rendering_matches_the_camera_image(keyframes) -> None:
    for message in handle_all(Mapper(CONFIG), keyframes):
        if isinstance(message, MapRendering):
            frame = frame_from_message(keyframes[message.keyframe])
            assert psnr(message.color.numpy(), frame.color) > 25
            seen = (message.depth_m.numpy() > 0) & (frame.depth_m > 0)
            assert seen.mean() > 0.95
            error = np.abs(message.depth_m.numpy() - frame.depth_m)[seen]
            assert np.median(error / frame.depth_m[seen]) < 0.01


def test_mapped_surface_is_not_inserted_again(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handle_all(mapper, keyframes[:1])
    first = mapper.metrics()["gaussians"]
    handle_all(mapper, keyframes[1:2])
    assert mapper.metrics()["gaussians"] < 1.6 * first


def test_replica_of_every_delta_equals_the_map(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    messages = handle_all(mapper, [*keyframes[:-1], correction, keyframes[-1]])
    deltas = deltas_of([*messages, *mapper.on_stop()])
    assert any(delta.motions for delta in deltas)
    assert any(len(delta.changed.ids.numpy()) for delta in deltas)
    assert_equal_maps(replicate(deltas), mapper)


def test_replica_equals_the_map_while_gaussians_are_offloaded_and_loaded(keyframes) -> None:
    """Gaussians beyond 3 m are offloaded, and loaded when a camera comes near."""
    offload = OffloadConfig(max_active=500, reach_m=3.0, chunk_edge_m=0.5)
    builder = MapBuilderConfig(offload=offload, recent_cameras=1)
    publish = replace(CONFIG.publish, update_interval_keyframes=1)
    config = replace(CONFIG, builder=builder, publish=publish, iterations=1, min_iterations=1)
    mapper, replica = (
        Mapper(replace(config, refit=LoopRefitConfig(deduplicated_at_end=0))),
        MapReplica(),
    )
    for version, keyframe in enumerate(keyframes, 1):
        poses = {
            0: se3.exp(0.01 * version * np.ones(6))
            @ pose_from_message(keyframes[0].T_odom_keyframe)
        }
        correction = correction_to_message(0, version, poses)
        replicate(deltas_of(handle_all(mapper, [keyframe, correction])), replica)
    assert mapper.metrics()["gaussians_offloaded"] > 1000
    assert mapper.metrics()["gaussians_loaded_total"] > 1000
    assert_equal_maps(replica, mapper)


def test_changed_gaussians_are_sent_every_few_keyframes(keyframes) -> None:
    """Otherwise every keyframe would send all Gaussians in view."""
    config = replace(CONFIG, publish=RARE_SNAPSHOTS)
    mapper, has_changes = Mapper(config), []
    for keyframe in keyframes[:7]:
        deltas = deltas_of(mapper.handle(keyframe))
        has_changes.append(any(len(delta.changed.ids.numpy()) for delta in deltas))
        assert all(
            len(d.added.ids.numpy()) <= config.publish.max_gaussians_per_message for d in deltas
        )
    assert has_changes == [False, False, False, True, False, False, True]


def test_pruned_gaussians_are_removed_from_the_replica(keyframes) -> None:
    builder = MapBuilderConfig(
        prune_keyframes=1, pruning=PruningConfig(min_opacity=0.9), insertion=DensificationConfig()
    )
    mapper = Mapper(replace(CONFIG, builder=builder, iterations=4))
    deltas = deltas_of([*handle_all(mapper, keyframes[:5]), *mapper.on_stop()])
    assert any(len(delta.removed.numpy()) for delta in deltas)
    assert_equal_maps(replicate(deltas), mapper)


def test_backlog_reduces_iterations_per_keyframe(keyframes) -> None:
    mapper = Mapper(replace(CONFIG, iterations=12, min_iterations=3))
    spent = []
    for keyframe, waiting in zip(keyframes, (0, 1, 3), strict=False):
        before = mapper.metrics()["iterations"]
        mapper.situation = FlowStatus(backlog={KEYFRAME_NEW: waiting})
        list(mapper.handle(keyframe))
        spent.append(mapper.metrics()["iterations"] - before)
    assert spent[0] > spent[1] > spent[2]
    assert spent[0] > 2 * spent[2]


def test_refinement_request_improves_the_map_and_sends_deltas(keyframes) -> None:
    mapper = Mapper(CONFIG)
    messages = handle_all(mapper, keyframes[:4])
    before = replicate(deltas_of([*messages, *mapper.on_stop()]))
    rows = before.map.rows.copy()
    request = RefineMap(stamp_ns=0, iterations=40, initial_rate=1.0, final_rate=0.2)
    deltas = deltas_of(mapper.handle(request))
    after = replicate(deltas, before)
    assert_equal_maps(after, mapper)
    frame, T = frame_from_message(keyframes[1]), pose_from_message(keyframes[1].T_odom_keyframe)
    assert psnr_at(after.map.rows, frame, T) > psnr_at(rows, frame, T) + 1


def test_refined_map_is_in_the_next_snapshot(keyframes) -> None:
    mapper = Mapper(SLOW_CHECKPOINTS)
    handle_all(mapper, keyframes[:2])
    before = mapper.snapshot()
    assert mapper.snapshot()["map"] is before["map"], "no keyframe was added"
    list(mapper.handle(RefineMap(stamp_ns=0, iterations=5)))
    assert mapper.snapshot()["map"] is not before["map"]


def test_optimized_keyframe_poses_are_published_as_refinements(keyframes) -> None:
    optimizer = GaussianOptimizerConfig(rotation_rate_rad=1e-3, translation_rate_m=1e-3)
    builder = MapBuilderConfig(optimizer=optimizer)
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


def test_correction_older_than_a_refinement_does_not_undo_it(keyframes) -> None:
    optimizer = GaussianOptimizerConfig(rotation_rate_rad=1e-3, translation_rate_m=1e-3)
    builder = MapBuilderConfig(optimizer=optimizer)
    mapper, optimizer = Mapper(replace(CONFIG, builder=builder, iterations=6)), Optimizer()
    for keyframe in keyframes[:4]:
        made = list(mapper.handle(keyframe))
        (before,) = optimizer.handle(keyframe_measurements_message(keyframe))
        refinements = [m for m in made if isinstance(m, KeyframeRefinement)]
        assert list(mapper.handle(before)) == [], "it was sent before the renderer moved them"
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


def test_map_that_does_not_grow_still_gets_regular_snapshots(keyframes) -> None:
    publish = replace(CONFIG.publish, min_snapshot_growth=100.0, max_snapshot_interval_keyframes=3)
    config = replace(CONFIG, publish=publish)
    made = [list(mapper_made) for mapper_made in map(Mapper(config).handle, keyframes[:8])]
    has_snapshot = [any(isinstance(m, MapSnapshot) for m in messages) for messages in made]
    assert has_snapshot == [True, False, False, True, False, False, True, False]


def psnr_at(rows: np.ndarray, frame: RgbdFrame, T_map_camera: np.ndarray) -> float:
    image = render(rows, frame.camera, se3.inverse(T_map_camera)).color.clip(0, 1)
    return psnr(image, frame.color / np.float32(255))


def test_late_replica_equals_the_map_after_the_final_snapshot(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    messages = changes(handle_all(mapper, [*keyframes, correction]))
    late = messages[messages.index(last_snapshot_part(messages)) + 1 :]
    replica = replicate(late)
    assert replica.version == 0, "no whole snapshot yet"
    replicate(mapper.on_stop(), replica)
    assert_equal_maps(replica, mapper)


def test_missed_delta_is_noticed_and_repaired_by_the_next_snapshot(keyframes) -> None:
    mapper = Mapper(CONFIG)
    messages = changes(handle_all(mapper, keyframes))
    deltas = [m for m in messages if isinstance(m, MapDelta)]
    replica = replicate([*deltas[:1], *deltas[2:]])
    assert replica.is_behind
    replicate(mapper.on_stop(), replica)
    assert not replica.is_behind
    assert_equal_maps(replica, mapper)


def test_a_correction_moves_gaussians_with_their_keyframes(keyframes, correction) -> None:
    mapper = Mapper(CONFIG)
    before = replicate(changes([*handle_all(mapper, keyframes), *mapper.on_stop()]))
    means, anchors = before.map.means.copy(), before.map.anchors.copy()
    after = replicate(changes(handle_all(mapper, [correction])), before)
    for k in keyframes:
        mine = anchors == k.keyframe
        T = se3.exp(np.array([0, 0.01, 0, 0.02, 0, 0]) * (1 + k.keyframe))
        np.testing.assert_allclose(after.map.means[mine], se3.transform(T, means[mine]), atol=1e-5)


def second_round(keyframes, T_drift: np.ndarray, first: int) -> list[Keyframe]:
    """Return the same keyframes after odometry drift, with ids from `first`."""
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


def test_surface_mapped_twice_is_deduplicated_after_loop_closure(keyframes) -> None:
    """The second round is 10 cm off and mapped again, until the loop is closed."""
    T_drift = se3.exp(np.array([0, 0, 0, 0, 0.1, 0]))
    second = second_round(keyframes[:3], T_drift, first=100)
    poses = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes[:3]}
    loop_correction = correction_to_message(0, 1, poses | {100 + k: T for k, T in poses.items()})
    frame, T_map_camera = frame_from_message(keyframes[0]), poses[keyframes[0].keyframe]
    added, quality = {}, {}
    for at_end in (0, 10):
        mapper = Mapper(replace(CONFIG, refit=LoopRefitConfig(deduplicated_at_end=at_end)))
        messages = handle_all(mapper, keyframes[:3])
        once = mapper.metrics()["gaussians"]
        messages += handle_all(mapper, [*second, loop_correction])
        before_stop = mapper.metrics()["gaussians"]
        messages += mapper.on_stop()
        assert mapper.metrics()["keyframes_to_deduplicate"] == 3 * (at_end == 0)
        held = mapper.metrics()["gaussians"]
        assert before_stop - held >= mapper.metrics()["gaussians_deduplicated"]
        added[at_end] = held - once
        replica = replicate(messages)
        assert replica.map.rows.tobytes() == mapper._map.gaussians.all().rows.tobytes()
        quality[at_end] = psnr_at(replica.map.rows, frame, T_map_camera)
    assert added[10] < 0.6 * added[0]
    assert quality[10] > quality[0] - 0.3


def mapper_after_loop_closure(keyframes, config: MapperConfig) -> Mapper:
    """Return a mapper that handled three keyframes, their second round and the loop correction."""
    T_drift = se3.exp(np.array([0, 0.02, 0, 0, 0.1, 0]))
    second = second_round(keyframes[:3], T_drift, first=100)
    poses = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes[:3]}
    loop_correction = correction_to_message(0, 1, poses | {100 + k: T for k, T in poses.items()})
    mapper = Mapper(config)
    handle_all(mapper, [*keyframes[:3], *second, loop_correction])
    return mapper


def psnr_of(mapper: Mapper, keyframe: Keyframe) -> float:
    T_map_camera = pose_from_message(keyframe.T_odom_keyframe)
    return psnr_at(mapper._map.gaussians.rows, frame_from_message(keyframe), T_map_camera)


def test_pending_iterations_restore_quality_after_loop_closure(
    keyframes,
) -> None:
    undisturbed = Mapper(CONFIG)
    handle_all(undisturbed, keyframes[:3])
    mapper = mapper_after_loop_closure(keyframes, CONFIG)
    facts = mapper.metrics()
    assert facts["iterations_pending"] == 3 * CONFIG.refit.iterations
    assert psnr_of(mapper, keyframes[1]) < psnr_of(undisturbed, keyframes[1]) - 1
    handle_all(mapper, [RefineMap(stamp_ns=0, iterations=30)])
    assert mapper.metrics()["iterations_pending"] == 6
    handle_all(mapper, [RefineMap(stamp_ns=0, iterations=6)])
    assert mapper.metrics()["iterations_pending"] == 0
    assert mapper.metrics()["iterations"] == facts["iterations"] + 36
    assert psnr_of(mapper, keyframes[1]) > psnr_of(undisturbed, keyframes[1])


def test_pending_work_is_done_while_no_keyframe_arrives(keyframes) -> None:
    undisturbed = Mapper(CONFIG)
    handle_all(undisturbed, keyframes[:3])
    mapper = mapper_after_loop_closure(keyframes, CONFIG)
    assert not undisturbed.has_idle_work()
    made = []
    while mapper.has_idle_work():
        made += mapper.on_idle()
    assert mapper.metrics()["iterations_pending"] == 0
    assert mapper.metrics()["keyframes_to_deduplicate"] == 0
    assert any(isinstance(message, MapDelta) for message in made)
    assert psnr_of(mapper, keyframes[1]) > psnr_of(undisturbed, keyframes[1])


def test_idle_work_since_the_checkpoint_gives_bitwise_equal_state(keyframes, tmp_path) -> None:
    config = replace(CONFIG, folder=str(tmp_path / "keyframes"), checkpoint_keyframes=100)
    first = mapper_after_loop_closure(keyframes, config)
    state = decode_state(encode_state(first.checkpoint()))
    shutil.copytree(tmp_path / "keyframes", tmp_path / "copy")
    steps = 3
    for _ in range(steps):
        list(first.on_idle())
    config = replace(config, folder=str(tmp_path / "copy"))
    idle = LoggedInput("", b"", {}, {})
    second = restore_actor(
        Mapper(config), RestoredState(state, taken=(idle,) * steps), lambda: Mapper(config)
    )
    one, other = first.checkpoint()["map"], second.checkpoint()["map"]
    for part in ("map", "poses", "links", "refit"):
        assert encode_state(one[part]) == encode_state(other[part]), part


def test_repeated_corrections_do_not_add_pending_iterations(keyframes) -> None:
    poses = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes[:4]}
    mapper = Mapper(CONFIG)
    handle_all(mapper, keyframes[:4])
    for version in range(1, 4):
        T_turned = se3.exp(np.array([0, 0.02 * version, 0, 0, 0, 0]))
        moved = {k: T if k < 2 else T_turned @ T for k, T in poses.items()}
        handle_all(mapper, [correction_to_message(0, version, moved)])
        assert mapper.metrics()["iterations_pending"] == 2 * CONFIG.refit.iterations


def test_rigid_motion_of_the_whole_map_needs_no_refit(keyframes) -> None:
    T_moved = se3.exp(np.array([0, 0.3, 0, 1, 0, 0]))
    moved = {k.keyframe: T_moved @ pose_from_message(k.T_odom_keyframe) for k in keyframes}
    mapper = Mapper(CONFIG)
    handle_all(mapper, [*keyframes, correction_to_message(0, 1, moved)])
    assert mapper.metrics()["iterations_pending"] == 0
    assert mapper.metrics()["keyframes_to_deduplicate"] == 0


def test_pending_iterations_run_only_without_backlog(keyframes, tmp_path) -> None:
    config = replace(CONFIG, refit=LoopRefitConfig(iterations=4), folder=str(tmp_path))
    mapper = mapper_after_loop_closure(keyframes, config)
    without_refit = mapper_after_loop_closure(
        keyframes,
        replace(config, refit=replace(config.refit, iterations_per_keyframe=0), folder=""),
    )
    pending, extra = [], []
    for i, k in enumerate(second_round(keyframes[3:7], np.eye(4), first=200)):
        if i == 2:
            previous, mapper = mapper, Mapper(config)
            mapper.restore(previous.checkpoint())
        before = [m.metrics()["iterations"] for m in (mapper, without_refit)]
        for one in (mapper, without_refit):
            one.situation = FlowStatus(backlog={KEYFRAME_NEW: int(i == 1)})
            handle_all(one, [k])
        done, usual = (
            m.metrics()["iterations"] - n
            for m, n in zip((mapper, without_refit), before, strict=True)
        )
        pending.append(mapper.metrics()["iterations_pending"])
        extra.append(done - usual)
    assert pending == [6, 6, 0, 0]
    assert extra == [6, 0, 6, 0]
    assert without_refit.metrics()["iterations_pending"] == 12


def test_state_without_pending_iterations_is_restored(keyframes) -> None:
    state = mapper_after_loop_closure(keyframes, CONFIG).checkpoint()
    state["map"]["refit"]["pending"] = {}
    mapper = Mapper(CONFIG)
    mapper.restore(state)
    assert mapper.metrics()["iterations_pending"] == 0
    assert mapper.metrics()["keyframes_to_deduplicate"] == 3


def test_correction_without_motion_gives_no_output(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handle_all(mapper, keyframes)
    same = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes}
    assert handle_all(mapper, [correction_to_message(0, 1, same)]) == []


def test_a_keyframe_sent_twice_counts_once(keyframes) -> None:
    mapper = Mapper(CONFIG)
    handle_all(mapper, keyframes[:2])
    assert handle_all(mapper, keyframes[1:2]) == []
    assert mapper.metrics()["keyframes_repeated"] == 1


def test_replica_of_a_killed_mapper_ends_equal_to_the_restored_mapper(keyframes) -> None:
    """The restored mapper lacks keyframes after the checkpoint and inserts other Gaussians."""
    first, second = Mapper(SLOW_CHECKPOINTS), Mapper(SLOW_CHECKPOINTS)
    replica = MapReplica()
    for keyframe in keyframes[:4]:  # The checkpoint holds the first keyframe only.
        replicate(changes(list(first.handle(keyframe))), replica)
        state = first.snapshot()
    second.restore(state)
    assert second.metrics()["gaussians"] < first.metrics()["gaussians"]
    replicate(changes(handle_all(second, keyframes[4:])), replica)
    replicate(second.on_stop(), replica)
    assert_equal_maps(replica, second)


def test_a_checkpoint_on_request_has_the_whole_map(keyframes) -> None:
    first, second = Mapper(CONFIG), Mapper(CONFIG)
    for keyframe in keyframes[:3]:
        list(first.handle(keyframe))
    second.restore(first.checkpoint())
    assert second.metrics()["gaussians"] == first.metrics()["gaussians"]


def test_restored_mapper_with_its_folder_continues_bitwise_equal(keyframes, tmp_path) -> None:
    """The keyframes that it optimizes against are on disk."""
    config = replace(CONFIG, folder=str(tmp_path / "keyframes"), iterations=4)
    first = Mapper(config)
    handle_all(first, keyframes[:5])
    state = decode_state(encode_state(first.checkpoint()))
    handle_all(first, keyframes[5:8])
    shutil.copytree(tmp_path / "keyframes", tmp_path / "copy")
    second = Mapper(replace(config, folder=str(tmp_path / "copy")))
    second.restore(state)
    handle_all(second, keyframes[5:8])
    assert (
        replicate(second.on_stop()).map.rows.tobytes()
        == replicate(first.on_stop()).map.rows.tobytes()
    )


def test_logged_inputs_since_the_checkpoint_give_bitwise_equal_state(
    keyframes, correction, tmp_path
) -> None:
    """Gaussians, keyframes, objects and the next ids are equal."""
    config = replace(LABELLING, folder=str(tmp_path / "keyframes"), checkpoint_keyframes=100)
    first = Mapper(config)
    inputs = [m for k in keyframes[:6] for m in (k, boxes_of(k))]
    inputs.insert(9, correction)
    handle_all(first, inputs[:1])
    state = decode_state(encode_state(first.snapshot()))
    published = handle_all(first, inputs[1:])
    shutil.copytree(tmp_path / "keyframes", tmp_path / "copy")
    config = replace(config, folder=str(tmp_path / "copy"))
    restored_state = RestoredState(state, taken=tuple(map(logged, inputs[1:])))
    second = restore_actor(Mapper(config), restored_state, lambda: Mapper(config))
    one, other = first.checkpoint()["map"], second.checkpoint()["map"]
    for part in ("map", "semantics", "poses", "links", "refit"):
        assert encode_state(one[part]) == encode_state(other[part]), part
    version = max(delta.version for delta in deltas_of(published))
    assert all(delta.version > version for delta in deltas_of(second.on_restored()))


def logged(message) -> LoggedInput:
    (port,) = (port for port in Mapper.inputs if port.topic.message is type(message))
    return LoggedInput.of(port.topic.name, encode(message), FlowStatus())


def test_restored_mapper_first_publishes_its_whole_map(keyframes) -> None:
    first, second = Mapper(CONFIG), Mapper(CONFIG)
    replica = replicate(changes(handle_all(first, keyframes[:3])))
    second.restore(first.checkpoint())
    restored_messages = list(second.on_restored())
    replicate(changes(restored_messages), replica)
    assert_equal_maps(replica, second)
    assert_equal_maps(replicate(changes(restored_messages)), second)
    assert list(Mapper(CONFIG).on_restored()) == []


def test_small_corrections_add_up_until_they_are_sent(keyframes) -> None:
    mapper = Mapper(CONFIG)
    replica = replicate(changes(handle_all(mapper, keyframes[:1])))
    before = replica.map.means.copy()
    for step in range(1, 101):
        T = pose_from_message(keyframes[0].T_odom_keyframe)
        T[0, 3] += step * 0.4e-4
        replicate(mapper.handle(correction_to_message(0, step, {0: T})), replica)
    moved = replica.map.means[:, 0] - before[:, 0]
    assert abs(float(np.median(moved)) - 40e-4) < 1.01e-4


def test_a_correction_without_a_map_is_harmless() -> None:
    assert list(Mapper(CONFIG).handle(correction_to_message(0, 1, {0: np.eye(4)}))) == []


def test_between_checkpoints_the_state_is_the_same_object(keyframes) -> None:
    mapper = Mapper(replace(CONFIG, checkpoint_keyframes=3))
    list(mapper.handle(keyframes[0]))
    first = mapper.snapshot()["map"]
    list(mapper.handle(keyframes[1]))
    assert mapper.snapshot()["map"] is first


def test_replica_follows_a_mapper_that_restarted_empty(keyframes) -> None:
    """The first delta, before any snapshot, is that of an empty map."""
    config = replace(CONFIG, publish=RARE_SNAPSHOTS)
    replica = replicate(changes(handle_all(Mapper(config), keyframes[:4])))
    assert replica.version > 1
    restarted = Mapper(config)
    replicate(deltas_of([*handle_all(restarted, keyframes[1:3]), *restarted.on_stop()]), replica)
    assert_equal_maps(replica, restarted)


def assert_equal_maps(replica: MapReplica, mapper: Mapper) -> None:
    """Assert that a replica of all messages equals the map and lacks no delta."""
    final_messages = list(mapper.on_stop())
    assert deltas_of(final_messages) == []
    snapshot = replicate(final_messages)
    assert replica.version == snapshot.version
    np.testing.assert_array_equal(replica.map.ids, snapshot.map.ids)
    np.testing.assert_array_equal(replica.map.anchors, snapshot.map.anchors)
    np.testing.assert_array_equal(replica.map.rows, snapshot.map.rows)
    np.testing.assert_array_equal(replica.map.labels, snapshot.map.labels)
    assert replica.label_names == snapshot.label_names


def test_dynamic_mask_of_a_keyframe_is_excluded_from_its_view(keyframes) -> None:
    first = keyframes[0]
    dynamic_mask = np.zeros((first.camera.height, first.camera.width), bool)
    dynamic_mask[40:80, 30:70] = True
    camera = frame_from_message(first).camera
    masked = msgspec.structs.replace(
        first, dynamic_mask=mask_to_array(dynamic_mask[::2, ::2], camera)
    )
    mapper = Mapper(CONFIG)
    handle_all(mapper, [masked])
    (view,) = (mapper._map.views[k] for k in mapper._map.views.poses)
    np.testing.assert_array_equal(view.mask == 0, dynamic_mask)


def test_empty_and_missing_dynamic_masks_are_decoded_as_none(keyframes) -> None:
    camera = frame_from_message(keyframes[0]).camera
    for no_motion in (None, np.zeros((8, 8), bool)):
        assert mask_from_array(mask_to_array(no_motion, camera)) is None


# --- labels -----------------------------------------------------------------------------------
def boxes_of(keyframe, label: str = "chair", network: str = "test") -> DetectionBoxes:
    """Return one detection in the middle of the image, or none without a network."""
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


def test_replica_has_equal_labels_and_label_names(keyframes) -> None:
    mapper, replica = Mapper(LABELLING), MapReplica()
    for keyframe in keyframes[:6]:
        boxes = boxes_of(keyframe, "lava lamp" if keyframe.keyframe > 2 else "chair")
        replicate(deltas_of(handle_all(mapper, [keyframe, boxes])), replica)
    replicate(deltas_of(mapper.on_stop()), replica)
    assert_equal_maps(replica, mapper)
    assert replica.label_names[-1] == "lava lamp"
    known = {replica.label_names[k] for k in np.unique(top_labels(replica.map.labels))}
    assert known == {"background", "chair", "lava lamp"}


def test_label_names_are_sent_only_when_new(keyframes) -> None:
    mapper, counts = Mapper(replace(LABELLING, publish=RARE_SNAPSHOTS)), []
    for keyframe in keyframes[:4]:
        made = handle_all(mapper, [keyframe, boxes_of(keyframe)])
        counts.append(sum(bool(delta.label_names) for delta in deltas_of(made)))
    assert counts == [0, 1, 0, 0]


def test_detections_without_network_label_nothing(keyframes) -> None:
    mapper = Mapper(LABELLING)
    messages = handle_all(mapper, [keyframes[0], boxes_of(keyframes[0], network="")])
    replica = replicate([*changes(messages), *mapper.on_stop()])
    assert not replica.map.labels.any()
    assert replica.label_names == ()


def test_labels_do_not_change_gaussians(keyframes) -> None:
    mapper, plain = Mapper(LABELLING), Mapper(LABELLING)
    for keyframe in keyframes[:5]:
        handle_all(mapper, [keyframe, boxes_of(keyframe)])
        handle_all(plain, [keyframe])
    labelled, without = replicate(mapper.on_stop()).map, replicate(plain.on_stop()).map
    assert top_labels(labelled.labels).any()
    assert labelled.rows.tobytes() == without.rows.tobytes()


def test_restored_mapper_keeps_labels_and_ignores_repeated_detections(keyframes, tmp_path) -> None:
    config = replace(LABELLING, folder=str(tmp_path / "keyframes"))
    first = Mapper(config)
    for keyframe in keyframes[:4]:
        handle_all(first, [keyframe, boxes_of(keyframe)])
    state = decode_state(encode_state(first.checkpoint()))
    shutil.copytree(tmp_path / "keyframes", tmp_path / "copy")
    second = Mapper(replace(config, folder=str(tmp_path / "copy")))
    second.restore(state)
    handle_all(second, [boxes_of(keyframes[3])])
    assert second.metrics()["boxes_repeated"] == 1
    ends = []
    for mapper in (first, second):
        handle_all(mapper, [boxes_of(keyframes[4]), keyframes[4]])
        ends.append(replicate(mapper.on_stop()))
    assert ends[0].map.labels.tobytes() == ends[1].map.labels.tobytes()
    assert ends[0].label_names == ends[1].label_names
    assert top_labels(ends[0].map.labels).any()


def test_checkpoints_of_a_large_map_are_farther_apart(keyframes, monkeypatch) -> None:
    assert MapperConfig().checkpoint_interval(100_000) == 5
    assert MapperConfig().checkpoint_interval(300_000) == 15
    monkeypatch.setattr(mapper_config, "GAUSSIANS_PER_KEYFRAME", 1)
    mapper = Mapper(SLOW_CHECKPOINTS)
    handle_all(mapper, keyframes[:1])
    first = mapper.snapshot()["map"]
    handle_all(mapper, keyframes[1:7])
    assert mapper.snapshot()["map"] is first
