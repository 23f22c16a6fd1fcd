"""A service on the network as a source of a scene, over TLS with a viewer's keys."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from ldo_service.authority import Authority
from ldo_service.client import connect
from ldo_service.runtime.keys import Keys
from ldo_service.runtime.zenoh_transport import Network, open_session
from ldo_service.schemas import Message, encode
from ldo_service.schemas.topics import (
    DETECTION_BOXES,
    GRAPH_CORRECTION,
    HEALTH,
    KEYFRAME_NEW,
    LOOP_CLOSURE,
    MAP_DELTA,
    MAP_OBJECTS,
    MAP_SNAPSHOT,
    POSE_TRACKED,
    Topic,
)
from ldo_service.viewer.config import ViewerConfig
from ldo_service.viewer.live import Live, live
from tests.schemas.examples import EXAMPLES
from tests.service.conftest import free_endpoint, wait_until
from tests.viewer.streams import ChangingMap


class Robot:
    """A router with the keys of a service: says what it is told to say."""

    def __init__(self, network: Network, session: zenoh.Session) -> None:
        self._network, self._session = network, session

    def says(self, topic: Topic, *messages: Message, below: str = "") -> None:
        for message in messages:
            self._session.put(self._network.expression(topic.name) + below, encode(message))

    def publisher(self, topic: Topic) -> zenoh.Publisher:
        return self._session.declare_publisher(self._network.expression(topic.name))

    def answers(self, topic: Topic, *messages: Message) -> zenoh.Queryable[None]:
        key = self._network.expression(topic.name)

        def reply(query: zenoh.Query) -> None:
            with query:
                for message in messages:
                    query.reply(key, encode(message))

        handler = zenoh.handlers.Callback(reply, indirect=False)
        return self._session.declare_queryable(key, handler)


@pytest.fixture
def network(tmp_path: Path) -> Network:
    authority = Authority.new(tmp_path / "keys", days=2)
    for role in ("service", "viewer"):
        authority.add(role, role, "robot", days=1)
    here = free_endpoint().replace("tcp/", "tls/")
    return Network("robot", here, Keys.of(tmp_path / "keys" / "service"))


@pytest.fixture
def robot(network: Network) -> Iterator[Robot]:
    with open_session(network, router=True) as session:
        yield Robot(network, session)


@contextmanager
def looked_at(network: Network, tmp_path: Path) -> Iterator[Live]:
    with (
        connect("robot", network.endpoint, tmp_path / "keys" / "viewer") as service,
        live(service, ViewerConfig()) as source,
    ):
        yield source


@pytest.fixture
def source(robot: Robot, network: Network, tmp_path: Path) -> Iterator[Live]:  # noqa: ARG001
    with looked_at(network, tmp_path) as source:
        yield source


def test_all_that_it_says_is_seen(robot: Robot, source: Live) -> None:
    changing = ChangingMap()
    robot.says(KEYFRAME_NEW, EXAMPLES["keyframe"])
    robot.says(POSE_TRACKED, EXAMPLES["tracked_pose"])
    robot.says(MAP_DELTA, changing.delta(), changing.delta(), changing.delta())
    robot.says(LOOP_CLOSURE, EXAMPLES["loop_closure"])
    robot.says(MAP_OBJECTS, EXAMPLES["map_objects"])
    robot.says(DETECTION_BOXES, EXAMPLES["detection_boxes"])
    robot.says(GRAPH_CORRECTION, EXAMPLES["correction"])
    robot.says(HEALTH, EXAMPLES["health"], below="/tracker")
    seen: set[str] = set()

    def all_of_it() -> bool:
        seen.update(source.update())
        scene = source.scene
        alone = (scene.camera, scene.T_map_camera, scene.objects)
        many = (scene.sights, scene.keyframes, scene.loops)
        told = EXAMPLES["health"].actor in scene.facts
        return told and all(many) and not any(one is None for one in alone)

    wait_until(all_of_it, 10, "all of it seen")
    assert {"gaussians", "camera", "keyframes", "objects", "loops"} <= seen
    np.testing.assert_array_equal(source.scene.rows, changing.map.rows)


def test_who_comes_late_is_told_what_there_is(
    robot: Robot, network: Network, tmp_path: Path
) -> None:
    changing = ChangingMap()
    for _ in range(5):
        changing.delta()
    with (
        robot.answers(MAP_SNAPSHOT, *changing.snapshot(parts=3)),
        robot.answers(GRAPH_CORRECTION, EXAMPLES["correction"]),
        robot.answers(MAP_OBJECTS, EXAMPLES["map_objects"]),
        looked_at(network, tmp_path) as source,
    ):
        assert source.update() >= {"gaussians", "keyframes", "objects"}
        np.testing.assert_array_equal(source.scene.rows, changing.map.rows)
        assert source.scene.keyframes
        robot.says(MAP_DELTA, changing.delta())
        wait_until(lambda: "gaussians" in source.update(), 10, "the next change")
        np.testing.assert_array_equal(source.scene.rows, changing.map.rows)


def test_only_one_keyframe_is_fetched_for_its_lens(robot: Robot, source: Live) -> None:
    """They are large, and nothing else is taken from them."""
    publisher = robot.publisher(KEYFRAME_NEW)
    wait_until(lambda: publisher.matching_status.matching, 10, "heard")
    publisher.put(encode(EXAMPLES["keyframe"]))
    wait_until(lambda: bool(source.update()) and source.scene.camera is not None, 10, "learnt")
    wait_until(lambda: not publisher.matching_status.matching, 10, "left alone")
