"""What the mapper makes of boxes and of names: objects, questions, and labels that come late."""

import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest

from ldo_service.actors.mapper import Mapper, MapperConfig
from ldo_service.conversions.frames import camera_to_message
from ldo_service.conversions.poses import correction_to_message, matrix6_to_message, pose_to_message
from ldo_service.geometry import se3
from ldo_service.maps.replica import MapReplica
from ldo_service.regions.open_vocabulary import OpenVocabularyConfig, OpenVocabularyLabeling
from ldo_service.regions.region_proposals import RegionProposalConfig
from ldo_service.regions.region_tracker import RegionTrackerConfig
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
    MapSnapshot,
    Message,
    ObjectObservation,
    RefineMap,
    encode,
)
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.semantics.semantic_fusion import FusionConfig, SemanticFusionConfig
from ldo_service.semantics.semantic_map import SemanticMapConfig
from ldo_service.storage.state_codec import decode_state, encode_state
from tests.semantics.scenes import (
    CAMERA,
    SCENE_OBJECTS,
    SceneObject,
    Shot,
    poses,
    shoot,
    true_objects,
)

# of an image of 128x96, where walls hold a fifth each and the ball is 20 px wide
TRIGGER = RegionProposalConfig(min_side_px=10)
REGIONS = RegionTrackerConfig(per_keyframe=4, at_once=8)  # the walk is short
SEMANTICS = SemanticMapConfig(naming=OpenVocabularyConfig(trigger=TRIGGER, regions=REGIONS))
CONFIG = MapperConfig(iterations=3, threads=1, semantics=SEMANTICS)
COUCH, TABLE, VASE, _, CHAIR, BALL = SCENE_OBJECTS
AHEAD = poses(1)[0]
WAY = poses(12)
STAMP_NS = 10**8


def keyframe_of(shot: Shot, number: int) -> Keyframe:
    """Placed exactly; each measured from the one before."""
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
    """Of those of the room's things; the detector knows no others."""
    known = [thing.name for thing in things]
    detections = shot.detections(SCENE_OBJECTS)
    names = [
        thing.name for k, thing in enumerate(SCENE_OBJECTS, 1) if np.sum(shot.instances == k) >= 40
    ]
    found = zip(names, detections.boxes.tolist(), strict=True)
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
    """All that the mapper makes of a walk past all things."""
    made: list[Message] = []
    for number, T in enumerate(way, first):
        shot = shoot(SCENE_OBJECTS, T, number)
        made += mapper.handle(keyframe_of(shot, number))
        made += mapper.handle(boxes_of(shot, number, known, **fields))
    return made


def of(kind: type, messages: Iterable[Message]) -> list:
    return [message for message in messages if isinstance(message, kind)]


def followed(messages: Iterable[Message]) -> MapReplica:
    follower = MapReplica()
    for message in messages:
        if isinstance(message, MapDelta | MapSnapshot):
            follower.apply(message)
    return follower


# --- objects --------------------------------------------------------------------------------------
def test_objects_are_told_with_each_keyframe_that_was_looked_at() -> None:
    made = walk(Mapper(CONFIG), np.tile(AHEAD, (5, 1, 1)), known=(BALL,))
    told = of(MapObjects, made)
    assert [len(message.objects) for message in told] == [0, 0, 1, 1, 1]
    (ball,) = told[-1].objects
    assert ball.name == "sports ball"
    center = np.array(ball.T_map_object.translation)
    assert np.linalg.norm(center - BALL.solid.center_m) < 0.15
    assert (ball.observation_count, ball.first_keyframe, ball.last_keyframe) == (5, 0, 4)
    seen = of(ObjectObservation, made)
    assert [(one.keyframe, one.object, one.is_miss) for one in seen] == [
        (3, 0, False),
        (4, 0, False),
    ]
    assert seen[0].stamp_ns == 3 * STAMP_NS


def test_an_object_that_is_not_found_again_is_told_as_missed() -> None:
    mapper = Mapper(CONFIG)
    walk(mapper, np.tile(AHEAD, (4, 1, 1)), known=(COUCH,))
    made = walk(mapper, AHEAD[None], first=4, known=())
    (missed,) = of(ObjectObservation, made)
    assert (missed.object, missed.keyframe, missed.is_miss) == (0, 4, True)


def test_where_nobody_looked_nothing_is_said_of_objects_and_no_bit_differs() -> None:
    plain, mapper = Mapper(CONFIG), Mapper(CONFIG)
    alone: list[Message] = []
    for number, T in enumerate(WAY[:4]):
        alone += plain.handle(keyframe_of(shoot(SCENE_OBJECTS, T, number), number))
    made = walk(mapper, WAY[:4], known=(), network="")
    ask = RefineMap(stamp_ns=0, iterations=2, initial_rate=1.0, final_rate=1.0)
    turned = correction_to_message(0, 1, {0: se3.exp(np.full(6, 0.1)) @ WAY[0]})
    for one, said in ((plain, alone), (mapper, made)):
        for message in (ask, turned):
            said += one.handle(message)
        said += one.on_stop()
    assert of(MapObjects, made) == of(ObjectObservation, made) == of(LabelRequest, made) == []
    assert [encode(message) for message in made] == [encode(message) for message in alone]


def test_corrections_move_objects_with_the_map() -> None:
    mapper = Mapper(CONFIG)
    (*_, before) = of(MapObjects, walk(mapper, np.tile(AHEAD, (4, 1, 1))))
    T = se3.exp(np.array([0, 0, 0.3, 1.0, 0.5, -0.2]))
    made = list(mapper.handle(correction_to_message(0, 7, dict.fromkeys(range(4), T @ AHEAD))))
    (after,) = of(MapObjects, made)
    (delta,) = of(MapDelta, made)
    assert (after.graph_version, after.version) == (7, delta.version)
    assert [one.id for one in after.objects] == [one.id for one in before.objects]
    for one, moved in zip(before.objects, after.objects, strict=True):
        expected = se3.transform(T, np.array(one.centroid))
        np.testing.assert_allclose(moved.centroid, expected, atol=0.03)


def test_the_last_word_on_objects_is_that_of_the_last_map() -> None:
    mapper = Mapper(CONFIG)
    walk(mapper, WAY[:6])
    refined = list(mapper.handle(RefineMap(stamp_ns=0, iterations=5, initial_rate=1, final_rate=1)))
    assert isinstance(refined[-1], MapObjects)
    *_, last = mapper.on_stop()
    assert isinstance(last, MapObjects)
    assert last.version == followed(mapper.on_stop()).version
    assert last.objects == refined[-1].objects


def test_a_successor_goes_on_with_objects_bit_for_bit(tmp_path: Path) -> None:
    """Also with what was asked, what was answered, and what waits."""
    config = replace(CONFIG, folder=str(tmp_path / "first"))
    first = Mapper(config, has_labeller=True)
    made = walk(first, WAY[:5], known=(BALL,))
    *_, question = of(LabelRequest, made)
    list(first.handle(answer(of(LabelRequest, made)[0], "samovar")))
    list(first.handle(boxes_of(shoot(SCENE_OBJECTS, WAY[6], 6), 6, (BALL,))))
    state = decode_state(encode_state(first.checkpoint()))
    shutil.copytree(tmp_path / "first", tmp_path / "second")
    second = Mapper(replace(config, folder=str(tmp_path / "second")), has_labeller=True)
    second.restore(state)
    ends = []
    for mapper in (first, second):
        made = [*mapper.handle(answer(question, "lava lamp")), *walk(mapper, WAY[5:12], first=5)]
        ends.append([*made, *mapper.on_stop()])
    for kind in (MapObjects, ObjectObservation, LabelRequest):
        one, other = ([encode(unversioned(m)) for m in of(kind, end)] for end in ends)
        assert one == other
        assert one
    maps = [followed(end) for end in ends]
    assert maps[0].map.labels.tobytes() == maps[1].map.labels.tobytes()
    assert maps[0].label_names == maps[1].label_names


def unversioned(message: Message) -> Message:
    """A successor's versions of the map are far ahead."""
    return msgspec.structs.replace(message, version=0) if hasattr(message, "version") else message


# --- names ----------------------------------------------------------------------------------------
def answer(request: LabelRequest, label: str, confidence: float = 0.9) -> LabelResult:
    return LabelResult(
        stamp_ns=request.stamp_ns,
        region=request.region,
        keyframe=request.keyframe,
        label=label,
        confidence=confidence if label else 0.0,
        labeller="test",
    )


def shown_in(request: LabelRequest) -> SceneObject | None:
    """The thing whose true box a question's is most like."""
    shot = shoot(SCENE_OBJECTS, WAY[request.keyframe % len(WAY)], request.keyframe)
    best, most = None, 0.5
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
        if iou > most:
            best, most = thing, iou
    return best


def test_without_a_labeller_nobody_is_asked() -> None:
    assert of(LabelRequest, walk(Mapper(CONFIG), WAY[:5], score=0.3)) == []


def test_what_the_detector_does_not_know_is_asked_about_and_what_it_is_sure_of_is_not() -> None:
    made = walk(Mapper(CONFIG, has_labeller=True), known=(COUCH,))
    asked = {shown_in(request) for request in of(LabelRequest, made)}
    assert BALL in asked
    assert COUCH not in asked


@pytest.mark.parametrize("late", [0, 4])
def test_answers_land_on_the_gaussians_they_speak_of_however_late(late: int) -> None:
    """Of each region that is truly a thing its own name, of others none; twice around."""
    mapper, waiting, made = Mapper(CONFIG, has_labeller=True), [], []
    for number, T in enumerate(np.tile(WAY, (2, 1, 1))):
        new = walk(mapper, T[None], first=number, known=(COUCH,))
        named = [(request, shown_in(request)) for request in of(LabelRequest, new)]
        waiting += [(number + late, answer(r, f"my {one.name}" if one else "")) for r, one in named]
        for due, message in waiting:
            new += mapper.handle(message) if due == number else []
        made += new
    made += mapper.on_stop()
    follower = followed(made)
    top = top_labels(follower.map.labels)
    truth = true_objects(follower.map.means, SCENE_OBJECTS, WAY)
    names = np.array([f"my {thing.name}" for thing in SCENE_OBJECTS] + ["background"])
    said = np.array(follower.label_names)[top]
    mine = np.char.startswith(said, "my ")
    is_wrong = mine & (said != names[truth])
    assert np.count_nonzero(is_wrong & (truth >= 0)) < 0.05 * np.count_nonzero(mine), "another's"
    # splats of 128x96 pixels reach over edges: of what an exact box makes couch, 0.16 is none
    assert np.count_nonzero(is_wrong) < 0.33 * np.count_nonzero(mine)
    chairs = truth == SCENE_OBJECTS.index(CHAIR)
    assert np.mean(said[chairs] == "my chair") > 0.6
    *_, last = of(MapObjects, made)
    for thing in (CHAIR, TABLE):  # the vase is some 10 px wide, and not set apart from its table
        center_m = np.array(thing.solid.center_m)
        named = [one for one in last.objects if one.name == f"my {thing.name}"]
        assert len(named) <= sum(other.name == thing.name for other in SCENE_OBJECTS), "one of each"
        assert min(np.linalg.norm(np.array(one.centroid) - center_m) for one in named) < 0.3


def test_an_answer_speaks_of_all_views_that_were_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """But for what the detector knows: it has spoken of that where it saw it."""

    def labelled(name: str) -> int:
        mapper = Mapper(CONFIG, has_labeller=True)
        made = walk(mapper, known=(COUCH,))
        for request in of(LabelRequest, made):
            if shown_in(request) == CHAIR:
                made += mapper.handle(answer(request, name))
        follower = followed([*made, *mapper.on_stop()])
        said = np.array(follower.label_names)[top_labels(follower.map.labels)]
        return int(np.count_nonzero(said == name))

    beyond, of_the_detector = labelled("my chair"), labelled(COUCH.name)
    monkeypatch.setattr(OpenVocabularyLabeling, "shown_in", lambda *_: ())
    assert beyond > 1.05 * labelled("my chair") > 0
    assert of_the_detector == labelled(COUCH.name) > 0


@pytest.mark.parametrize(
    ("rule", "boxes_vote", "sure", "named"),
    [
        ("adaptive", False, 0.7, "samovar"),  # 0.7 beside at most 0.5: alpha 0.34
        ("adaptive", False, 0.35, "couch"),  # 0.35 beside 0.5, where a splat lies inside: 0.67
        ("fixed", False, 0.55, "samovar"),  # half of 0.55 beside half of 0.5
        ("detector", True, 0.95, "couch"),
        ("detector", False, 0.95, "couch"),
    ],
)
def test_a_box_and_an_answer_are_weighed_as_printed_or_the_box_alone_counts(
    rule: Literal["adaptive", "fixed", "detector"], boxes_vote: bool, sure: float, named: str
) -> None:
    regions = replace(REGIONS, boxes_vote=boxes_vote, least_votes=0)
    labelling = SemanticFusionConfig(fusion=FusionConfig(rule=rule))
    naming = OpenVocabularyConfig(trigger=TRIGGER, regions=regions)
    semantics = SemanticMapConfig(labelling=labelling, naming=naming)
    mapper, made = Mapper(replace(CONFIG, semantics=semantics), has_labeller=True), []
    for number, T in enumerate(np.tile(WAY, (2, 1, 1))):
        new = walk(mapper, T[None], first=number, known=(COUCH,), score=0.5)
        about_it = [one for one in of(LabelRequest, new) if shown_in(one) == COUCH]
        made += [
            *new,
            *(m for one in about_it for m in mapper.handle(answer(one, "samovar", sure))),
        ]
    assert mapper.metrics()["answers_named"] > 0
    follower = followed([*made, *mapper.on_stop()])
    top = top_labels(follower.map.labels)
    truth = true_objects(follower.map.means, SCENE_OBJECTS, WAY)
    said = np.array(follower.label_names)[top]
    assert np.mean(said[truth == SCENE_OBJECTS.index(COUCH)] == named) > 0.6


def test_names_beyond_the_cap_are_other_and_no_opinion_is_no_label() -> None:
    semantics = replace(CONFIG.semantics, most_names=83)
    mapper = Mapper(replace(CONFIG, semantics=semantics), has_labeller=True)
    made = walk(mapper, known=())
    first, second, third, *_ = of(LabelRequest, made)
    for request, label in ((first, "samovar"), (second, "lava lamp"), (third, "")):
        made += mapper.handle(answer(request, label))
    made += mapper.handle(answer(first, "again"))
    made += mapper.on_stop()
    follower = followed(made)
    assert follower.label_names[-1] == "samovar"
    assert set(top_labels(follower.map.labels).tolist()) == {0, 1, 82}
    facts = mapper.metrics()
    assert (facts["answers_named"], facts["answers_unnamed"], facts["answers_unknown"]) == (2, 1, 1)
    assert facts["label_names_rejected"] >= 1


def test_walls_and_floors_are_background_whoever_names_them() -> None:
    mapper = Mapper(CONFIG, has_labeller=True)
    made = walk(mapper, WAY[:4], known=())
    for request in of(LabelRequest, made):
        made += mapper.handle(answer(request, "Ceiling"))
    made += mapper.on_stop()
    assert not top_labels(followed(made).map.labels).any()
    assert mapper.metrics()["answers_unnamed"] > 0


def test_an_answer_about_a_forgotten_keyframe_labels_nothing() -> None:
    mapper = Mapper(CONFIG, has_labeller=True)
    made = walk(mapper, WAY[:4], known=())
    request = of(LabelRequest, made)[0]
    mapper._map.views.store.keep_only([])
    assert list(mapper.handle(answer(request, "samovar"))) == []
    assert mapper.metrics()["answers_without_images"] == 1
    assert not top_labels(followed([*made, *mapper.on_stop()]).map.labels).any()


def test_what_only_the_labeller_knows_the_detector_cannot_miss_however_it_came_to_be_known() -> (
    None
):
    """Here where the answer's own keyframe is forgotten, and later ones show its region again."""
    mapper = Mapper(CONFIG, has_labeller=True)
    made = walk(mapper, np.tile(AHEAD, (5, 1, 1)), known=())
    for request in of(LabelRequest, made):
        mapper._map.views.store.keep_only([])
        assert list(mapper.handle(answer(request, "samovar"))) == []
    made += walk(mapper, AHEAD[None], first=5, known=(COUCH,))
    names = followed(made).label_names
    assert "samovar" in names
    spared = mapper._semantics._undetectable_labels()
    assert spared is not None
    assert np.flatnonzero(spared).tolist() == [names.index("samovar")]


def test_the_map_looks_the_same_whoever_names_it() -> None:
    plain, asking = Mapper(CONFIG), Mapper(CONFIG, has_labeller=True)
    alone, made = walk(plain, WAY[:6], known=(BALL,)), walk(asking, WAY[:6], known=(BALL,))
    for request in of(LabelRequest, made):
        made += asking.handle(answer(request, "samovar"))
    views = [
        [encode(unversioned(view)) for view in of(MapRendering, said)] for said in (alone, made)
    ]
    assert views[0] == views[1]
    rows = [
        followed([*said, *m.on_stop()]).map.rows for said, m in ((alone, plain), (made, asking))
    ]
    assert rows[0].tobytes() == rows[1].tobytes()
