"""A running service as a source of a scene."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from ldo_service.client import Client
from ldo_service.schemas import Keyframe
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

from .config import ViewerConfig
from .live_scene import LiveScene
from .scene import Layer, Scene

KEPT: dict[
    Topic, int
] = {  # messages between two updates; what is too much is dropped, oldest first
    POSE_TRACKED: 256,  # 8 s of 30 Hz
    GRAPH_CORRECTION: 1,  # the newest says it all
    MAP_OBJECTS: 1,
    DETECTION_BOXES: 64,
    LOOP_CLOSURE: 64,
    MAP_DELTA: 64,  # of at most 1.8 MB
    MAP_SNAPSHOT: 64,  # the same: a million Gaussians
    HEALTH: 64,
}
STATES = (MAP_SNAPSHOT, GRAPH_CORRECTION, MAP_OBJECTS, POSE_TRACKED)  # what a late joiner asks for


class Live:
    """Made by `live`."""

    def __init__(self, service: Client, config: ViewerConfig, stack: ExitStack) -> None:
        self._live = LiveScene(config, time.monotonic)
        self._inboxes = [
            stack.enter_context(service.listen(_name(topic), topic.message, keep))
            for topic, keep in KEPT.items()
        ]
        self._until_camera = stack.enter_context(ExitStack())
        listen = service.listen(KEYFRAME_NEW.name, Keyframe, keep=1)
        self._keyframes: Callable[[], list[Keyframe]] = self._until_camera.enter_context(listen)
        for topic in STATES:
            for message in service.last(topic):
                self._live.take(message)

    @property
    def scene(self) -> Scene:
        return self._live.scene

    def update(self) -> set[Layer]:
        for inbox in self._inboxes:
            for message in inbox():
                self._live.take(message)
        if not self._live.has_camera:
            self._learn_camera()
        return self._live.update()

    def _learn_camera(self) -> None:
        """From one keyframe: these are large, and all of one camera."""
        for keyframe in self._keyframes():
            self._live.take(keyframe)
            self._until_camera.close()


@contextmanager
def live(service: Client, config: ViewerConfig) -> Iterator[Live]:
    """Subscribe to all that is shown, and ask for what was said before."""
    with ExitStack() as stack:
        yield Live(service, config, stack)


def _name(topic: Topic) -> str:
    return f"{topic.name}/*" if topic is HEALTH else topic.name
