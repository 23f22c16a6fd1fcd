import pytest

from ldo_service.errors import ConfigError, LosslessCycle
from ldo_service.runtime import Actor, In, Latest, Lossless, Out, check_graph
from ldo_service.runtime.actor import Policy
from ldo_service.runtime.actor_graph import lossless_consumers, producers
from ldo_service.schemas.message import Message
from ldo_service.schemas.topics import Topic

A, B, C = (Topic(name, Message, "") for name in "abc")


def actor(kind: str, inputs: list[tuple[Topic, Policy]], outputs: list[Topic]) -> type[Actor]:
    ports = tuple(In(topic, policy) for topic, policy in inputs)
    members = {"name": kind, "inputs": ports, "outputs": tuple(Out(topic) for topic in outputs)}
    return type(kind, (Actor,), members)


def test_a_cycle_of_lossless_inputs_is_refused_and_named() -> None:
    one = actor("one", [(C, Lossless())], [A])
    two = actor("two", [(A, Lossless())], [B])
    three = actor("three", [(B, Lossless())], [C])
    with pytest.raises(LosslessCycle, match="one -> three -> two -> one"):
        check_graph([one, two, three])


def test_an_actor_that_feeds_itself_is_a_cycle() -> None:
    with pytest.raises(LosslessCycle, match="one -> one"):
        check_graph([actor("one", [(A, Lossless())], [A])])


def test_a_cycle_with_one_latest_input_is_taken() -> None:
    one = actor("one", [(B, Latest())], [A])
    two = actor("two", [(A, Lossless())], [B])
    check_graph([one, two])


def test_a_diamond_is_no_cycle() -> None:
    source = actor("source", [], [A])
    left = actor("left", [(A, Lossless())], [B])
    right = actor("right", [(A, Lossless())], [C])
    check_graph([source, left, right, actor("sink", [(B, Lossless()), (C, Lossless())], [])])


def test_two_producers_of_one_topic_are_refused() -> None:
    with pytest.raises(ConfigError, match="topic a has two producers, one and two"):
        check_graph([actor("one", [], [A]), actor("two", [], [A])])


def test_consumers_that_must_not_miss_a_message_are_found() -> None:
    keen = actor("keen", [(A, Lossless())], [B])
    casual = actor("casual", [(A, Latest())], [])
    assert lossless_consumers([keen, casual], "a") == {"keen"}
    assert producers([keen, casual]) == {"b": "keen"}


@pytest.mark.parametrize(
    "make",
    [
        lambda: Lossless(0),
        lambda: Latest(0),
        lambda: Latest(max_keys=0),
        lambda: In(A, Latest(per_key=True)),
    ],
)
def test_an_impossible_policy_is_refused(make: object) -> None:
    with pytest.raises(ConfigError):
        make()  # type: ignore[operator]
