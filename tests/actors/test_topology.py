"""The design card as data."""

import pytest

from ldo_service.actors.topology import GRAPH, actor_spec, consumers_of, producer_of
from ldo_service.errors import ConfigError
from ldo_service.runtime import check_graph
from ldo_service.runtime.actor_graph import lossless_consumers
from ldo_service.schemas import topics as t


def test_no_actor_can_wait_for_itself() -> None:
    check_graph(GRAPH)


def test_every_topic_of_the_design_has_a_producer() -> None:
    for topic in t.TOPICS:
        assert producer_of(topic) != "nobody", topic.name


def test_only_actors_that_run_hold_a_window() -> None:
    consumers = {"detector", "mapper", "loop_closer", "optimizer"}
    assert lossless_consumers(GRAPH, "keyframe/new") == consumers
    assert len(consumers_of(t.KEYFRAME_NEW)) == 4


def test_an_actor_is_found_by_its_name_and_no_other() -> None:
    assert [actor_spec(box.name) for box in GRAPH] == [*GRAPH]
    with pytest.raises(ConfigError, match=r"no actor 'dreamer'.*frame_source"):
        actor_spec("dreamer")
