"""A running service as a source of a scene."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from ldo_service.client import Client
from ldo_service.schemas import Health, Keyframe
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


ANEW = ("tracker", "mapper")  # both began anew: so did the map, or it is told again
TOGETHER_S = 30.0  # from one to the other of a service that starts; apart, each went on by itself


class Live:
    """Made by `live`."""

    def __init__(self, service: Client, config: ViewerConfig, stack: ExitStack) -> None:
        self._service = service
        self._epochs: dict[str, int] = {}  # of those in ANEW
        self._began_s: dict[str, float] = {}  # when another one was first heard of
        self._live = LiveScene(config, time.monotonic)
        self._inboxes = [
            stack.enter_context(service.listen(topic.subscribed_as, topic.message, keep))
            for topic, keep in KEPT.items()
        ]
        self._until_camera = stack.enter_context(ExitStack())
        listen = service.listen(KEYFRAME_NEW.name, Keyframe, keep=1)
        self._keyframes: Callable[[], list[Keyframe]] = self._until_camera.enter_context(listen)
        self._ask()

    def _ask(self) -> None:
        """For what was said before."""
        for topic in STATES:
            for message in self._service.last(topic):
                self._live.take(message)

    @property
    def scene(self) -> Scene:
        return self._live.scene

    def update(self, *, is_watched: bool = True) -> set[Layer]:
        for inbox in self._inboxes:
            for message in inbox():
                self._live.take(message)
                if isinstance(message, Health):
                    self._note_epoch(message)
        if not self._live.has_camera:
            self._learn_camera()
        return self._live.update() if is_watched else set()

    def _note_epoch(self, health: Health) -> None:
        """A service that was started again, or was told to reset, may count from the beginning:
        its versions say nothing beside those of before."""
        if health.actor not in ANEW:
            return
        if self._epochs.setdefault(health.actor, health.epoch) != health.epoch:
            self._epochs[health.actor] = health.epoch
            self._began_s[health.actor] = time.monotonic()
        began_s = self._began_s.values()
        if len(began_s) == len(ANEW) and max(began_s) - min(began_s) < TOGETHER_S:
            self._began_s.clear()
            self._live.begin_anew()
            self._ask()

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
