"""The graph of actors and topics."""

import pytest

from ldo_service.actors.topology import GRAPH, actor_spec, consumers_of, producer_of
from ldo_service.errors import ConfigError
from ldo_service.runtime import check_graph
from ldo_service.runtime.actor_graph import consumers_with_backlog, lossless_consumers
from ldo_service.schemas import topics as t


def test_graph_has_no_cycle_of_lossless_inputs() -> None:
    check_graph(GRAPH)


def test_every_topic_has_a_producer() -> None:
    for topic in t.TOPICS:
        assert producer_of(topic) != "none", topic.name


def test_only_the_mapper_can_hold_back_the_tracker() -> None:
    lossless = lossless_consumers(GRAPH, "keyframe/new")
    assert lossless == {"detector", "mapper", "loop_closer"}
    assert lossless - consumers_with_backlog(GRAPH, "keyframe/new") == {"mapper"}
    assert len(consumers_of(t.KEYFRAME_NEW)) == 3


def test_no_actor_waits_for_the_optimizer() -> None:
    for port in actor_spec("optimizer").inputs:
        topic = port.topic.name
        assert lossless_consumers(GRAPH, topic) == consumers_with_backlog(GRAPH, topic)


def test_unknown_actor_name_is_refused_with_the_known_ones() -> None:
    assert [actor_spec(box.name) for box in GRAPH] == [*GRAPH]
    with pytest.raises(ConfigError, match=r"no actor 'dreamer'.*frame_source"):
        actor_spec("dreamer")
