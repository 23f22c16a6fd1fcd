"""A service on the network as a source of a scene, over TLS with a viewer's keys."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh

from ldo_service.client import connect
from ldo_service.schemas import Health, Message, encode
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
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.zenoh_transport import Endpoint, open_session
from ldo_service.viewer.live import LiveSource, live
from ldo_service.viewer.view_config import ViewerConfig
from tests.maps.streams import ChangingMap
from tests.ports import free_endpoint
from tests.schemas.examples import EXAMPLES
from tests.service.conftest import wait_until


class Robot:
    """A router with the keys of a service: says what it is told to say."""

    def __init__(self, network: Endpoint, session: zenoh.Session) -> None:
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
def network(tmp_path: Path) -> Endpoint:
    authority = CertificateAuthority.new(tmp_path / "keys", days=2)
    for role in ("service", "viewer"):
        authority.add(role, role, "robot", days=1)
    here = free_endpoint().replace("tcp/", "tls/")
    return Endpoint("robot", here, TlsKeys.of(tmp_path / "keys" / "service"))


@pytest.fixture
def robot(network: Endpoint) -> Iterator[Robot]:
    with open_session(network, router=True) as session:
        yield Robot(network, session)


@contextmanager
def looked_at(network: Endpoint, tmp_path: Path) -> Iterator[LiveSource]:
    with (
        connect("robot", network.endpoint, tmp_path / "keys" / "viewer") as service,
        live(service, ViewerConfig()) as source,
    ):
        yield source


@pytest.fixture
def source(robot: Robot, network: Endpoint, tmp_path: Path) -> Iterator[LiveSource]:  # noqa: ARG001
    with looked_at(network, tmp_path) as source:
        yield source


def test_all_that_it_says_is_seen(robot: Robot, source: LiveSource) -> None:
    changing = ChangingMap()
    robot.says(KEYFRAME_NEW, EXAMPLES["keyframe"])
    robot.says(POSE_TRACKED, EXAMPLES["tracked_pose"])
    robot.says(MAP_DELTA, changing.delta(), changing.delta(), changing.delta())
    robot.says(LOOP_CLOSURE, EXAMPLES["loop_closure"])
    robot.says(MAP_OBJECTS, EXAMPLES["map_objects"])
    robot.says(DETECTION_BOXES, EXAMPLES["detection_boxes"])
    robot.says(GRAPH_CORRECTION, EXAMPLES["graph_correction"])
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
    robot: Robot, network: Endpoint, tmp_path: Path
) -> None:
    changing = ChangingMap()
    for _ in range(5):
        changing.delta()
    with (
        robot.answers(MAP_SNAPSHOT, *changing.snapshot(parts=3)),
        robot.answers(GRAPH_CORRECTION, EXAMPLES["graph_correction"]),
        robot.answers(MAP_OBJECTS, EXAMPLES["map_objects"]),
        looked_at(network, tmp_path) as source,
    ):
        assert source.update() >= {"gaussians", "keyframes", "objects"}
        np.testing.assert_array_equal(source.scene.rows, changing.map.rows)
        assert source.scene.keyframes
        robot.says(MAP_DELTA, changing.delta())
        wait_until(lambda: "gaussians" in source.update(), 10, "the next change")
        np.testing.assert_array_equal(source.scene.rows, changing.map.rows)


@pytest.mark.parametrize("first", [1, 4], ids=["from its beginning", "from later on"])
def test_a_service_that_is_started_again_with_an_empty_map_is_followed(
    robot: Robot, source: LiveSource, first: int
) -> None:
    """Its versions begin at 0, and what is heard first may be any of them."""
    old, new = ChangingMap(1), ChangingMap(2)
    for _ in range(5):
        robot.says(MAP_DELTA, old.delta())
    robot.says(GRAPH_CORRECTION, EXAMPLES["graph_correction"])
    lives(robot, epoch=1)
    wait_until(lambda: shows(source, old) and bool(source.scene.keyframes), 10, "the old map")
    deltas = [new.delta() for _ in range(6)][first - 1 : 4]
    robot.says(MAP_DELTA, *deltas[:1])
    told = new.snapshot(parts=2)
    with robot.answers(MAP_SNAPSHOT, *told):
        lives(robot, epoch=2)
        wait_until(lambda: shows(source, new), 10, "the new map")
    assert not source.scene.keyframes, "those of the old one are gone"


def test_an_actor_that_was_started_again_alone_goes_on_with_the_map(
    robot: Robot, source: LiveSource
) -> None:
    old = ChangingMap(1)
    robot.says(POSE_TRACKED, EXAMPLES["tracked_pose"])
    robot.says(MAP_DELTA, old.delta(), old.delta())
    lives(robot, epoch=1)
    wait_until(lambda: shows(source, old), 10, "the map")
    lives(robot, epoch=2, actors=("mapper",))
    robot.says(MAP_DELTA, old.delta())
    wait_until(lambda: shows(source, old), 10, "it goes on")
    assert len(source.scene.online) == 1, "and the path is kept"


def lives(robot: Robot, epoch: int, actors: tuple[str, ...] = ("tracker", "mapper")) -> None:
    health = EXAMPLES["health"]
    assert isinstance(health, Health)
    for actor in actors:
        beat = msgspec.structs.replace(health, actor=actor, epoch=epoch)
        robot.says(HEALTH, beat, below=f"/{actor}")


def shows(source: LiveSource, changing: ChangingMap) -> bool:
    source.update()
    return np.array_equal(source.scene.rows, changing.map.rows)


def test_what_nobody_watches_is_not_worked_out_and_not_lost(
    robot: Robot, source: LiveSource
) -> None:
    changing = ChangingMap()
    robot.says(POSE_TRACKED, EXAMPLES["tracked_pose"])
    robot.says(MAP_DELTA, changing.delta())
    for _ in range(20):
        assert source.update(is_watched=False) == set()
        time.sleep(0.05)
    assert len(source.scene.online) == 0
    wait_until(lambda: shows(source, changing) and len(source.scene.online) == 1, 10, "all of it")


def test_only_one_keyframe_is_fetched_for_its_lens(robot: Robot, source: LiveSource) -> None:
    """They are large, and nothing else is taken from them."""
    publisher = robot.publisher(KEYFRAME_NEW)
    wait_until(lambda: publisher.matching_status.matching, 10, "heard")
    publisher.put(encode(EXAMPLES["keyframe"]))
    wait_until(lambda: bool(source.update()) and source.scene.camera is not None, 10, "learnt")
    wait_until(lambda: not publisher.matching_status.matching, 10, "left alone")
