"""Tests of the scene of a service on the network, over TLS with the keys of a viewer."""

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
    """Router that has the keys of a service and publishes given messages."""

    def __init__(self, network: Endpoint, session: zenoh.Session) -> None:
        self._network, self._session = network, session

    def publish(self, topic: Topic, *messages: Message, below: str = "") -> None:
        for message in messages:
            self._session.put(self._network.expression(topic.name) + below, encode(message))

    def publisher(self, topic: Topic) -> zenoh.Publisher:
        return self._session.declare_publisher(self._network.expression(topic.name))

    def serve(self, topic: Topic, *messages: Message) -> zenoh.Queryable[None]:
        """Answer queries of a topic with the messages."""
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
    endpoint = free_endpoint().replace("tcp/", "tls/")
    return Endpoint("robot", endpoint, TlsKeys.of(tmp_path / "keys" / "service"))


@pytest.fixture
def robot(network: Endpoint) -> Iterator[Robot]:
    with open_session(network, router=True) as session:
        yield Robot(network, session)


@contextmanager
def live_source(network: Endpoint, tmp_path: Path) -> Iterator[LiveSource]:
    with (
        connect("robot", network.endpoint, tmp_path / "keys" / "viewer") as service,
        live(service, ViewerConfig()) as source,
    ):
        yield source


@pytest.fixture
def source(robot: Robot, network: Endpoint, tmp_path: Path) -> Iterator[LiveSource]:  # noqa: ARG001
    with live_source(network, tmp_path) as source:
        yield source


def test_messages_of_all_topics_reach_the_scene(robot: Robot, source: LiveSource) -> None:
    published = ChangingMap()
    robot.publish(KEYFRAME_NEW, EXAMPLES["keyframe"])
    robot.publish(POSE_TRACKED, EXAMPLES["tracked_pose"])
    robot.publish(MAP_DELTA, published.delta(), published.delta(), published.delta())
    robot.publish(LOOP_CLOSURE, EXAMPLES["loop_closure"])
    robot.publish(MAP_OBJECTS, EXAMPLES["map_objects"])
    robot.publish(DETECTION_BOXES, EXAMPLES["detection_boxes"])
    robot.publish(GRAPH_CORRECTION, EXAMPLES["graph_correction"])
    robot.publish(HEALTH, EXAMPLES["health"], below="/tracker")
    changed: set[str] = set()

    def is_complete() -> bool:
        changed.update(source.update())
        scene = source.scene
        single = (scene.camera, scene.T_map_camera, scene.objects)
        collections = (scene.detections, scene.keyframes, scene.loops)
        has_health = EXAMPLES["health"].actor in scene.facts
        return has_health and all(collections) and not any(value is None for value in single)

    wait_until(is_complete, 10, "every layer of the scene")
    assert {"gaussians", "camera", "keyframes", "objects", "loops"} <= changed
    np.testing.assert_array_equal(source.scene.rows, published.map.rows)


def test_late_viewer_gets_the_current_state_and_later_changes(
    robot: Robot, network: Endpoint, tmp_path: Path
) -> None:
    published = ChangingMap()
    for _ in range(5):
        published.delta()
    with (
        robot.serve(MAP_SNAPSHOT, *published.snapshot(parts=3)),
        robot.serve(GRAPH_CORRECTION, EXAMPLES["graph_correction"]),
        robot.serve(MAP_OBJECTS, EXAMPLES["map_objects"]),
        live_source(network, tmp_path) as source,
    ):
        assert source.update() >= {"gaussians", "keyframes", "objects"}
        np.testing.assert_array_equal(source.scene.rows, published.map.rows)
        assert source.scene.keyframes
        robot.publish(MAP_DELTA, published.delta())
        wait_until(lambda: "gaussians" in source.update(), 10, "the next change")
        np.testing.assert_array_equal(source.scene.rows, published.map.rows)


@pytest.mark.parametrize("first", [1, 4], ids=["from the first delta", "from a later delta"])
def test_scene_follows_a_service_restarted_with_an_empty_map(
    robot: Robot, source: LiveSource, first: int
) -> None:
    """The versions restart at 0, and the first delta that is received can have any of them."""
    old, new = ChangingMap(1), ChangingMap(2)
    for _ in range(5):
        robot.publish(MAP_DELTA, old.delta())
    robot.publish(GRAPH_CORRECTION, EXAMPLES["graph_correction"])
    publish_health(robot, epoch=1)
    wait_until(lambda: has_map(source, old) and bool(source.scene.keyframes), 10, "the old map")
    deltas = [new.delta() for _ in range(6)][first - 1 : 4]
    robot.publish(MAP_DELTA, *deltas[:1])
    snapshot = new.snapshot(parts=2)
    with robot.serve(MAP_SNAPSHOT, *snapshot):
        publish_health(robot, epoch=2)
        wait_until(lambda: has_map(source, new), 10, "the new map")
    assert not source.scene.keyframes, "keyframes of the old map are removed"


def test_restart_of_one_actor_keeps_the_map_and_the_path(robot: Robot, source: LiveSource) -> None:
    old = ChangingMap(1)
    robot.publish(POSE_TRACKED, EXAMPLES["tracked_pose"])
    robot.publish(MAP_DELTA, old.delta(), old.delta())
    publish_health(robot, epoch=1)
    wait_until(lambda: has_map(source, old), 10, "the map")
    publish_health(robot, epoch=2, actors=("mapper",))
    robot.publish(MAP_DELTA, old.delta())
    wait_until(lambda: has_map(source, old), 10, "the next delta")
    assert len(source.scene.online) == 1, "the path is kept"


def publish_health(
    robot: Robot, epoch: int, actors: tuple[str, ...] = ("tracker", "mapper")
) -> None:
    health = EXAMPLES["health"]
    assert isinstance(health, Health)
    for actor in actors:
        beat = msgspec.structs.replace(health, actor=actor, epoch=epoch)
        robot.publish(HEALTH, beat, below=f"/{actor}")


def has_map(source: LiveSource, published: ChangingMap) -> bool:
    source.update()
    return np.array_equal(source.scene.rows, published.map.rows)


def test_messages_without_a_watcher_are_deferred_and_not_lost(
    robot: Robot, source: LiveSource
) -> None:
    published = ChangingMap()
    robot.publish(POSE_TRACKED, EXAMPLES["tracked_pose"])
    robot.publish(MAP_DELTA, published.delta())
    for _ in range(20):
        assert source.update(is_watched=False) == set()
        time.sleep(0.05)
    assert len(source.scene.online) == 0
    wait_until(
        lambda: has_map(source, published) and len(source.scene.online) == 1,
        10,
        "the map and the path",
    )


def test_keyframe_subscription_ends_after_one_keyframe(robot: Robot, source: LiveSource) -> None:
    """Keyframes are large, and only their intrinsics are used."""
    publisher = robot.publisher(KEYFRAME_NEW)
    wait_until(lambda: publisher.matching_status.matching, 10, "the subscription")
    publisher.put(encode(EXAMPLES["keyframe"]))
    wait_until(
        lambda: bool(source.update()) and source.scene.camera is not None, 10, "the intrinsics"
    )
    wait_until(lambda: not publisher.matching_status.matching, 10, "the end of the subscription")
