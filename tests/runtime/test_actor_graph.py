import pytest

from ldo_service.actors.topology import GRAPH
from ldo_service.errors import ConfigError, LosslessCycle
from ldo_service.runtime import Actor, In, Latest, Lossless, Out, check_graph
from ldo_service.runtime.actor import Policy
from ldo_service.runtime.actor_graph import (
    consumers_first,
    finish_order,
    lossless_consumers,
    producers,
)
from ldo_service.schemas.message import Message
from ldo_service.schemas.topics import Topic

A, B, C = (Topic(name, Message, "") for name in "abc")


def actor(kind: str, inputs: list[tuple[Topic, Policy]], outputs: list[Topic]) -> type[Actor]:
    ports = tuple(In(topic, policy) for topic, policy in inputs)
    members = {"name": kind, "inputs": ports, "outputs": tuple(Out(topic) for topic in outputs)}
    return type(kind, (Actor,), members)


def final(kind: str, inputs: list[tuple[Topic, Policy]], outputs: list[Topic]) -> type[Actor]:
    """Return an actor whose outputs are all final."""
    made = actor(kind, inputs, outputs)
    made.outputs = tuple(Out(topic, is_final=True) for topic in outputs)
    return made


def test_lossless_cycle_is_rejected_with_its_path() -> None:
    one = actor("one", [(C, Lossless())], [A])
    two = actor("two", [(A, Lossless())], [B])
    three = actor("three", [(B, Lossless())], [C])
    with pytest.raises(LosslessCycle, match="one -> three -> two -> one"):
        check_graph([one, two, three])


def test_actor_that_feeds_itself_is_rejected_as_a_cycle() -> None:
    with pytest.raises(LosslessCycle, match="one -> one"):
        check_graph([actor("one", [(A, Lossless())], [A])])


def test_cycle_with_one_latest_input_is_accepted() -> None:
    one = actor("one", [(B, Latest())], [A])
    two = actor("two", [(A, Lossless())], [B])
    check_graph([one, two])


def test_diamond_graph_is_accepted() -> None:
    source = actor("source", [], [A])
    left = actor("left", [(A, Lossless())], [B])
    right = actor("right", [(A, Lossless())], [C])
    check_graph([source, left, right, actor("sink", [(B, Lossless()), (C, Lossless())], [])])


def test_two_producers_of_one_topic_are_rejected() -> None:
    with pytest.raises(ConfigError, match="topic a has two producers, one and two"):
        check_graph([actor("one", [], [A]), actor("two", [], [A])])


def test_lossless_consumers_and_producers_of_topics_are_listed() -> None:
    lossless = actor("lossless", [(A, Lossless())], [B])
    latest = actor("latest", [(A, Latest())], [])
    assert lossless_consumers([lossless, latest], "a") == {"lossless"}
    assert producers([lossless, latest]) == {"b": "lossless"}


@pytest.mark.parametrize(
    "make",
    [
        lambda: Lossless(0),
        lambda: Latest(0),
        lambda: Latest(max_keys=0),
        lambda: In(A, Latest(per_key=True)),
    ],
)
def test_invalid_policy_is_rejected(make: object) -> None:
    with pytest.raises(ConfigError):
        make()  # type: ignore[operator]


def test_final_messages_reach_other_actors_before_these_finish() -> None:
    """The last closure leads to a correction, which moves the map before it is published."""
    names = [actor.name for actor in finish_order(GRAPH)]
    assert names[-3:] == ["loop_closer", "optimizer", "mapper"]
    assert sorted(names) == sorted(actor.name for actor in GRAPH)


def test_input_that_needs_no_final_messages_leaves_the_order() -> None:
    """If the input needs them, the actors form a cycle, and the first one listed finishes first."""
    sink = final("sink", [(A, Lossless())], [B])
    source = final("source", [], [A])
    source.inputs = (In(B, Latest(), needs_final=False),)
    assert finish_order([sink, source]) == [source, sink]
    source.inputs = (In(B, Latest()),)
    assert finish_order([sink, source]) == [sink, source]


def test_actors_finish_in_a_cycle_of_final_messages_too() -> None:
    one = final("one", [(B, Latest())], [A])
    two = final("two", [(A, Lossless())], [B])
    assert finish_order([one, two]) == [one, two]


def test_consumers_of_lossless_topics_come_before_their_producers() -> None:
    """Mapper and labeller form a cycle, which the tracker reaches at the mapper."""
    names = [actor.name for actor in consumers_first(GRAPH)]
    assert sorted(names) == sorted(actor.name for actor in GRAPH)
    links = [
        (consumer.name, producer.name)
        for producer in GRAPH
        for consumer in GRAPH
        if any(lossless_consumers([consumer], out.topic.name) for out in producer.outputs)
    ]
    late = {(a, b) for a, b in links if names.index(a) > names.index(b)}
    assert late == {("mapper", "vlm_labeller")}
