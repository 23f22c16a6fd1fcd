"""Labels and objects of the mapper when label results or detections arrive late."""

import shutil
from collections import deque
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.actors.mapper import STILL_AFTER_S, Mapper
from ldo_service.runtime.actor import FlowStatus
from ldo_service.schemas import LabelRequest, MapObject, MapObjects, Message
from ldo_service.schemas.topics import LABEL_REQUEST
from ldo_service.semantics import ordered_semantics
from ldo_service.storage.state_codec import decode_state, encode_state
from tests.actors.conftest import replicate
from tests.actors.test_mapper_objects import (
    BALL,
    CONFIG,
    COUCH,
    WAY,
    boxes_of,
    keyframe_of,
    label_result,
    of_kind,
    thing_in_box,
)
from tests.semantics.scenes import SCENE_OBJECTS, shoot

ROUNDS = np.tile(WAY, (2, 1, 1))


class Walk:
    """Mapper on a walk past all objects of the scene, with delayed detections and label results.

    Attributes:
        messages: All messages of the mapper.
        requests: Label requests without a result.
        answered: Number of label results.
    """

    def __init__(self, mapper: Mapper | None = None) -> None:
        self.mapper = mapper or Mapper(CONFIG, has_labeller=True)
        self.messages: list[Message] = []
        self.requests: deque[LabelRequest] = deque()
        self.boxes: deque[Message] = deque()
        self.answered = 0

    def take(self, messages) -> None:
        new = list(messages)
        self.messages += new
        self.requests.extend(of_kind(LabelRequest, new))

    def map(self, number: int) -> None:
        """Map a keyframe; its detections wait."""
        shot = shoot(SCENE_OBJECTS, ROUNDS[number], number)
        self.boxes.append(boxes_of(shot, number, (COUCH,)))
        self.take(self.mapper.handle(keyframe_of(shot, number)))

    def detect(self) -> None:
        """Handle the detections of the oldest keyframe without detections."""
        self.take(self.mapper.handle(self.boxes.popleft()))

    def answer(self) -> None:
        """Handle the result of the oldest label request."""
        request = self.requests.popleft()
        thing = thing_in_box(request)
        self.answered += 1
        self.take(self.mapper.handle(label_result(request, f"my {thing.name}" if thing else "")))

    def answer_all(self) -> None:
        while self.requests:
            self.answer()

    def settle(self) -> "Walk":
        """Handle all delayed messages, and do idle steps until no work is left."""
        while self.boxes:
            self.detect()
        self.answer_all()
        while self.mapper.has_idle_work():
            self.take(self.mapper.on_idle())
            self.answer_all()
        return self

    def objects(self) -> list[MapObject]:
        *_, last = of_kind(MapObjects, self.messages)
        return list(last.objects)


def prompt_walk() -> Walk:
    """Return a walk in which every message arrives at once."""
    walk = Walk()
    for number in range(len(ROUNDS)):
        walk.map(number)
        walk.detect()
        walk.answer_all()
    return walk.settle()


def walk_with_late_labels() -> Walk:
    """Return a walk in which no label result arrives before the last keyframe."""
    walk = Walk()
    for number in range(len(ROUNDS)):
        walk.map(number)
        walk.detect()
    return walk


def walk_with_late_boxes() -> Walk:
    """Return a walk whose detections and label results arrive after the last keyframe."""
    walk = Walk()
    for number in range(len(ROUNDS)):
        walk.map(number)
    return walk


@pytest.fixture(scope="module")
def prompt() -> Walk:
    return prompt_walk()


@pytest.fixture(scope="module")
def late() -> Walk:
    return walk_with_late_labels().settle()


def require_same_objects(objects: list[MapObject], others: list[MapObject]) -> None:
    """Require equal names, and a distance of at most 0.3 m of objects with the same name."""
    assert sorted(one.name for one in objects) == sorted(one.name for one in others)
    for one in objects:
        near = [
            other.name
            for other in others
            if np.linalg.norm(np.subtract(one.centroid, other.centroid)) < 0.3
        ]
        assert one.name in near


def test_objects_do_not_depend_on_when_label_results_arrive(prompt: Walk, late: Walk) -> None:
    """The ball has no name before the idle steps, see test_mapper_objects."""
    assert f"my {BALL.name}" in [one.name for one in prompt.objects()]
    require_same_objects(late.objects(), prompt.objects())
    assert late.mapper.metrics()["labels_reordered"] == 1


def test_objects_do_not_depend_on_when_detections_arrive(prompt: Walk) -> None:
    require_same_objects(walk_with_late_boxes().settle().objects(), prompt.objects())


def test_prompt_results_need_no_second_pass(prompt: Walk) -> None:
    assert prompt.mapper.metrics()["labels_reordered"] == 0


def test_known_results_are_not_requested_again(prompt: Walk, late: Walk) -> None:
    assert prompt.answered < late.answered < 1.5 * prompt.answered
    contents = [
        (m.keyframe, m.box_px, m.label, m.score, *[bytes(crop.data) for crop in m.crops])
        for m in of_kind(LabelRequest, late.messages)
    ]
    assert len(set(contents)) == len(contents)


def test_subscribers_receive_the_labels_that_replace_the_live_ones(late: Walk) -> None:
    replica = replicate([*late.messages, *late.mapper.on_stop()])
    labels = late.mapper._map.gaussians.labels
    assert np.array_equal(replica.map.labels, labels)
    assert replica.label_names == late.mapper._semantics.names


def test_object_ids_stay_when_late_labels_replace_the_live_ones() -> None:
    late = walk_with_late_labels()
    late.answer_all()
    before = {one.id: one for one in late.objects()}
    after = {one.id: one for one in late.settle().objects()}
    assert before
    assert before.keys() < after.keys()
    assert all(after[k].name == one.name for k, one in before.items())


def test_mapper_restored_between_idle_steps_ends_with_equal_labels(tmp_path: Path) -> None:
    config = replace(CONFIG, folder=str(tmp_path / "first"))
    first = Walk(Mapper(config, has_labeller=True))
    for number in range(len(WAY)):
        first.map(number)
        first.detect()
    while len(first.requests) > 3:
        first.answer()
    state = decode_state(encode_state(first.mapper.checkpoint()))
    shutil.copytree(tmp_path / "first", tmp_path / "second")
    second = Walk(Mapper(replace(config, folder=str(tmp_path / "second")), has_labeller=True))
    second.mapper.restore(state)
    second.requests = first.requests.copy()
    for walk in first, second:
        walk.answer_all()
        for _ in range(5):
            walk.take(walk.mapper.on_idle())
            walk.answer_all()
    state = decode_state(encode_state(first.mapper.checkpoint()))
    shutil.copytree(tmp_path / "first", tmp_path / "third")
    third = Walk(Mapper(replace(config, folder=str(tmp_path / "third")), has_labeller=True))
    third.mapper.restore(state)
    ends = [walk.settle() for walk in (first, second, third)]
    assert all(walk.mapper.metrics()["labels_reordered"] == 1 for walk in ends)
    assert len({walk.mapper._map.gaussians.labels.tobytes() for walk in ends}) == 1
    assert len({repr(walk.objects()) for walk in ends}) == 1


def test_saving_the_state_changes_no_message_of_idle_steps(
    late: Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A replay saves at other steps than the run, and must give the same messages."""
    monkeypatch.setattr("ldo_service.actors.mapper.LABEL_STEPS_PER_KEYFRAME", 1)
    saved = walk_with_late_labels()
    saved.answer_all()
    checkpoints = []
    while saved.mapper.has_idle_work():
        saved.take(saved.mapper.on_idle())
        saved.answer_all()
        save = saved.mapper.checkpoint if len(checkpoints) % 3 == 2 else saved.mapper.snapshot
        checkpoints.append(save()["map"])
    assert len({id(checkpoint) for checkpoint in checkpoints}) > 2
    encode = msgspec.msgpack.encode
    assert list(map(encode, saved.messages)) == list(map(encode, late.messages))


def test_request_that_the_labeller_never_answers_does_not_stop_the_correction() -> None:
    """A request that ends the process of the labeller is set aside, without a result."""
    late = walk_with_late_labels()
    late.requests.popleft()
    late.settle()
    assert late.mapper.metrics()["labels_reordered"] == 1
    assert late.mapper.metrics()["keyframes_to_relabel"] == 0


def test_too_many_waiting_keyframes_keep_the_live_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ordered_semantics, "MAX_KEYFRAMES", len(WAY))
    late = walk_with_late_labels().settle()
    assert late.mapper.metrics()["label_copies_dropped"] == 1
    assert late.mapper.metrics()["keyframes_to_relabel"] == 0


def test_copy_sends_no_request_without_credit() -> None:
    late = walk_with_late_labels()
    late.answer_all()
    late.mapper.situation = FlowStatus(credits={LABEL_REQUEST: 0})
    while late.mapper.has_idle_work():
        late.take(late.mapper.on_idle())
        assert not late.requests
    assert late.mapper.metrics()["label_requests_waiting"] > 0
    late.mapper.situation = FlowStatus(credits={LABEL_REQUEST: 1})
    late.settle()
    assert late.mapper.metrics()["labels_reordered"] == 1


def test_late_labels_are_corrected_only_when_the_camera_stands_still() -> None:
    """Requests that wait for the labeller are sent in shorter pauses."""
    late = walk_with_late_labels()
    assert not late.mapper.has_idle_work()
    late.answer_all()
    assert late.mapper.has_idle_work()
    assert late.mapper.idle_after_s == STILL_AFTER_S
    late.take(late.mapper.on_idle())
    assert late.mapper.idle_after_s < STILL_AFTER_S  # The label results that follow do not count.
    while not late.requests:
        late.take(late.mapper.on_idle())
    late.answer_all()
    assert late.mapper.has_idle_work()
    assert late.mapper.idle_after_s < STILL_AFTER_S
    late.map(len(WAY))
    assert late.mapper.idle_after_s == STILL_AFTER_S
    waiting = Walk()
    waiting.mapper.situation = FlowStatus(credits={LABEL_REQUEST: 0})
    for number in range(5):
        waiting.map(number)
        waiting.detect()
    waiting.mapper.situation = FlowStatus(credits={LABEL_REQUEST: 1})
    assert waiting.mapper.has_idle_work()
    assert waiting.mapper.idle_after_s < STILL_AFTER_S
