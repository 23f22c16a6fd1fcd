"""Scene of a running service, built from its messages and limited in size."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import get_args

from ldo_service.client import Client
from ldo_service.conversions.frames import camera_from_message
from ldo_service.maps.replica import MapReplica
from ldo_service.schemas import (
    DetectionBoxes,
    GraphCorrection,
    Health,
    Keyframe,
    LoopClosure,
    MapDelta,
    MapObjects,
    MapSnapshot,
    Message,
    TrackedPose,
)
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

from . import panel
from .lines import MAX_DETECTIONS
from .live_poses import LiveKeyframes, LivePath, T_map_camera_of
from .scene import Layer, ObjectBox, Scene, detections_of
from .view_config import ViewerConfig

# Maximum number of actors in the panel. Without a limit, messages could add names without end.
MAX_ACTORS = 64
# Maximum number of received loop closures that are kept; the oldest are dropped. Accepted loop
# closures are in each correction too.
MAX_LOOPS = 4096
TEXT_INTERVAL_S = 1.0  # Interval between changes of the panel's text, so that it can be read.

KEPT: dict[Topic, int] = {  # Maximum messages held between two updates; the oldest are dropped.
    POSE_TRACKED: 256,  # 8 s at 30 Hz.
    GRAPH_CORRECTION: 1,  # Each correction has all poses, so the newest suffices.
    MAP_OBJECTS: 1,
    DETECTION_BOXES: 64,
    LOOP_CLOSURE: 64,
    MAP_DELTA: 64,  # Messages of at most 1.8 MB.
    MAP_SNAPSHOT: 64,  # A million Gaussians, in messages of at most 1.8 MB.
    HEALTH: 64,
}
# Topics whose last value is requested at the start.
STATES = (MAP_SNAPSHOT, GRAPH_CORRECTION, MAP_OBJECTS, POSE_TRACKED)

RESTARTED_TOGETHER = (
    "tracker",
    "mapper",
)  # If both restart within TOGETHER_S seconds, the whole service was restarted or reset.
# If more time passes between their restarts, each actor was restarted alone.
TOGETHER_S = 30.0


class LiveScene:
    """Scene that is built from messages.

    `take` receives the messages. `update` brings `scene` up to date.
    """

    def __init__(self, config: ViewerConfig, clock: Callable[[], float]) -> None:
        self._config, self._clock = config, clock
        self._heard: dict[str, panel.HeartbeatRecord] = {}
        self._pose_rate, self._poses = panel.Rate(), 0
        self._text_updated_s = -TEXT_INTERVAL_S
        self.scene = Scene()
        self.reset()

    def reset(self) -> None:
        """Clear the scene, because the service has started a new map."""
        self._gaussians = MapReplica(self._config.max_gaussians)
        self.scene = Scene(camera=self.scene.camera)
        self._keyframes, self._path = LiveKeyframes(), LivePath(self._config.max_poses)
        self._loops: dict[tuple[int, int], None] = {}  # Loop closures in order of receipt.
        self._correction: GraphCorrection | None = None
        self._pose: panel.HeardPose | None = None
        self._changed: set[Layer] = set(get_args(Layer)) - {"facts"}

    @property
    def has_camera(self) -> bool:
        return self.scene.camera is not None

    def take(self, message: Message) -> None:
        """Receive one message."""
        match message:
            case TrackedPose():
                self._take_pose(message)
            case GraphCorrection():
                self._take_correction(message)
            case Keyframe():
                self.scene.camera = camera_from_message(message.camera)
                self._changed.add("keyframes")
            case DetectionBoxes():
                self._take_boxes(message)
            case MapDelta() | MapSnapshot():
                self._take_map(message)
            case MapObjects():
                self._take_objects(message)
            case LoopClosure():
                self._take_loop(message)
            case Health():
                self._take_health(message)

    def _take_pose(self, pose: TrackedPose) -> None:
        self._poses += 1
        self._pose = panel.HeardPose(pose, self._clock())
        if pose.status == "LOST":
            return
        self.scene.T_map_camera = T_map_camera_of(pose)
        self._path.add(pose, self.scene.T_map_camera)
        self._changed |= {"camera", "online", "final"}
        if pose.keyframe is not None:
            self._keyframes.add(pose, self.scene.T_map_camera)
            self._changed.add("keyframes")

    def _take_correction(self, correction: GraphCorrection) -> None:
        if self._correction and correction.graph_version <= self._correction.graph_version:
            return
        self._correction = correction
        # The correction lists only the newest rejected closures. Earlier corrections have already
        # removed the older ones.
        for loop in correction.rejected_closures:
            self._loops.pop(loop, None)
        self._keyframes.correct(correction)
        self._changed |= {"keyframes", "final", "loops"}

    def _take_objects(self, objects: MapObjects) -> None:
        if self.scene.objects is None:  # Add detections from before the viewer subscribed.
            detections = detections_of(objects)
            newest = sorted(detections)[-self._config.max_keyframes :]
            self.scene.detections = {k: detections[k] for k in newest} | self.scene.detections
            self._changed.add("keyframes")
        self.scene.objects = objects
        self._changed.add("objects")

    def _take_boxes(self, boxes: DetectionBoxes) -> None:
        found = (
            ObjectBox(one.label, one.box_px) for one in islice(boxes.detections, MAX_DETECTIONS)
        )
        detections = self.scene.detections
        detections[boxes.keyframe] = tuple(found)
        while len(detections) > self._config.max_keyframes:
            del detections[next(iter(detections))]
        self._changed.add("keyframes")

    def _take_loop(self, loop: LoopClosure) -> None:
        self._loops[loop.pose.reference, loop.pose.keyframe] = None
        while len(self._loops) > MAX_LOOPS:
            del self._loops[next(iter(self._loops))]
        self._changed.add("loops")

    def _take_map(self, message: MapDelta | MapSnapshot) -> None:
        if isinstance(message, MapDelta) and message.base_version == 0 and self._gaussians.version:
            self.reset()  # A delta from version 0 means that `ldo control reset` emptied the map.
        if self._gaussians.apply(message):
            self._changed.add("gaussians")

    def _take_health(self, health: Health) -> None:
        if health.actor not in self._heard and len(self._heard) >= MAX_ACTORS:
            return
        heard = self._heard.get(health.actor)
        rate = heard.rate if heard else panel.Rate()
        rate.add(self._clock(), health.steps)
        self._heard[health.actor] = panel.HeartbeatRecord(health, self._clock(), rate)

    # --- together ---------------------------------------------------------------------------------
    def update(self) -> set[Layer]:
        """Bring the scene up to date.

        Returns:
            The layers that have changed since the last call.
        """
        changed, self._changed = self._changed, set()
        scene = self.scene
        if "keyframes" in changed:
            scene.keyframes = self._keyframes.T_map
        if "online" in changed:
            scene.online = self._path.online()
        if "final" in changed:
            scene.final = self._path.final(self._keyframes.T_map)
        if "loops" in changed:
            scene.loops = self._agreed_loops()
        if "gaussians" in changed:
            scene.rows = self._gaussians.map.rows
        if self._clock() - self._text_updated_s >= TEXT_INTERVAL_S:
            self._text_updated_s = self._clock()
            self._pose_rate.add(self._text_updated_s, self._poses)
            scene.facts = self._facts()
            changed.add("facts")
        return changed

    def _agreed_loops(self) -> tuple[tuple[int, int], ...]:
        """Return the loop closures that the newest correction does not reject, as id pairs."""
        if self._correction is None:
            return tuple(self._loops)
        named = dict.fromkeys((*self._loops, *self._correction.accepted_closures))
        refused = set(self._correction.rejected_closures)
        return tuple(loop for loop in named if loop not in refused)

    def _facts(self) -> str:
        """Return the text of the panel."""
        scene, behind = self.scene, ", behind until the next snapshot"
        counts = (
            f"{len(self._keyframes.T_map):,} keyframes, {len(scene.rows):,} Gaussians drawn, "
            f"{len(scene.objects.objects) if scene.objects else 0} objects, "
            f"{len(scene.loops)} loops; map version {self._gaussians.version}"
            f"{behind if self._gaussians.is_behind else ''}"
        )
        return "\n\n".join(
            (
                panel.of_pose(self._pose, self._pose_rate, self._clock()),
                counts,
                panel.of_health(self._heard.values(), self._clock()),
            )
        )


class LiveSource:
    """Source of the scene of a running service; create it with `live`."""

    def __init__(self, service: Client, config: ViewerConfig, stack: ExitStack) -> None:
        self._service = service
        self._epochs: dict[str, int] = {}  # Epochs of the actors in RESTARTED_TOGETHER.
        self._began_s: dict[str, float] = {}  # Actor -> time of its new epoch.
        self._live = LiveScene(config, time.monotonic)
        self._inboxes = [
            stack.enter_context(service.poller(topic.subscription_key, topic.message, keep))
            for topic, keep in KEPT.items()
        ]
        self._until_camera = stack.enter_context(ExitStack())
        listen = service.poller(KEYFRAME_NEW.name, Keyframe, keep=1)
        self._keyframes: Callable[[], list[Keyframe]] = self._until_camera.enter_context(listen)
        self._ask()

    def _ask(self) -> None:
        """Request the last message of each topic in STATES."""
        for topic in STATES:
            for message in self._service.latest(topic):
                self._live.take(message)

    @property
    def scene(self) -> Scene:
        return self._live.scene

    def update(self, *, is_watched: bool = True) -> set[Layer]:
        """Receive all waiting messages and bring the scene up to date.

        Args:
            is_watched: False if no browser is connected; the scene is then updated later.

        Returns:
            The layers that have changed since the last update.
        """
        for inbox in self._inboxes:
            for message in inbox():
                self._live.take(message)
                if isinstance(message, Health):
                    self._note_epoch(message)
        if not self._live.has_camera:
            self._learn_camera()
        return self._live.update() if is_watched else set()

    def _note_epoch(self, health: Health) -> None:
        """Reset the scene if the service was restarted or reset.

        The versions in its messages may then start at zero again, so they cannot be compared with
        earlier versions.
        """
        if health.actor not in RESTARTED_TOGETHER:
            return
        if self._epochs.setdefault(health.actor, health.epoch) != health.epoch:
            self._epochs[health.actor] = health.epoch
            self._began_s[health.actor] = time.monotonic()
        began_s = self._began_s.values()
        if len(began_s) == len(RESTARTED_TOGETHER) and max(began_s) - min(began_s) < TOGETHER_S:
            self._began_s.clear()
            self._live.reset()
            self._ask()

    def _learn_camera(self) -> None:
        """Read the camera intrinsics from one keyframe message, then unsubscribe from keyframes.

        Keyframe messages are large, and all of them have the same intrinsics.
        """
        for keyframe in self._keyframes():
            self._live.take(keyframe)
            self._until_camera.close()


@contextmanager
def live(service: Client, config: ViewerConfig) -> Iterator[LiveSource]:
    """Open a context with a `LiveSource` that is subscribed to the topics of a service."""
    with ExitStack() as stack:
        yield LiveSource(service, config, stack)
