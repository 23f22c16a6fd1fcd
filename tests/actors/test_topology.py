"""The graph of actors and topics."""

import pytest

from ldo_service.actors.topology import GRAPH, actor_spec, consumers_of, producer_of
from ldo_service.errors import ConfigError
from ldo_service.runtime import check_graph
from ldo_service.runtime.actor_graph import lossless_consumers
from ldo_service.schemas import topics as t


def test_graph_has_no_cycle_of_lossless_inputs() -> None:
    check_graph(GRAPH)


def test_every_topic_has_a_producer() -> None:
    for topic in t.TOPICS:
        assert producer_of(topic) != "nobody", topic.name


def test_keyframe_topic_has_four_lossless_consumers() -> None:
    consumers = {"detector", "mapper", "loop_closer", "optimizer"}
    assert lossless_consumers(GRAPH, "keyframe/new") == consumers
    assert len(consumers_of(t.KEYFRAME_NEW)) == 4


def test_unknown_actor_name_is_refused_with_the_known_ones() -> None:
    assert [actor_spec(box.name) for box in GRAPH] == [*GRAPH]
    with pytest.raises(ConfigError, match=r"no actor 'dreamer'.*frame_source"):
        actor_spec("dreamer")
