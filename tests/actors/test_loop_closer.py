"""Places that are seen again: a camera that walks, comes back with odometry that has drifted."""

from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
import pytest

from ldo_service.actors.loop_closer import MAX_PENDING_KEYFRAMES, LoopCloser, LoopCloserConfig
from ldo_service.conversions.frames import camera_to_message
from ldo_service.conversions.poses import (
    correction_to_message,
    matrix6_to_message,
    pose_from_message,
    pose_to_message,
)
from ldo_service.geometry import se3
from ldo_service.loop_closing import LoopsConfig
from ldo_service.loop_closing.consistency_check import ConsistencyCheckConfig
from ldo_service.loop_closing.place_database import RetrievalConfig
from ldo_service.loop_closing.verification import LoopHypothesis, VerificationConfig, Verifier
from ldo_service.schemas import (
    Array,
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

FIRST_WALK, SECOND_WALK = range(0, 20, 2), range(1, 21, 2)
DRIFT = se3.exp(np.array([0.02, -0.03, 0.02, 0.15, -0.1, 0.1]))  # 2 degrees and 20 cm
LONG_AFTER = 500  # frames
AS_TRACKED = np.eye(4)
SURE = matrix6_to_message(1e4 * np.eye(6))


def keyframes_of(
    room, indices: Iterable[int], first: int, frame: int, T_drift: np.ndarray = AS_TRACKED
) -> list[Keyframe]:
    """Keyframes of frames of the room, numbered from `first` and from camera frame `frame`."""
    return [
        keyframe_of(room, index, first + n, frame + 3 * n, T_drift)
        for n, index in enumerate(indices)
    ]


def keyframe_of(room, index: int, number: int, frame: int, T_drift: np.ndarray) -> Keyframe:
    """Without a reference: its odometry is its place in the map until a correction comes."""
    view, T_odom = room[index], T_drift @ true_pose(room, index)
    return Keyframe(
        stamp_ns=10**8 * number,
        keyframe=number,
        frame=frame,
        camera=camera_to_message(view.camera),
        color=Array.of(view.color),
        depth_m=Array.of(view.depth_m),
        reference=None,
        T_reference_keyframe=pose_to_message(np.eye(4)),
        information=SURE,
        T_odom_keyframe=pose_to_message(T_odom),
    )


def true_pose(room, index: int) -> np.ndarray:
    return room.truth().T_world_camera[index]


def boxes_of(keyframe: Keyframe, *detections: Detection, network: str = "") -> DetectionBoxes:
    return DetectionBoxes(
        stamp_ns=keyframe.stamp_ns,
        keyframe=keyframe.keyframe,
        width=keyframe.camera.width,
        height=keyframe.camera.height,
        detections=detections,
        network=network,
    )


def told(keyframes: Sequence[Keyframe]) -> list[Message]:
    """With the boxes of nobody who looked."""
    return [m for keyframe in keyframes for m in (keyframe, boxes_of(keyframe))]


def handled(actor: LoopCloser, messages: Iterable[Message]) -> list[LoopClosure | LoopCandidate]:
    return [said for message in messages for said in actor.handle(message)]


def closures(said: Iterable[Message]) -> list[LoopClosure]:
    return [message for message in said if isinstance(message, LoopClosure)]


def candidates(said: Iterable[Message]) -> list[LoopCandidate]:
    return [message for message in said if isinstance(message, LoopCandidate)]


@pytest.fixture(scope="module")
def there(room) -> list[Keyframe]:
    return keyframes_of(room, FIRST_WALK, 0, 0)


@pytest.fixture(scope="module")
def back(room) -> list[Keyframe]:
    return keyframes_of(room, SECOND_WALK, len(FIRST_WALK), LONG_AFTER, DRIFT)


@pytest.fixture(scope="module")
def said(there, back) -> list[LoopClosure | LoopCandidate]:
    return handled(LoopCloser(), told([*there, *back]))


def test_the_return_is_closed_with_the_true_pose_whatever_odometry_says(said, room) -> None:
    found = closures(said)
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


def without_features(map_pairs: int = 3) -> LoopCloser:
    """For whom no number of features is enough."""
    verification = VerificationConfig(min_inliers=10_000, map_pairs=map_pairs)
    loops = LoopsConfig(verification=verification, features=FeatureConfig(min_inliers=10_000))
    return LoopCloser(LoopCloserConfig(loops=loops))


def drifted_by(room, shift_m: float) -> list[Keyframe]:
    T_drift = se3.exp(np.array([0, 0, 0, shift_m, 0, 0]))
    return keyframes_of(room, SECOND_WALK, len(FIRST_WALK), LONG_AFTER, T_drift)


def test_where_features_do_not_match_the_map_says_where_to_look(there, room) -> None:
    said = handled(without_features(), told([*there, *drifted_by(room, 0.04)]))
    found = closures(said)
    assert len(found) >= 2
    assert {c.evidence for c in candidates(said) if not c.rejected_reason} == {"map"}
    for closure in found:
        old, new = closure.pose.reference, closure.pose.keyframe - len(FIRST_WALK)
        T_true = se3.inverse(true_pose(room, FIRST_WALK[old])) @ true_pose(room, SECOND_WALK[new])
        T = pose_from_message(closure.pose.T_reference_keyframe)
        assert np.linalg.norm((se3.inverse(T_true) @ T)[:3, 3]) < 0.01


@pytest.mark.parametrize(("shift_m", "map_pairs"), [(0.04, 0), (0.04, 1), (0.8, 3)])
def test_the_map_is_not_believed_without_two_images_near_to_where_it_says(
    there, room, shift_m: float, map_pairs: int
) -> None:
    actor = without_features(map_pairs)
    found = handled(actor, told([*there, *drifted_by(room, shift_m)]))
    assert candidates(found)
    assert closures(found) == []


def test_every_candidate_is_told_with_its_scores_and_a_reason(said) -> None:
    found = candidates(said)
    assert sum(not candidate.rejected_reason for candidate in found) == len(closures(said))
    for candidate in found:
        assert 3 <= len(candidate.keyframes) <= 5
        assert candidate.reference_keyframes[-1] == candidate.reference < candidate.keyframe
        assert candidate.similarity == 0, "nobody looked"
        assert candidate.appearance >= RetrievalConfig().min_appearance
        assert candidate.evidence == "features" or candidate.rejected_reason


def test_what_was_seen_a_moment_ago_is_no_loop(there, room) -> None:
    soon = keyframes_of(room, SECOND_WALK, len(FIRST_WALK), 60, DRIFT)
    assert handled(LoopCloser(), told([*there, *soon])) == []


def test_a_twin_where_no_drift_leads_is_refused(there, room) -> None:
    """The same images, 1.5 m from where they can be, and turned by 60 degrees."""
    for xi in (np.array([0, 0, 0, 1.5, 0, 0.0]), np.array([0, np.pi / 3, 0, 0, 0, 0])):
        T_away = true_pose(room, 10) @ se3.exp(xi) @ se3.inverse(true_pose(room, 10))
        elsewhere = keyframes_of(room, SECOND_WALK, len(FIRST_WALK), LONG_AFTER, T_away)
        found = handled(LoopCloser(), told([*there, *elsewhere]))
        assert closures(found) == []
        assert any("of drift after" in candidate.rejected_reason for candidate in candidates(found))


def test_of_a_submap_that_is_apart_the_map_says_nothing(there, room) -> None:
    far = se3.exp(np.array([0, 1.0, 0, 30.0, 0, 0]))
    other = [
        msgspec.structs.replace(k, submap=1)
        for k in keyframes_of(room, SECOND_WALK, len(FIRST_WALK), LONG_AFTER, far)
    ]
    assert closures(handled(LoopCloser(), told([*there, *other])))


@pytest.mark.parametrize(("last", "subgraphs"), [(2, 0), (3, 1), (4, 1)])
def test_what_was_seen_before_a_break_is_a_place(there, last, subgraphs) -> None:
    actor = LoopCloser()
    before = there[:last]
    after = msgspec.structs.replace(there[5], submap=1)
    handled(actor, told([*before, after]))
    assert len(actor.recognizer.subgraphs) == subgraphs
    for subgraph in actor.recognizer.subgraphs:
        assert list(subgraph.keyframes) == [k.keyframe for k in before]


def test_a_place_that_two_old_ones_explain_is_closed_with_neither(there, room) -> None:
    """Between them the first walk is repeated 3 m away, as in a second room like it."""
    T_twin = np.eye(4)
    T_twin[0, 3] = 3.0
    twin = keyframes_of(room, FIRST_WALK, len(there), LONG_AFTER, T_twin)
    again = keyframes_of(room, SECOND_WALK[:5], 2 * len(there), 2 * LONG_AFTER, DRIFT)
    believing = ConsistencyCheckConfig(drift_m=100.0, turn_rad=7.0)
    actor = LoopCloser(LoopCloserConfig(loops=LoopsConfig(plausibility=believing)))
    handled(actor, told([*there, *twin]))
    found = handled(actor, told(again))
    assert closures(found) == []
    assert any("ambiguous" in candidate.rejected_reason for candidate in candidates(found))


def test_planted_poses_are_refused(there, back) -> None:
    """Two keyframes that do show one place: with their pose they close a loop, with others not."""
    actor, config = LoopCloser(), LoopsConfig()
    handled(actor, told([*there, *back]))
    first, *_, last = actor.recognizer.subgraphs
    old, new = first.views[-1], last.views[0]
    verifier = Verifier(config.pyramid, config.align, config.features, config.verification)
    T = se3.inverse(old.place.T_odom_keyframe) @ se3.inverse(DRIFT) @ new.place.T_odom_keyframe
    assert verifier.verify(LoopHypothesis(old, new, T, "features", 99)).closure is not None
    for axis, step in ((0, 0.5), (2, 0.7), (3, 0.8), (4, 0.6), (5, -0.9)):
        xi = np.zeros(6)
        xi[axis] = step
        planted = verifier.verify(LoopHypothesis(old, new, T @ se3.exp(xi), "features", 99))
        assert planted.closure is None
        assert planted.rejected_reason


def test_landmarks_alone_are_not_believed_where_little_is_seen_twice(room) -> None:
    """Frames 9 and 72 share a third of what they see: enough where features vouch for the pose."""
    actor, config = LoopCloser(), LoopsConfig()
    keyframes = keyframes_of(room, range(9, 14), 0, 0), keyframes_of(room, range(72, 77), 5, 500)
    handled(actor, told([*keyframes[0], *keyframes[1]]))
    old, new = (subgraph.views[0] for subgraph in actor.recognizer.subgraphs)
    verifier = Verifier(config.pyramid, config.align, config.features, config.verification)
    T = se3.inverse(true_pose(room, 9)) @ true_pose(room, 72)
    assert verifier.verify(LoopHypothesis(old, new, T, "features", 99)).closure is not None
    assert verifier.verify(LoopHypothesis(old, new, T, "landmarks", 99)).rejected_reason.startswith(
        "overlap"
    )


def test_nothing_depends_on_anything_but_the_messages(there, back, said) -> None:
    again = handled(LoopCloser(), told([*there, *back]))
    assert [encode(message) for message in again] == [encode(message) for message in said]


def test_a_successor_goes_on_as_if_nothing_had_been(there, back) -> None:
    messages = told([*there, *back])
    for split in (13, 2 * len(there) + 7):
        first, second = LoopCloser(), LoopCloser()
        handled(first, messages[:split])
        state = {name: decode_state(encode_state(part)) for name, part in first.snapshot().items()}
        second.restore(state)
        expected, got = (handled(actor, messages[split:]) for actor in (first, second))
        assert [encode(m) for m in got] == [encode(m) for m in expected]


def test_a_state_writes_what_is_new_alone(there) -> None:
    actor = LoopCloser()
    handled(actor, told(there[:7]))
    before = dict(actor.snapshot())
    assert actor.snapshot()["now"] is before["now"], "nothing has come since"
    handled(actor, told(there[7:8]))
    after = actor.snapshot()
    assert any(name.startswith("subgraph_") for name in before)
    for name, part in before.items():
        if name.startswith("subgraph_"):
            assert after[name] is part


def test_boxes_alone_write_no_poses(there) -> None:
    actor = LoopCloser()
    handled(actor, [*told(there[:6]), there[6]])
    before = dict(actor.snapshot())
    handled(actor, [boxes_of(there[6])])
    after = actor.snapshot()
    assert after["now"] is not before["now"]
    assert after["poses"] is before["poses"]


def test_a_keyframe_sent_twice_counts_once(there) -> None:
    actor = LoopCloser()
    handled(actor, told([*there[:4], *there[2:4], *there[4:]]))
    assert actor.metrics()["keyframes_repeated"] == 2
    assert [k for s in actor.recognizer.subgraphs for k in s.keyframes] == list(range(len(there)))


def test_boxes_that_never_come_hold_nobody_up(there, back) -> None:
    messages = told([*there, *back])
    lost = [m for m in messages if not (isinstance(m, DetectionBoxes) and m.keyframe == 4)]
    actor = LoopCloser()
    assert len(closures(handled(actor, lost))) >= 2
    assert actor.metrics()["keyframes_without_detections"] == 1
    alone = LoopCloser()
    handled(alone, [*there, *back])
    assert (
        alone.metrics()["keyframes_without_detections"]
        == len([*there, *back]) - MAX_PENDING_KEYFRAMES
    )


def test_what_a_walk_ends_with_is_compared_though_no_keyframe_follows(there, back) -> None:
    actor = LoopCloser()
    said = handled(actor, told([*there, *back[:3]]))
    assert not any(one.keyframe == back[2].keyframe for one in candidates(said))
    last = list(actor.on_stop())
    (closure,) = closures(last)
    assert {one.keyframes for one in candidates(last)} == {tuple(k.keyframe for k in back[:3])}
    assert closure.pose.reference in {k.keyframe for k in there}
    assert not list(actor.on_stop()), "once"


def test_keyframes_that_do_not_follow_each_other_are_no_subgraph(room) -> None:
    """Between them the camera may have gone a long way past keyframes that it knew."""
    elsewhere = se3.exp(np.array([0.0, 2.5, 0.0, 0.0, 0.0, 0.0]))
    here = keyframes_of(room, range(0, 4, 2), 0, 0)
    there = keyframes_of(room, range(0, 20, 2), 2, LONG_AFTER, elsewhere)
    closer = LoopCloser()
    handled(closer, told([*here, *there]))
    together = [{k < 2 for k in subgraph.keyframes} for subgraph in closer.recognizer.subgraphs]
    assert len(together) > 1
    assert all(old == {False} for old in together)


def test_memory_is_bounded(there, back) -> None:
    config = LoopCloserConfig(loops=LoopsConfig(retrieval=RetrievalConfig(count=3)))
    actor = LoopCloser(config)
    handled(actor, told([*there, *back]))
    assert actor.metrics()["subgraphs"] == 3


def test_corrections_move_what_is_judged_by(there, back) -> None:
    """The map, and not odometry, says how far a place is from where it was."""
    messages = told([*there, *back[:5]])
    T_away = np.eye(4)
    T_away[0, 3] = 3.0
    T_map = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in (*there, *back[:5])}
    T_map |= {k.keyframe: T_away @ T_map[k.keyframe] for k in there}
    corrected = [*messages[:-2], correction_to_message(0, 1, T_map), *messages[-2:]]
    kept, moved = (closures(handled(LoopCloser(), said)) for said in (messages, corrected))
    assert len(kept) > len(moved)


# --- what a detector says -------------------------------------------------------------------------
def things(keyframe: Keyframe, *labels: str) -> DetectionBoxes:
    found = tuple(
        Detection(label=label, score=0.8, box_px=(20.0 + 70 * n, 80, 80.0 + 70 * n, 160))
        for n, label in enumerate(labels)
    )
    return boxes_of(keyframe, *found, network="test")


def named(keyframes: Sequence[Keyframe], *labels: str) -> list[Message]:
    return [m for keyframe in keyframes for m in (keyframe, things(keyframe, *labels))]


def test_names_are_compared_where_somebody_looked(there, back) -> None:
    messages = [*named(there, "chair", "sink", "cup"), *named(back, "chair", "sink", "cup")]
    found = handled(LoopCloser(), messages)
    assert closures(found)
    assert all(candidate.similarity > 0.99 for candidate in candidates(found))


def test_other_names_keep_places_apart_when_images_have_no_say(there, back) -> None:
    literal = RetrievalConfig(min_appearance=1.1)  # as the paper has it
    actor = LoopCloser(LoopCloserConfig(loops=LoopsConfig(retrieval=literal)))
    assert handled(actor, [*named(there, "chair", "sink"), *named(back, "bed", "toilet")]) == []


def test_people_are_no_mark_of_a_place(there) -> None:
    actor = LoopCloser()
    handled(actor, named(there, "person"))
    assert all(not subgraph.names.any() for subgraph in actor.recognizer.subgraphs)


@pytest.mark.parametrize("stages", ["geometric", "semantic"])
def test_one_stage_alone_can_be_chosen(stages, there, back) -> None:
    actor = LoopCloser(LoopCloserConfig(loops=LoopsConfig(stages=stages)))
    labels = "chair", "sink", "cup", "bottle"
    found = handled(actor, [*named(there, *labels), *named(back, *labels)])
    assert candidates(found)
    for candidate in candidates(found):
        if stages == "geometric":
            assert candidate.similarity == 0
        else:
            assert candidate.evidence in ("", "landmarks")
    assert closures(found)
