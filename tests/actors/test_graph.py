"""The design card as data."""

import pytest

from ldo_service.actors import graph
from ldo_service.actors.graph import GRAPH, RUNNING, Box, box_named, consumers_of, producer_of
from ldo_service.errors import ConfigError
from ldo_service.runtime import check_graph
from ldo_service.runtime.graph import lossless_consumers
from ldo_service.schemas import topics as t


def test_neither_the_design_nor_what_runs_of_it_can_wait_for_itself() -> None:
    check_graph(GRAPH)
    check_graph(RUNNING)


def test_every_topic_of_the_design_has_a_producer() -> None:
    for topic in t.TOPICS:
        assert producer_of(topic) != "nobody yet", topic.name


def test_only_actors_that_run_hold_a_window() -> None:
    consumers = {"detector", "mapper", "loop_closer", "optimizer"}
    assert lossless_consumers(RUNNING, "keyframe/new") == consumers
    assert len(consumers_of(t.KEYFRAME_NEW)) == 4


def test_an_actor_without_code_is_in_no_run(monkeypatch) -> None:
    declared = Box("dreamer", "declared", inputs=(), outputs=())
    monkeypatch.setattr(graph, "GRAPH", (*GRAPH, declared))
    with pytest.raises(ConfigError, match="declared"):
        box_named("dreamer")


def test_what_runs_uses_topics_with_a_format_only() -> None:
    for box in RUNNING:
        for port in (*box.inputs, *box.outputs):
            assert port.topic.message is not None, (box.name, port.topic.name)
        assert box_named(box.name).make is not None
