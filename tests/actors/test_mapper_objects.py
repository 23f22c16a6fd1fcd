"""Objects, label requests and late label results of the mapper."""

import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest

from ldo_service.actors.mapper import Mapper
from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.conversions.frames import camera_to_message
from ldo_service.conversions.poses import correction_to_message, matrix6_to_message, pose_to_message
from ldo_service.geometry import se3
from ldo_service.regions.open_vocabulary import OpenVocabularyConfig, OpenVocabularyLabeling
from ldo_service.regions.region_proposals import RegionProposalConfig
from ldo_service.regions.region_tracker_config import RegionTrackerConfig
from ldo_service.runtime.actor import FlowStatus
from ldo_service.schemas import (
    Array,
    Detection,
    DetectionBoxes,
    Keyframe,
    LabelRequest,
    LabelResult,
    MapDelta,
    MapObjects,
    MapRendering,
    Message,
    ObjectObservation,
    RefineMap,
    encode,
)
from ldo_service.schemas.topics import LABEL_REQUEST
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.semantics.semantic_fusion import FusionConfig, SemanticFusionConfig
from ldo_service.semantics.semantic_map import SemanticMapConfig
from ldo_service.storage.state_codec import decode_state, encode_state
from tests.actors.conftest import replicate
from tests.semantics.scenes import (
    CAMERA,
    SCENE_OBJECTS,
    SceneObject,
    Shot,
    poses,
    shoot,
    true_objects,
)

# Images have 128x96 pixels; a wall covers a fifth of them, and the ball is 20 pixels wide.
TRIGGER = RegionProposalConfig(min_side_px=10)
REGIONS = RegionTrackerConfig(per_keyframe=4, at_once=8)  # The walk is short.
SEMANTICS = SemanticMapConfig(naming=OpenVocabularyConfig(trigger=TRIGGER, regions=REGIONS))
CONFIG = MapperConfig(iterations=3, threads=1, semantics=SEMANTICS)
COUCH, TABLE, VASE, _, CHAIR, BALL = SCENE_OBJECTS
AHEAD = poses(1)[0]
WAY = poses(12)
STAMP_NS = 10**8


def keyframe_of(shot: Shot, number: int) -> Keyframe:
    """Return a keyframe at its exact pose, without a reference."""
    T = pose_to_message(shot.T_map_camera)
    return Keyframe(
        stamp_ns=number * STAMP_NS,
        keyframe=number,
        frame=number,
        camera=camera_to_message(CAMERA),
        color=Array.of(shot.frame.color),
        depth_m=Array.of(shot.frame.depth_m),
        reference=None,
        T_reference_keyframe=T,
        information=matrix6_to_message(np.eye(6)),
        T_odom_keyframe=T,
    )


def boxes_of(
    shot: Shot,
    number: int,
    things: Iterable[SceneObject],
    score: float = 0.9,
    network: str = "exact",
) -> DetectionBoxes:
    """Return exact boxes of the given objects, the only ones that the detector knows."""
    known = [thing.name for thing in things]
    true_boxes = shot.detections(SCENE_OBJECTS)
    names = [
        thing.name for k, thing in enumerate(SCENE_OBJECTS, 1) if np.sum(shot.instances == k) >= 40
    ]
    found = zip(names, true_boxes.boxes.tolist(), strict=True)
    return DetectionBoxes(
        stamp_ns=number * STAMP_NS,
        keyframe=number,
        width=CAMERA.width,
        height=CAMERA.height,
        detections=tuple(
            Detection(label=name, score=score, box_px=tuple(box))
            for name, box in found
            if name in known
        ),
        network=network,
    )


def walk(
    mapper: Mapper,
    way: np.ndarray = WAY,
    first: int = 0,
    known: Iterable[SceneObject] = SCENE_OBJECTS,
    **fields,
) -> list[Message]:
    """Return the messages of a mapper on a walk past all objects of the scene."""
    messages: list[Message] = []
    for number, T in enumerate(way, first):
        shot = shoot(SCENE_OBJECTS, T, number)
        messages += mapper.handle(keyframe_of(shot, number))
        messages += mapper.handle(boxes_of(shot, number, known, **fields))
    return messages


def of_kind(kind: type, messages: Iterable[Message]) -> list:
    return [message for message in messages if isinstance(message, kind)]


# --- objects --------------------------------------------------------------------------------------
def test_objects_are_published_with_each_keyframe_with_detections() -> None:
    messages = walk(Mapper(CONFIG), np.tile(AHEAD, (5, 1, 1)), known=(BALL,))
    published = of_kind(MapObjects, messages)
    assert [len(message.objects) for message in published] == [0, 0, 1, 1, 1]
    (ball,) = published[-1].objects
    assert ball.name == "sports ball"
    center = np.array(ball.T_map_object.translation)
    assert np.linalg.norm(center - BALL.solid.center_m) < 0.15
    assert (ball.observation_count, ball.first_keyframe, ball.last_keyframe) == (5, 0, 4)
    seen = of_kind(ObjectObservation, messages)
    assert [(one.keyframe, one.object, one.is_miss) for one in seen] == [
        (3, 0, False),
        (4, 0, False),
    ]
    assert seen[0].stamp_ns == 3 * STAMP_NS


def test_undetected_object_is_published_as_a_miss() -> None:
    mapper = Mapper(CONFIG)
    walk(mapper, np.tile(AHEAD, (4, 1, 1)), known=(COUCH,))
    messages = walk(mapper, AHEAD[None], first=4, known=())
    (missed,) = of_kind(ObjectObservation, messages)
    assert (missed.object, missed.keyframe, missed.is_miss) == (0, 4, True)


def test_detections_without_network_leave_outputs_bitwise_equal() -> None:
    plain, mapper = Mapper(CONFIG), Mapper(CONFIG)
    without_boxes: list[Message] = []
    for number, T in enumerate(WAY[:4]):
        without_boxes += plain.handle(keyframe_of(shoot(SCENE_OBJECTS, T, number), number))
    messages = walk(mapper, WAY[:4], known=(), network="")
    ask = RefineMap(stamp_ns=0, iterations=2, initial_rate=1.0, final_rate=1.0)
    turned = correction_to_message(0, 1, {0: se3.exp(np.full(6, 0.1)) @ WAY[0]})
    for one, outputs in ((plain, without_boxes), (mapper, messages)):
        for message in (ask, turned):
            outputs += one.handle(message)
        outputs += one.on_stop()
    assert (
        of_kind(MapObjects, messages)
        == of_kind(ObjectObservation, messages)
        == of_kind(LabelRequest, messages)
        == []
    )
    assert [encode(message) for message in messages] == [
        encode(message) for message in without_boxes
    ]


def test_corrections_move_objects_with_the_map() -> None:
    mapper = Mapper(CONFIG)
    (*_, before) = of_kind(MapObjects, walk(mapper, np.tile(AHEAD, (4, 1, 1))))
    T = se3.exp(np.array([0, 0, 0.3, 1.0, 0.5, -0.2]))
    messages = list(mapper.handle(correction_to_message(0, 7, dict.fromkeys(range(4), T @ AHEAD))))
    (after,) = of_kind(MapObjects, messages)
    (delta,) = of_kind(MapDelta, messages)
    assert (after.graph_version, after.version) == (7, delta.version)
    assert [one.id for one in after.objects] == [one.id for one in before.objects]
    for one, moved in zip(before.objects, after.objects, strict=True):
        expected = se3.transform(T, np.array(one.centroid))
        np.testing.assert_allclose(moved.centroid, expected, atol=0.03)


def test_final_objects_have_the_version_of_the_final_map() -> None:
    mapper = Mapper(CONFIG)
    walk(mapper, WAY[:6])
    refined = list(mapper.handle(RefineMap(stamp_ns=0, iterations=5, initial_rate=1, final_rate=1)))
    assert isinstance(refined[-1], MapObjects)
    *_, last = mapper.on_stop()
    assert isinstance(last, MapObjects)
    assert last.version == replicate(mapper.on_stop()).version
    assert last.objects == refined[-1].objects


def test_waiting_label_requests_are_sent_when_the_labeller_has_room() -> None:
    """The camera may stand still by then, so no other message arrives."""
    mapper = Mapper(CONFIG, has_labeller=True)
    mapper.situation = FlowStatus(credits={LABEL_REQUEST: 0})
    assert of_kind(LabelRequest, walk(mapper, WAY[:5], known=(BALL,))) == []
    waiting = mapper.metrics()["label_requests_waiting"]
    assert waiting >= 2
    assert not mapper.has_idle_work()
    mapper.situation = FlowStatus(credits={LABEL_REQUEST: 1})
    assert mapper.has_idle_work()
    assert len(of_kind(LabelRequest, list(mapper.on_idle()))) == 1
    assert mapper.metrics()["label_requests_waiting"] == waiting - 1


def test_restored_mapper_continues_objects_bitwise_equal(tmp_path: Path) -> None:
    """The state includes open and answered label requests, and boxes before their keyframe."""
    config = replace(CONFIG, folder=str(tmp_path / "first"))
    first = Mapper(config, has_labeller=True)
    messages = walk(first, WAY[:5], known=(BALL,))
    *_, open_request = of_kind(LabelRequest, messages)
    list(first.handle(label_result(of_kind(LabelRequest, messages)[0], "samovar")))
    list(first.handle(boxes_of(shoot(SCENE_OBJECTS, WAY[6], 6), 6, (BALL,))))
    state = decode_state(encode_state(first.checkpoint()))
    shutil.copytree(tmp_path / "first", tmp_path / "second")
    second = Mapper(replace(config, folder=str(tmp_path / "second")), has_labeller=True)
    second.restore(state)
    ends = []
    for mapper in (first, second):
        messages = [
            *mapper.handle(label_result(open_request, "lava lamp")),
            *walk(mapper, WAY[5:12], first=5),
        ]
        ends.append([*messages, *mapper.on_stop()])
    for kind in (MapObjects, ObjectObservation, LabelRequest):
        one, other = ([encode(unversioned(m)) for m in of_kind(kind, end)] for end in ends)
        assert one == other
        assert one
    maps = [replicate(end) for end in ends]
    assert maps[0].map.labels.tobytes() == maps[1].map.labels.tobytes()
    assert maps[0].label_names == maps[1].label_names


def unversioned(message: Message) -> Message:
    """Return a message without map version, which a restored mapper sets far ahead."""
    return msgspec.structs.replace(message, version=0) if hasattr(message, "version") else message


# --- label results --------------------------------------------------------------------------------
def label_result(request: LabelRequest, label: str, confidence: float = 0.9) -> LabelResult:
    return LabelResult(
        stamp_ns=request.stamp_ns,
        region=request.region,
        keyframe=request.keyframe,
        label=label,
        confidence=confidence if label else 0.0,
        labeller="test",
    )


def thing_in_box(request: LabelRequest) -> SceneObject | None:
    """Return the object whose true box overlaps most with the box of the request."""
    shot = shoot(SCENE_OBJECTS, WAY[request.keyframe % len(WAY)], request.keyframe)
    best_thing, best_iou = None, 0.5
    for number, thing in enumerate(SCENE_OBJECTS, 1):
        v, u = np.nonzero(shot.instances == number)
        if len(u) == 0:
            continue
        x0, y0, x1, y1 = request.box_px
        low = np.maximum([u.min() - 0.5, v.min() - 0.5], [x0, y0])
        high = np.minimum([u.max() + 0.5, v.max() + 0.5], [x1, y1])
        both = float(np.prod(np.clip(high - low, 0, None)))
        area = (np.ptp(u) + 1) * (np.ptp(v) + 1)
        iou = both / (area + (x1 - x0) * (y1 - y0) - both)
        if iou > best_iou:
            best_thing, best_iou = thing, iou
    return best_thing


def test_without_labeller_no_label_request_is_sent() -> None:
    assert of_kind(LabelRequest, walk(Mapper(CONFIG), WAY[:5], score=0.3)) == []


def test_only_regions_without_confident_detection_are_requested() -> None:
    messages = walk(Mapper(CONFIG, has_labeller=True), known=(COUCH,))
    requested = {thing_in_box(request) for request in of_kind(LabelRequest, messages)}
    assert BALL in requested
    assert COUCH not in requested


@pytest.mark.parametrize("late", [0, 4])
def test_late_label_results_reach_the_gaussians_of_their_region(late: int) -> None:
    """Regions of an object get its own label, others none, on two rounds."""
    mapper, waiting, messages = Mapper(CONFIG, has_labeller=True), [], []
    for number, T in enumerate(np.tile(WAY, (2, 1, 1))):
        new = walk(mapper, T[None], first=number, known=(COUCH,))
        shown = [(request, thing_in_box(request)) for request in of_kind(LabelRequest, new)]
        waiting += [
            (number + late, label_result(r, f"my {one.name}" if one else "")) for r, one in shown
        ]
        for due_keyframe, message in waiting:
            new += mapper.handle(message) if due_keyframe == number else []
        messages += new
    messages += mapper.on_stop()
    replica = replicate(messages)
    top, truth = top_labels(replica.map.labels), true_objects(replica.map.means, SCENE_OBJECTS, WAY)
    names = np.array([f"my {thing.name}" for thing in SCENE_OBJECTS] + ["background"])
    assigned = np.array(replica.label_names)[top]
    is_labelled = np.char.startswith(assigned, "my ")
    is_wrong = is_labelled & (assigned != names[truth])
    of_other_object = np.count_nonzero(is_wrong & (truth >= 0))
    assert of_other_object < 0.05 * np.count_nonzero(is_labelled)
    # Splats of 128x96 pixels reach over edges: in an exact box, 0.16 of the couch is background.
    assert np.count_nonzero(is_wrong) < 0.33 * np.count_nonzero(is_labelled)
    chairs = truth == SCENE_OBJECTS.index(CHAIR)
    assert np.mean(assigned[chairs] == "my chair") > 0.6
    *_, last = of_kind(MapObjects, messages)
    for thing in (CHAIR, TABLE):  # The vase is 10 px wide and not separable.
        center_m = np.array(thing.solid.center_m)
        found = [one for one in last.objects if one.name == f"my {thing.name}"]
        assert len(found) <= sum(other.name == thing.name for other in SCENE_OBJECTS), "one of each"
        assert min(np.linalg.norm(np.array(one.centroid) - center_m) for one in found) < 0.3


def names_after_walk(*, is_slow: bool) -> list[str]:
    """Return the names of all objects; a slow labeller answers after the walk."""
    mapper, waiting = Mapper(CONFIG, has_labeller=True), []
    for number, T in enumerate(np.tile(WAY, (2, 1, 1))):
        new = walk(mapper, T[None], first=number, known=(COUCH,))
        things = [(request, thing_in_box(request)) for request in of_kind(LabelRequest, new)]
        waiting += [label_result(r, f"my {one.name}") for r, one in things if one]
        if not is_slow:
            for result in waiting:
                list(mapper.handle(result))
            waiting = []
    for result in waiting:
        list(mapper.handle(result))
    *_, last = mapper.on_stop()
    return sorted(one.name for one in last.objects)


def test_objects_get_their_names_also_when_all_labels_arrive_after_the_walk() -> None:
    """The ball is 20 pixels wide, and most views show too few of its Gaussians to observe it."""
    prompt, late = names_after_walk(is_slow=False), names_after_walk(is_slow=True)
    assert late == [name for name in prompt if name != f"my {BALL.name}"]
    assert late == ["couch", "my chair", "my chair", "my dining table"]


def test_label_result_applies_to_all_views_of_its_request(monkeypatch: pytest.MonkeyPatch) -> None:
    """A label that the detector gives too applies to one view: the detector labels the others."""

    def labelled(name: str) -> int:
        mapper = Mapper(CONFIG, has_labeller=True)
        messages = walk(mapper, known=(COUCH,))
        for request in of_kind(LabelRequest, messages):
            if thing_in_box(request) == CHAIR:
                messages += mapper.handle(label_result(request, name))
        replica = replicate([*messages, *mapper.on_stop()])
        assigned = np.array(replica.label_names)[top_labels(replica.map.labels)]
        return int(np.count_nonzero(assigned == name))

    new_label, detector_label = labelled("my chair"), labelled(COUCH.name)
    monkeypatch.setattr(OpenVocabularyLabeling, "shown_in", lambda *_: ())
    assert new_label > 1.05 * labelled("my chair") > 0
    assert detector_label == labelled(COUCH.name) > 0


@pytest.mark.parametrize(
    ("rule", "boxes_vote", "confidence", "expected_label"),
    [
        ("adaptive", False, 0.7, "samovar"),  # 0.7 against at most 0.5: alpha 0.34.
        ("adaptive", False, 0.35, "couch"),  # 0.35 against 0.5 for splats inside: 0.67.
        ("fixed", False, 0.55, "samovar"),  # Half of 0.55 against half of 0.5.
        ("detector", True, 0.95, "couch"),
        ("detector", False, 0.95, "couch"),
    ],
)
def test_fusion_rule_decides_between_detection_and_label_result(
    rule: Literal["adaptive", "fixed", "detector"],
    boxes_vote: bool,
    confidence: float,
    expected_label: str,
) -> None:
    regions = replace(REGIONS, boxes_vote=boxes_vote, min_votes=0)
    labelling = SemanticFusionConfig(fusion=FusionConfig(rule=rule))
    naming = OpenVocabularyConfig(trigger=TRIGGER, regions=regions)
    semantics = SemanticMapConfig(labelling=labelling, naming=naming)
    mapper, messages = Mapper(replace(CONFIG, semantics=semantics), has_labeller=True), []
    for number, T in enumerate(np.tile(WAY, (2, 1, 1))):
        new = walk(mapper, T[None], first=number, known=(COUCH,), score=0.5)
        about_it = [one for one in of_kind(LabelRequest, new) if thing_in_box(one) == COUCH]
        messages += [
            *new,
            *(
                m
                for one in about_it
                for m in mapper.handle(label_result(one, "samovar", confidence))
            ),
        ]
    assert mapper.metrics()["answers_named"] > 0
    replica = replicate([*messages, *mapper.on_stop()])
    top, truth = top_labels(replica.map.labels), true_objects(replica.map.means, SCENE_OBJECTS, WAY)
    assigned = np.array(replica.label_names)[top]
    assert np.mean(assigned[truth == SCENE_OBJECTS.index(COUCH)] == expected_label) > 0.6


def test_label_beyond_the_maximum_is_other_and_empty_result_labels_nothing() -> None:
    semantics = replace(CONFIG.semantics, max_names=83)
    mapper = Mapper(replace(CONFIG, semantics=semantics), has_labeller=True)
    messages = walk(mapper, known=())
    first, second, third, *_ = of_kind(LabelRequest, messages)
    for request, label in ((first, "samovar"), (second, "lava lamp"), (third, "")):
        messages += mapper.handle(label_result(request, label))
    messages += mapper.handle(label_result(first, "again"))
    messages += mapper.on_stop()
    replica = replicate(messages)
    assert replica.label_names[-1] == "samovar"
    assert set(top_labels(replica.map.labels).tolist()) == {0, 1, 82}
    facts = mapper.metrics()
    assert (facts["answers_named"], facts["answers_unnamed"], facts["answers_unknown"]) == (2, 1, 1)
    assert facts["label_names_rejected"] >= 1


def test_structural_labels_count_as_background() -> None:
    mapper = Mapper(CONFIG, has_labeller=True)
    messages = walk(mapper, WAY[:4], known=())
    for request in of_kind(LabelRequest, messages):
        messages += mapper.handle(label_result(request, "Ceiling"))
    messages += mapper.on_stop()
    assert not top_labels(replicate(messages).map.labels).any()
    assert mapper.metrics()["answers_unnamed"] > 0


def test_label_result_for_a_forgotten_keyframe_labels_nothing() -> None:
    mapper = Mapper(CONFIG, has_labeller=True)
    messages = walk(mapper, WAY[:4], known=())
    request = of_kind(LabelRequest, messages)[0]
    mapper._map.views.store.keep_only([])
    assert list(mapper.handle(label_result(request, "samovar"))) == []
    assert mapper.metrics()["answers_without_images"] == 1
    assert not top_labels(replicate([*messages, *mapper.on_stop()]).map.labels).any()


def test_label_unknown_to_the_detector_is_undetectable_after_a_late_result() -> None:
    """The keyframe of the request is forgotten, and later ones observe its region again."""
    mapper = Mapper(CONFIG, has_labeller=True)
    messages = walk(mapper, np.tile(AHEAD, (5, 1, 1)), known=())
    for request in of_kind(LabelRequest, messages):
        mapper._map.views.store.keep_only([])
        assert list(mapper.handle(label_result(request, "samovar"))) == []
    messages += walk(mapper, AHEAD[None], first=5, known=(COUCH,))
    names = replicate(messages).label_names
    assert "samovar" in names
    undetectable = mapper._semantics._sources.undetectable()
    assert undetectable is not None
    assert np.flatnonzero(undetectable).tolist() == [names.index("samovar")]


def test_label_results_do_not_change_renderings_or_gaussians() -> None:
    plain, with_labeller = Mapper(CONFIG), Mapper(CONFIG, has_labeller=True)
    without_labels, messages = (
        walk(plain, WAY[:6], known=(BALL,)),
        walk(with_labeller, WAY[:6], known=(BALL,)),
    )
    for request in of_kind(LabelRequest, messages):
        messages += with_labeller.handle(label_result(request, "samovar"))
    views = [
        [encode(unversioned(view)) for view in of_kind(MapRendering, end)]
        for end in (without_labels, messages)
    ]
    assert views[0] == views[1]
    rows = [
        replicate([*end, *m.on_stop()]).map.rows
        for end, m in ((without_labels, plain), (messages, with_labeller))
    ]
    assert rows[0].tobytes() == rows[1].tobytes()
