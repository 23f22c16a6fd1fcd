"""Detection of loop closures between subgraphs of keyframes.

Topics, their messages, the delivery policy of each input (with its queue length), and notes:

in   keyframe/new       Keyframe         Backlog(4)    a lost keyframe could never close a loop
in   detection/boxes    DetectionBoxes   Backlog(16)   object classes in every keyframe
in   graph/correction   GraphCorrection  Latest(1)     has all poses, so the newest suffices
in   map/objects        MapObjects       Latest(1)     has all objects, so the newest suffices
out  loop/closure       LoopClosure                    each accepted candidate
out  loop/candidate     LoopCandidate                  each candidate, with a reason if rejected

The actor processes a keyframe when its detections have arrived. The detector publishes a message
for every keyframe. The field `network` of this message is empty if the detector has no network or
inference failed.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ldo_service.conversions.frames import keyframe_from_message
from ldo_service.conversions.loops import loop_candidate_to_message, loop_closure_to_message
from ldo_service.conversions.objects import landmarks_from_message, scale_boxes
from ldo_service.conversions.poses import keyframe_poses_from_correction, pose_from_message
from ldo_service.detection.dynamic_classes import DynamicClassConfig, dynamic_class_mask
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.loop_closing import LoopCandidateResult, LoopDetector, LoopsConfig
from ldo_service.loop_closing.object_points import DetectionPoints, locate_detections
from ldo_service.loop_closing.object_presence import MapLandmarks
from ldo_service.runtime import Actor, Backlog, In, Latest, Out
from ldo_service.schemas import (
    Detection,
    DetectionBoxes,
    GraphCorrection,
    Keyframe,
    LoopCandidate,
    LoopClosure,
    MapObjects,
)
from ldo_service.schemas.message import decode, encode
from ldo_service.schemas.topics import (
    DETECTION_BOXES,
    GRAPH_CORRECTION,
    KEYFRAME_NEW,
    LOOP_CANDIDATE,
    LOOP_CLOSURE,
    MAP_OBJECTS,
)
from ldo_service.tracking.keyframe_database import KeyframeRecord, make_keyframe_record

log = logging.getLogger(__name__)

# Maximum number of keyframes that wait for a slow detector: two minutes at 2 Hz, 33 MB at 640x480.
# If more wait, the oldest is compared without its detections.
MAX_PENDING_KEYFRAMES = 256
# Number of newest keyframes for which the optimizer may not have published a pose yet. The tracker
# keeps the poses of the same number of keyframes.
RECENT_KEYFRAMES = 32


@dataclass(frozen=True, slots=True)
class LoopCloserConfig:
    """Parameters of the loop closer."""

    is_on: bool = True  # False disables loop closing, to measure its benefit.
    loops: LoopsConfig = field(default_factory=LoopsConfig)
    movable: DynamicClassConfig = field(default_factory=DynamicClassConfig)


@dataclass(frozen=True, eq=False, slots=True)
class PendingKeyframe:
    """Keyframe that waits for its detections."""

    place: KeyframeRecord
    frame: int
    stamp_ns: int
    width_px: int  # Width of the image that the boxes refer to.

    @property
    def facts(self) -> tuple[int, int, int]:
        """Frame number, stamp in ns and image width in pixels, for the saved state.

        The keyframe record `place` is saved as a separate part of the state.
        """
        return self.frame, self.stamp_ns, self.width_px


class LoopCloser(Actor):
    """Actor that detects loop closures; the optimizer decides whether to accept them."""

    name = "loop_closer"
    inputs = (
        In(KEYFRAME_NEW, Backlog(4)),
        In(DETECTION_BOXES, Backlog(16)),
        In(GRAPH_CORRECTION, Latest(1)),
        In(MAP_OBJECTS, Latest(1), needs_final=False),  # The mapper finishes after the last loop.
    )
    outputs = (Out(LOOP_CLOSURE, is_final=True), Out(LOOP_CANDIDATE, is_final=True))
    is_backend = True
    # Time without messages after which the unfinished subgraph is compared, seconds. A camera that
    # makes no keyframe for this time stands still. Objects of the map are messages too: while the
    # mapper does idle work and publishes objects more often than this, the comparison waits.
    idle_after_s = 5.0

    def __init__(self, config: LoopCloserConfig | None = None) -> None:
        super().__init__()
        self.config = config or LoopCloserConfig()
        self.recognizer = LoopDetector(self.config.loops)
        self._vocabulary = Vocabulary()
        self.poses = KeyframePoses()  # Poses of the stored keyframes and the newest ones.
        # Id of the older submap that a submap was merged into, by id of the merged submap.
        self._merged_submaps: dict[int, int] = {}
        self._waiting: dict[int, PendingKeyframe] = {}  # Pending keyframes by id.
        # Detections that arrived before their keyframe or wait together with it, by keyframe id.
        self._boxes: dict[int, DetectionBoxes] = {}
        self._objects = MapLandmarks.none()  # Objects of the map, as last published.
        self._newest = -1  # Id of the newest received keyframe.
        self._accepted = self._refused = self._without_boxes = self._repeated = 0
        self._parts: dict[str, Any] | None = None  # Cached parts of the state.
        # Cached poses of the state; None after a change.
        self._saved_poses: dict[str, Any] | None = None

    def handle(
        self, message: Keyframe | DetectionBoxes | GraphCorrection | MapObjects
    ) -> Iterator[LoopClosure | LoopCandidate]:
        """Yield the loop candidates and closures of keyframes that can be processed now.

        A keyframe can be processed when its detections have arrived or can no longer arrive.
        """
        if not self.config.is_on:
            return
        self._parts = None
        if isinstance(message, GraphCorrection):
            T_map = keyframe_poses_from_correction(message, only=self.poses)
            self.poses.correct(message.graph_version, T_map)
            self._saved_poses = None
            self._merged_submaps = dict(message.merged_submaps)
            return
        if isinstance(message, MapObjects):
            self._objects = landmarks_from_message(message, self.config.movable.classes)
            return
        if isinstance(message, Keyframe):
            self._take(message)
        elif message.keyframe > self._newest or message.keyframe in self._waiting:
            self._boxes[message.keyframe] = message
        for keyframe in self._ready():
            yield from self._recognize(keyframe)

    def _take(self, message: Keyframe) -> None:
        if message.keyframe <= self._newest:
            self._repeated += 1  # Sent again after a restart.
            return
        self._newest = message.keyframe
        self._saved_poses = None
        self.poses.add(
            message.keyframe,
            message.reference,
            pose_from_message(message.T_reference_keyframe),
            pose_from_message(message.T_odom_keyframe),
            message.submap,
        )
        loops = self.config.loops
        place = make_keyframe_record(
            keyframe_from_message(message, loops.pyramid), loops.features, loops.keyframe_database
        )
        width_px = message.camera.width
        self._waiting[message.keyframe] = PendingKeyframe(
            place, message.frame, message.stamp_ns, width_px
        )

    def _ready(self) -> list[int]:
        """Return the ids of the pending keyframes that can be processed now, in order.

        Detections arrive in the order of the keyframes. If a keyframe has detections, those of
        earlier pending keyframes can no longer arrive. If more than `MAX_PENDING_KEYFRAMES` wait,
        the oldest ones are processed without detections.
        """
        newest = max(self._boxes.keys() & self._waiting.keys(), default=-1)
        ready = [k for k in self._waiting if k <= newest]
        late = len(self._waiting) - len(ready) - MAX_PENDING_KEYFRAMES
        return ready or list(self._waiting)[: max(late, 0)]

    # --- loop detection ---------------------------------------------------------------------------
    def _recognize(self, keyframe: int) -> Iterator[LoopClosure | LoopCandidate]:
        waiting, boxes = self._waiting.pop(keyframe), self._boxes.pop(keyframe, None)
        self._boxes = {k: b for k, b in self._boxes.items() if k > keyframe}
        self._without_boxes += boxes is None
        place, points = self._masked_keyframe(waiting, boxes)
        results = self.recognizer.add(
            place,
            waiting.frame,
            waiting.stamp_ns,
            points,
            self.poses,
            self._merged_submaps,
            self._objects,
        )
        yield from self._to_messages(results)
        if not self.recognizer.is_open or keyframe % RECENT_KEYFRAMES == 0:
            self.poses.keep_only(self._needed())
            self._saved_poses = None

    def _masked_keyframe(
        self, waiting: PendingKeyframe, boxes: DetectionBoxes | None
    ) -> tuple[KeyframeRecord, DetectionPoints | None]:
        """Return the keyframe's record without dynamic objects, and its detections as 3D points.

        Only detections of static classes become points. If no network ran, the record is returned
        unchanged, with None instead of points.
        """
        if boxes is None or not boxes.network:
            return waiting.place, None
        place, movable = waiting.place, self.config.movable
        times = waiting.width_px / place.camera.width
        found = scale_boxes(boxes.detections, times)
        place = place.without(dynamic_class_mask(found, place.depth_m, movable))
        return place, self._detection_points(boxes.detections, place, times)

    def _detection_points(
        self, detections: tuple[Detection, ...], place: KeyframeRecord, times: float
    ) -> DetectionPoints:
        standing = [d for d in detections if d.label not in self.config.movable.classes]
        boxes = np.array([d.box_px for d in standing], float).reshape(-1, 4)
        return locate_detections(
            np.array([self._vocabulary.index(d.label) for d in standing], np.uint8),
            np.array([d.score for d in standing], np.float32),
            (boxes + 0.5) / times - 0.5,
            place.depth_m,
            place.camera,
            self.config.loops.verification.landmarks,
        )

    def _to_messages(
        self, results: Iterable[LoopCandidateResult]
    ) -> Iterator[LoopClosure | LoopCandidate]:
        for result in results:
            closure = result.closure
            if closure is None:
                self._refused += 1
            else:
                self._accepted += 1
                log.info(
                    "loop_closer: keyframe %d closes a loop with keyframe %d", closure.b, closure.a
                )
                yield loop_closure_to_message(result)
            yield loop_candidate_to_message(result)

    def has_idle_work(self) -> bool:
        return self.config.is_on and not self._waiting and self.recognizer.can_flush

    def on_idle(self) -> Iterator[LoopClosure | LoopCandidate]:
        """Compare the unfinished subgraph with earlier subgraphs while the camera stands still."""
        self._parts = None
        yield from self._to_messages(self._flush())

    def on_stop(self) -> Iterator[LoopClosure | LoopCandidate]:
        """Search for loop closures of the pending keyframes and of the unfinished subgraph."""
        self._parts = None
        for keyframe in list(self._waiting):
            yield from self._recognize(keyframe)
        yield from self._to_messages(self._flush())

    def _flush(self) -> list[LoopCandidateResult]:
        return self.recognizer.flush(self.poses, self._merged_submaps, self._objects)

    def _needed(self) -> list[int]:
        """Return the ids of the keyframes whose poses must be kept.

        These are the keyframes stored as views of subgraphs, and the newest ones, for which the
        optimizer may not have published a pose yet.
        """
        views = {v.keyframe for s in self.recognizer.subgraphs for v in s.views}
        return [k for k in self.poses if k > self._newest - RECENT_KEYFRAMES or k in views]

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """Return the state in parts that are written only when they change.

        Each subgraph, each keyframe of the unfinished subgraph and each pending keyframe is a part.
        Four more parts are the visual words, the keyframe poses, the objects, and the rest.
        """
        if self._parts is None:
            self._parts = self._all_parts()
        return self._parts

    def _all_parts(self) -> dict[str, Any]:
        state = self.recognizer.snapshot()
        subgraphs = {f"subgraph_{s['keyframes'][0]}": s for s in state.pop("subgraphs")}
        views = {f"view_{view['place']['id']}": view for view in state.pop("views")}
        waiting = {f"waiting_{k}": w.place.pack() for k, w in self._waiting.items()}
        words = {"words": state.pop("words")}  # The same array until a word is learned.
        now = {
            **state,
            "waiting": {k: w.facts for k, w in self._waiting.items()},
            "boxes": [encode(boxes) for boxes in self._boxes.values()],
            "newest": self._newest,
            "joined": list(self._merged_submaps.items()),
            "vocabulary": self._vocabulary.pack(),
        }
        objects = {"objects": self._objects.pack()}  # The same object until the next message.
        parts = {**subgraphs, **views, **waiting, **words, **objects}
        return {**parts, **self._poses_part(), "now": now}

    def _poses_part(self) -> dict[str, Any]:
        """Return the part of the state with the keyframe poses.

        This part is the largest one: 0.4 kB for each stored view. It is cached, because detections
        do not change the poses.
        """
        if self._saved_poses is None:
            self._saved_poses = self.poses.snapshot()
        return {"poses": self._saved_poses}

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        """Continue from a snapshot."""
        now = state["now"]

        def parts(kind: str) -> list[Any]:
            names = [name for name in state if name.startswith(kind)]
            return [state[name] for name in sorted(names, key=lambda n: int(n[len(kind) :]))]

        kept = {"subgraphs": parts("subgraph_"), "views": parts("view_")}
        self.recognizer.restore({**now, **kept, "words": state["words"]})
        self._waiting = {
            int(k): PendingKeyframe(KeyframeRecord.unpack(state[f"waiting_{k}"]), *facts)
            for k, facts in now["waiting"].items()
        }
        boxes = [decode(body, DetectionBoxes) for body in now["boxes"]]
        self._boxes = {one.keyframe: one for one in boxes}
        # States that were saved before the loop closer received objects have no such part.
        self._objects = MapLandmarks.unpack(state.get("objects"))
        self._newest, self._merged_submaps = now["newest"], dict(map(tuple, now["joined"]))
        self._vocabulary = Vocabulary.unpack(now["vocabulary"])
        self.poses = KeyframePoses()
        self.poses.restore(state["poses"])
        self._parts = self._saved_poses = None

    def metrics(self) -> dict[str, float]:
        """Return counters of subgraphs, loops and keyframes."""
        return {
            "subgraphs": len(self.recognizer.subgraphs),
            "loops_accepted": self._accepted,
            "loops_rejected": self._refused,
            # Keyframes for which no detections arrived.
            "keyframes_without_detections": self._without_boxes,
            "keyframes_repeated": self._repeated,
        }
