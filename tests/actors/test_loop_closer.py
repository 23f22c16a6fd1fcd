"""Loop closures of a camera that returns to known places with drifted odometry."""

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from ldo_service.actors import loop_closer
from ldo_service.actors.loop_closer import LoopCloser, LoopCloserConfig
from ldo_service.conversions.poses import (
    correction_to_message,
    pose_from_message,
)
from ldo_service.geometry import se3
from ldo_service.loop_closing import LoopsConfig
from ldo_service.loop_closing.consistency_check import ConsistencyCheckConfig
from ldo_service.loop_closing.place_database import RetrievalConfig
from ldo_service.loop_closing.verification import LoopHypothesis, VerificationConfig, Verifier
from ldo_service.schemas import (
    Detection,
    DetectionBoxes,
    Keyframe,
    LoopCandidate,
    LoopClosure,
    Message,
    encode,
)
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking.features import FeatureConfig
from tests.actors.conftest import handle_all
from tests.actors.loop_walks import (
    DRIFT,
    FIRST_WALK,
    LONG_AFTER,
    SECOND_WALK,
    boxes_of,
    candidates,
    closures,
    keyframes_of,
    true_pose,
    with_empty_detections,
)


@pytest.fixture(scope="module")
def loop_messages(first_walk, second_walk) -> list[LoopClosure | LoopCandidate]:
    return handle_all(LoopCloser(), with_empty_detections([*first_walk, *second_walk]))


def test_return_with_drifted_odometry_is_closed_at_the_true_pose(loop_messages, room) -> None:
    found = closures(loop_messages)
    assert len(found) >= 2
    for closure in found:
        old, new = closure.pose.reference, closure.pose.keyframe - len(FIRST_WALK)
        T_true = se3.inverse(true_pose(room, FIRST_WALK[old])) @ true_pose(room, SECOND_WALK[new])
        T = pose_from_message(closure.pose.T_reference_keyframe)
        assert np.linalg.norm((se3.inverse(T_true) @ T)[:3, 3]) < 0.01
        assert se3.rotation_angle(se3.inverse(T_true) @ T) < 0.005
        assert closure.overlap > 0.2
        assert closure.rmse_m < 0.03
        assert np.linalg.eigvalsh(np.reshape(closure.pose.information, (6, 6))).min() > 0


def loop_closer_without_features(map_pairs: int = 3) -> LoopCloser:
    """Return a loop closer that accepts no match of features."""
    verification = VerificationConfig(min_inliers=10_000, map_pairs=map_pairs)
    loops = LoopsConfig(verification=verification, features=FeatureConfig(min_inliers=10_000))
    return LoopCloser(LoopCloserConfig(loops=loops))


def drifted_by(room, shift_m: float) -> list[Keyframe]:
    T_drift = se3.exp(np.array([0, 0, 0, shift_m, 0, 0]))
    return keyframes_of(room, SECOND_WALK, len(FIRST_WALK), LONG_AFTER, T_drift)


def test_without_feature_matches_closures_start_from_poses_in_the_map(first_walk, room) -> None:
    loop_messages = handle_all(
        loop_closer_without_features(),
        with_empty_detections([*first_walk, *drifted_by(room, 0.04)]),
    )
    found = closures(loop_messages)
    assert len(found) >= 2
    assert {c.evidence for c in candidates(loop_messages) if not c.rejected_reason} == {"map"}
    for closure in found:
        old, new = closure.pose.reference, closure.pose.keyframe - len(FIRST_WALK)
        T_true = se3.inverse(true_pose(room, FIRST_WALK[old])) @ true_pose(room, SECOND_WALK[new])
        T = pose_from_message(closure.pose.T_reference_keyframe)
        assert np.linalg.norm((se3.inverse(T_true) @ T)[:3, 3]) < 0.01


@pytest.mark.parametrize(("shift_m", "map_pairs"), [(0.04, 0), (0.04, 1), (0.8, 3)])
def test_map_hypothesis_far_off_or_with_too_few_pairs_is_rejected(
    first_walk, room, shift_m: float, map_pairs: int
) -> None:
    actor = loop_closer_without_features(map_pairs)
    found = handle_all(actor, with_empty_detections([*first_walk, *drifted_by(room, shift_m)]))
    assert candidates(found)
    assert closures(found) == []


def test_every_candidate_has_scores_and_evidence_or_a_rejection_reason(loop_messages) -> None:
    found = candidates(loop_messages)
    assert sum(not candidate.rejected_reason for candidate in found) == len(closures(loop_messages))
    for candidate in found:
        assert 3 <= len(candidate.keyframes) <= 5
        assert candidate.reference_keyframes[-1] == candidate.reference < candidate.keyframe
        assert candidate.similarity == 0, "no detections"
        assert candidate.appearance >= RetrievalConfig().min_appearance
        assert candidate.evidence == "features" or candidate.rejected_reason


def test_recently_seen_place_is_no_candidate(first_walk, room) -> None:
    soon = keyframes_of(room, SECOND_WALK, len(FIRST_WALK), 60, DRIFT)
    assert handle_all(LoopCloser(), with_empty_detections([*first_walk, *soon])) == []


def test_partly_recent_subgraphs_are_closed_by_keyframes_of_100_frames_apart(
    first_walk, room
) -> None:
    """The walks are 68 frames apart, their ends 122 frames."""
    soon = keyframes_of(room, SECOND_WALK, len(FIRST_WALK), 95, DRIFT)
    found = closures(handle_all(LoopCloser(), with_empty_detections([*first_walk, *soon])))
    frames = {k.keyframe: k.frame for k in [*first_walk, *soon]}
    assert found
    for closure in found:
        assert frames[closure.pose.keyframe] - frames[closure.pose.reference] > 100


@pytest.mark.parametrize(("max_motion_rad", "shift_m"), [(0.0, 0.04), (0.7, 0.04), (0.7, 3.0)])
def test_nearest_subgraph_is_a_candidate_without_a_similar_one(
    first_walk, room, max_motion_rad: float, shift_m: float
) -> None:
    retrieval = RetrievalConfig(min_appearance=2.0, max_motion_rad=max_motion_rad)
    actor = LoopCloser(LoopCloserConfig(loops=LoopsConfig(retrieval=retrieval)))
    messages = with_empty_detections([*first_walk, *drifted_by(room, shift_m)])
    found = handle_all(actor, messages)
    if max_motion_rad and shift_m < 1:
        assert len(closures(found)) >= 2
    else:
        assert found == []


def test_nearest_subgraph_is_not_verified_after_a_closure(first_walk, room) -> None:
    """One candidate is similar, and another subgraph of the place is the nearest one."""
    loops = LoopsConfig(retrieval=RetrievalConfig(candidates=1))
    actor = LoopCloser(LoopCloserConfig(loops=loops))
    messages = with_empty_detections([*first_walk, *drifted_by(room, 0.04)])
    found = handle_all(actor, messages)
    assert len(closures(found)) == len(candidates(found)) >= 2


def test_similar_place_beyond_possible_drift_is_rejected(first_walk, room) -> None:
    """The same images, 1.5 m away or turned by 60 degrees, which is more than odometry drifts."""
    for xi in (np.array([0, 0, 0, 1.5, 0, 0.0]), np.array([0, np.pi / 3, 0, 0, 0, 0])):
        T_away = true_pose(room, 10) @ se3.exp(xi) @ se3.inverse(true_pose(room, 10))
        elsewhere = keyframes_of(room, SECOND_WALK, len(FIRST_WALK), LONG_AFTER, T_away)
        found = handle_all(LoopCloser(), with_empty_detections([*first_walk, *elsewhere]))
        assert closures(found) == []
        assert any("of drift after" in candidate.rejected_reason for candidate in candidates(found))


def test_distance_to_an_unmerged_submap_rejects_no_closure(first_walk, room) -> None:
    far = se3.exp(np.array([0, 1.0, 0, 30.0, 0, 0]))
    other = [
        msgspec.structs.replace(k, submap=1)
        for k in keyframes_of(room, SECOND_WALK, len(FIRST_WALK), LONG_AFTER, far)
    ]
    assert closures(handle_all(LoopCloser(), with_empty_detections([*first_walk, *other])))


@pytest.mark.parametrize(("last", "subgraphs"), [(2, 0), (3, 1), (4, 1)])
def test_three_keyframes_before_a_new_submap_form_a_subgraph(first_walk, last, subgraphs) -> None:
    actor = LoopCloser()
    before = first_walk[:last]
    after = msgspec.structs.replace(first_walk[5], submap=1)
    handle_all(actor, with_empty_detections([*before, after]))
    assert len(actor.recognizer.subgraphs) == subgraphs
    for subgraph in actor.recognizer.subgraphs:
        assert list(subgraph.keyframes) == [k.keyframe for k in before]


def test_place_that_matches_two_old_places_is_closed_with_neither(first_walk, room) -> None:
    """The first walk is repeated 3 m away, as in a second room that looks the same."""
    T_other_room = np.eye(4)
    T_other_room[0, 3] = 3.0
    other_room = keyframes_of(room, FIRST_WALK, len(first_walk), LONG_AFTER, T_other_room)
    second_walk = keyframes_of(room, SECOND_WALK[:5], 2 * len(first_walk), 2 * LONG_AFTER, DRIFT)
    permissive = ConsistencyCheckConfig(drift_m=100.0, turn_rad=7.0)
    actor = LoopCloser(LoopCloserConfig(loops=LoopsConfig(plausibility=permissive)))
    handle_all(actor, with_empty_detections([*first_walk, *other_room]))
    found = handle_all(actor, with_empty_detections(second_walk))
    assert closures(found) == []
    assert any("ambiguous" in candidate.rejected_reason for candidate in candidates(found))


def test_hypothesis_with_a_wrong_pose_is_rejected(first_walk, second_walk) -> None:
    """Two keyframes of one place close a loop only at their true relative pose."""
    actor, config = LoopCloser(), LoopsConfig()
    handle_all(actor, with_empty_detections([*first_walk, *second_walk]))
    first, *_, last = actor.recognizer.subgraphs
    old, new = first.views[-1], last.views[0]
    verifier = Verifier(config.pyramid, config.align, config.features, config.verification, 100)
    T = se3.inverse(old.place.T_odom_keyframe) @ se3.inverse(DRIFT) @ new.place.T_odom_keyframe
    assert verifier.verify(LoopHypothesis(old, new, T, "features", 99)).closure is not None
    for axis, step in ((0, 0.5), (2, 0.7), (3, 0.8), (4, 0.6), (5, -0.9)):
        xi = np.zeros(6)
        xi[axis] = step
        planted = verifier.verify(LoopHypothesis(old, new, T @ se3.exp(xi), "features", 99))
        assert planted.closure is None
        assert planted.rejected_reason


def test_low_overlap_is_accepted_with_features_and_rejected_with_landmarks(room) -> None:
    """Frames 9 and 72 have an overlap of a third, which suffices for features."""
    actor, config = LoopCloser(), LoopsConfig()
    keyframes = keyframes_of(room, range(9, 14), 0, 0), keyframes_of(room, range(72, 77), 5, 500)
    handle_all(actor, with_empty_detections([*keyframes[0], *keyframes[1]]))
    old, new = (subgraph.views[0] for subgraph in actor.recognizer.subgraphs)
    verifier = Verifier(config.pyramid, config.align, config.features, config.verification, 100)
    T = se3.inverse(true_pose(room, 9)) @ true_pose(room, 72)
    assert verifier.verify(LoopHypothesis(old, new, T, "features", 99)).closure is not None
    assert verifier.verify(LoopHypothesis(old, new, T, "landmarks", 99)).rejected_reason.startswith(
        "overlap"
    )


def test_same_messages_give_bitwise_equal_outputs(first_walk, second_walk, loop_messages) -> None:
    again = handle_all(LoopCloser(), with_empty_detections([*first_walk, *second_walk]))
    assert [encode(message) for message in again] == [encode(message) for message in loop_messages]


def test_restored_loop_closer_continues_bitwise_equal(first_walk, second_walk) -> None:
    messages = with_empty_detections([*first_walk, *second_walk])
    for split in (13, 2 * len(first_walk) + 7):
        first, second = LoopCloser(), LoopCloser()
        handle_all(first, messages[:split])
        state = {name: decode_state(encode_state(part)) for name, part in first.snapshot().items()}
        second.restore(state)
        expected, got = (handle_all(actor, messages[split:]) for actor in (first, second))
        assert [encode(m) for m in got] == [encode(m) for m in expected]


def test_snapshot_replaces_only_changed_parts(first_walk) -> None:
    actor = LoopCloser()
    handle_all(actor, with_empty_detections(first_walk[:7]))
    before = dict(actor.snapshot())
    assert actor.snapshot()["now"] is before["now"], "no message since"
    handle_all(actor, with_empty_detections(first_walk[7:8]))
    after = actor.snapshot()
    assert any(name.startswith("subgraph_") for name in before)
    for name, part in before.items():
        if name.startswith("subgraph_"):
            assert after[name] is part


def test_detections_alone_leave_the_poses_of_the_snapshot(first_walk) -> None:
    actor = LoopCloser()
    handle_all(actor, [*with_empty_detections(first_walk[:6]), first_walk[6]])
    before = dict(actor.snapshot())
    handle_all(actor, [boxes_of(first_walk[6])])
    after = actor.snapshot()
    assert after["now"] is not before["now"]
    assert after["poses"] is before["poses"]


def test_a_keyframe_sent_twice_counts_once(first_walk) -> None:
    actor = LoopCloser()
    handle_all(actor, with_empty_detections([*first_walk[:4], *first_walk[2:4], *first_walk[4:]]))
    assert actor.metrics()["keyframes_repeated"] == 2
    assert [k for s in actor.recognizer.subgraphs for k in s.keyframes] == list(
        range(len(first_walk))
    )


def test_missing_detections_do_not_block_loop_closing(
    first_walk, second_walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_closer, "MAX_PENDING_KEYFRAMES", 4)
    messages = with_empty_detections([*first_walk, *second_walk])
    incomplete = [m for m in messages if not (isinstance(m, DetectionBoxes) and m.keyframe == 4)]
    actor = LoopCloser()
    assert len(closures(handle_all(actor, incomplete))) >= 2
    assert actor.metrics()["keyframes_without_detections"] == 1
    undetected = LoopCloser()
    handle_all(undetected, [*first_walk, *second_walk])
    assert (
        undetected.metrics()["keyframes_without_detections"]
        == len([*first_walk, *second_walk]) - loop_closer.MAX_PENDING_KEYFRAMES
    )


def test_last_keyframes_of_a_parked_robot_are_compared(first_walk, second_walk) -> None:
    actor = LoopCloser()
    handle_all(actor, with_empty_detections([*first_walk, *second_walk[:3]]))
    assert actor.has_idle_work()
    (closure,) = closures(list(actor.on_idle()))
    assert not actor.has_idle_work()
    assert closure.pose.keyframe in {k.keyframe for k in second_walk[:3]}
    assert list(actor.on_stop()) == [], "they are compared once"


def test_parked_robot_waits_for_detections(first_walk) -> None:
    actor = LoopCloser()
    handle_all(actor, first_walk[:4])
    assert not actor.has_idle_work()


def test_last_keyframes_are_compared_on_stop(first_walk, second_walk) -> None:
    actor = LoopCloser()
    loop_messages = handle_all(actor, with_empty_detections([*first_walk, *second_walk[:3]]))
    assert not any(one.keyframe == second_walk[2].keyframe for one in candidates(loop_messages))
    last = list(actor.on_stop())
    (closure,) = closures(last)
    assert {one.keyframes for one in candidates(last)} == {
        tuple(k.keyframe for k in second_walk[:3])
    }
    assert closure.pose.reference in {k.keyframe for k in first_walk}
    assert not list(actor.on_stop()), "published once"


def test_keyframes_across_a_jump_share_no_subgraph(room) -> None:
    """The camera may have moved a long way between such keyframes."""
    elsewhere = se3.exp(np.array([0.0, 2.5, 0.0, 0.0, 0.0, 0.0]))
    before = keyframes_of(room, range(0, 4, 2), 0, 0)
    after = keyframes_of(room, range(0, 20, 2), 2, LONG_AFTER, elsewhere)
    closer = LoopCloser()
    handle_all(closer, with_empty_detections([*before, *after]))
    are_before = [{k < 2 for k in subgraph.keyframes} for subgraph in closer.recognizer.subgraphs]
    assert len(are_before) > 1
    assert all(old == {False} for old in are_before)


def test_number_of_subgraphs_is_bounded(first_walk, second_walk) -> None:
    config = LoopCloserConfig(loops=LoopsConfig(retrieval=RetrievalConfig(count=3)))
    actor = LoopCloser(config)
    handle_all(actor, with_empty_detections([*first_walk, *second_walk]))
    assert actor.metrics()["subgraphs"] == 3


def test_corrected_poses_decide_whether_a_closure_is_plausible(first_walk, second_walk) -> None:
    """The distance between places is that in the map, not in odometry."""
    messages = with_empty_detections([*first_walk, *second_walk[:5]])
    T_away = np.eye(4)
    T_away[0, 3] = 3.0
    T_map = {
        k.keyframe: pose_from_message(k.T_odom_keyframe) for k in (*first_walk, *second_walk[:5])
    }
    T_map |= {k.keyframe: T_away @ T_map[k.keyframe] for k in first_walk}
    corrected = [*messages[:-2], correction_to_message(0, 1, T_map), *messages[-2:]]
    kept, moved = (closures(handle_all(LoopCloser(), inputs)) for inputs in (messages, corrected))
    assert len(kept) > len(moved)


# --- detections -----------------------------------------------------------------------------------
def detections_of(keyframe: Keyframe, *labels: str) -> DetectionBoxes:
    found = tuple(
        Detection(label=label, score=0.8, box_px=(20.0 + 70 * n, 80, 80.0 + 70 * n, 160))
        for n, label in enumerate(labels)
    )
    return boxes_of(keyframe, *found, network="test")


def with_detections(keyframes: Sequence[Keyframe], *labels: str) -> list[Message]:
    return [m for keyframe in keyframes for m in (keyframe, detections_of(keyframe, *labels))]


def test_equal_detected_labels_give_high_similarity(first_walk, second_walk) -> None:
    messages = [
        *with_detections(first_walk, "chair", "sink", "cup"),
        *with_detections(second_walk, "chair", "sink", "cup"),
    ]
    found = handle_all(LoopCloser(), messages)
    assert closures(found)
    assert all(candidate.similarity > 0.99 for candidate in candidates(found))


def test_different_labels_without_appearance_give_no_candidate(first_walk, second_walk) -> None:
    # Labels alone decide, as in the paper.
    literal = RetrievalConfig(min_appearance=1.1, max_motion_rad=0)
    actor = LoopCloser(LoopCloserConfig(loops=LoopsConfig(retrieval=literal)))
    messages = [
        *with_detections(first_walk, "chair", "sink"),
        *with_detections(second_walk, "bed", "toilet"),
    ]
    assert handle_all(actor, messages) == []


def test_dynamic_classes_do_not_describe_a_place(first_walk) -> None:
    actor = LoopCloser()
    handle_all(actor, with_detections(first_walk, "person"))
    assert all(not subgraph.names.any() for subgraph in actor.recognizer.subgraphs)


@pytest.mark.parametrize("stages", ["geometric", "semantic"])
def test_each_verification_stage_alone_closes_loops(stages, first_walk, second_walk) -> None:
    actor = LoopCloser(LoopCloserConfig(loops=LoopsConfig(stages=stages)))
    labels = "chair", "sink", "cup", "bottle"
    found = handle_all(
        actor, [*with_detections(first_walk, *labels), *with_detections(second_walk, *labels)]
    )
    assert candidates(found)
    for candidate in candidates(found):
        if stages == "geometric":
            assert candidate.similarity == 0
        else:
            assert candidate.evidence in ("", "landmarks")
    assert closures(found)
