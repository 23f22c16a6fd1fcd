"""Mapping with labelled 3D Gaussians and objects.

Topics, their messages, the delivery policy of each input (with its queue length), and notes:

in   keyframe/new          Keyframe             Lossless(8)        the map would lack a lost one
in   detection/boxes       DetectionBoxes       Lossless(8)        labels come from detections
in   label/result          LabelResult          Lossless(8)        one result for each request
in   graph/correction      GraphCorrection      Latest(1)          the newest has all poses
in   map/refine            RefineMap            Latest(1)          only the newest request counts
out  map/view              MapRendering         the map rendered at the newest keyframe
out  map/delta             MapDelta             changes since the last version
out  map/snapshot          MapSnapshot          the whole map, in parts, every few keyframes
out  label/request         LabelRequest         unlabelled regions, for the labeller
out  map/objects           MapObjects           all objects, after the first detections
out  object/observation    ObjectObservation    objects observed or missed in a keyframe
out  keyframe/refinement   KeyframeRefinement   keyframe poses refined by the renderer
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.conversions.frames import (
    camera_correction_from_message,
    frame_from_message,
    mask_from_array,
)
from ldo_service.conversions.objects import detections_from_message, observations_to_messages
from ldo_service.conversions.poses import (
    keyframe_poses_from_correction,
    pose_from_message,
    pose_to_message,
)
from ldo_service.gaussians.loop_refit import LoopRefit
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.maps.label_queue import LabelRequestQueue, LabelRequests
from ldo_service.maps.publisher import MapPublisher, MessageContext, ObjectPublisher
from ldo_service.maps.relative_measurements import RelativeMeasurements
from ldo_service.regions.region import RegionLabelResult
from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.runtime.actor import UNLIMITED
from ldo_service.schemas import (
    AnchorMotion,
    DetectionBoxes,
    GraphCorrection,
    Keyframe,
    KeyframeRefinement,
    LabelRequest,
    LabelResult,
    MapDelta,
    MapObjects,
    MapRendering,
    MapSnapshot,
    ObjectObservation,
    RefineMap,
)
from ldo_service.schemas.topics import (
    DETECTION_BOXES,
    GRAPH_CORRECTION,
    KEYFRAME_NEW,
    KEYFRAME_REFINEMENT,
    LABEL_REQUEST,
    LABEL_RESULT,
    MAP_DELTA,
    MAP_OBJECTS,
    MAP_REFINE,
    MAP_SNAPSHOT,
    MAP_VIEW,
    OBJECT_OBSERVATION,
)
from ldo_service.semantics.observations import KeyframeSemantics
from ldo_service.semantics.ordered_semantics import OrderedSemantics

# Idle steps between two messages with changed Gaussians: some seconds of work, up to 4 MB.
IDLE_STEPS_PER_DELTA = 8
# Steps of the correction of late labels that take as long as the mapping of a keyframe.
LABEL_STEPS_PER_KEYFRAME = 4
# Time without messages after which the camera stands still and late labels are corrected, seconds.
# The result would depend on shorter pauses.
STILL_AFTER_S = 5.0

MapOutput = MapRendering | MapDelta | MapSnapshot | MapObjects
Output = MapOutput | LabelRequest | ObjectObservation | KeyframeRefinement


class Mapper(Actor):
    """Actor that adds each keyframe to the map when it arrives.

    When a correction changes keyframe poses, the Gaussians move with their anchor keyframes.
    """

    name = "mapper"
    lags = True  # The mapper saves the whole map only every few keyframes.
    inputs = (
        In(KEYFRAME_NEW, Lossless(8)),
        In(DETECTION_BOXES, Lossless(8)),
        In(LABEL_RESULT, Lossless(8)),
        In(GRAPH_CORRECTION, Latest(1)),
        In(MAP_REFINE, Latest(1)),
    )
    outputs = (
        Out(MAP_VIEW),
        Out(MAP_DELTA),
        Out(MAP_SNAPSHOT, is_final=True),
        Out(LABEL_REQUEST, is_nonblocking=True),
        Out(MAP_OBJECTS, is_final=True),
        Out(OBJECT_OBSERVATION),
        Out(KEYFRAME_REFINEMENT),
    )

    def __init__(self, config: MapperConfig | None = None, *, has_labeller: bool = False) -> None:
        """Start with an empty map; `has_labeller` enables label requests."""
        super().__init__()
        self.config = config or MapperConfig()
        folder = Path(self.config.folder) if self.config.folder else None
        threads = self.config.thread_count()
        self._map = MapBuilder(self.config.builder, folder=folder, threads=threads)
        self.files = self._map.files
        self._ordered = OrderedSemantics(
            self._map, self.config.semantics, has_labeller=has_labeller, threads=threads
        )
        self._semantics = self._ordered.live
        self._object_publisher = ObjectPublisher()
        self._poses = KeyframePoses()
        self._links = RelativeMeasurements(self._poses, self.config.measured_keyframes)
        self._publisher = MapPublisher(self._map, self.config.publish)
        self._newest: tuple[int, int] = (0, -1)  # Stamp in ns and id of the newest keyframe.
        self._refit = LoopRefit(self._map, self.config.refit)
        self._requests = LabelRequests(self._ordered, self._map)
        self._idle_steps = self._saved_steps = 0  # Idle steps in all, and at the last checkpoint.
        self._is_still = False  # True if only label results came since the last corrected label.
        self._checkpoint: dict[str, Any] = {}
        self._repeated = 0

    def handle(
        self, message: Keyframe | DetectionBoxes | LabelResult | GraphCorrection | RefineMap
    ) -> Iterator[Output]:
        self._is_still &= isinstance(message, LabelResult)
        match message:
            case DetectionBoxes():
                yield from self._take_boxes(message)
            case LabelResult():
                yield from self._take_label(message)
            case GraphCorrection():
                yield from self._correct(message)
            case RefineMap():
                yield from self._refine(message)
            case Keyframe() if message.keyframe in self._poses:
                self._repeated += 1  # Sent again after a restart.
            case Keyframe():
                yield from self._add(message)

    # --- keyframes --------------------------------------------------------------------------------
    def _add(self, message: Keyframe) -> Iterator[Output]:
        T_map_keyframe = self._poses.add(
            message.keyframe,
            message.reference,
            pose_from_message(message.T_reference_keyframe),
            pose_from_message(message.T_odom_keyframe),
            message.submap,
        )
        self._links.add(message)
        self._newest = (message.stamp_ns, message.keyframe)
        frame = frame_from_message(message)
        moving = mask_from_array(message.dynamic_mask)
        used = camera_correction_from_message(message.camera_correction)
        self._map.add(frame, T_map_keyframe, message.keyframe, self._iterations(), moving, used)
        fused = self._ordered.on_keyframe_mapped(message.keyframe)
        self._refit.with_keyframe(is_behind=self._waiting() > 0)
        yield from self._refinement()
        yield from self._publisher.on_keyframe(self._message_context())
        yield self._publisher.rendering(
            message, self._message_context(), contributions=self._semantics.is_used
        )
        yield from self._publisher.snapshot_if_due(self._message_context())
        yield from self._publish_semantics(fused, message.stamp_ns)

    def _iterations(self) -> int:
        """Return the number of optimization iterations for the next keyframe.

        The more keyframes wait, the fewer iterations each one gets. Its Gaussians are optimized
        again with later keyframes. The iterations of a pending deduplication are subtracted.
        """
        return max(
            self.config.iterations // (1 + self._waiting()) - self._refit.deduplication_iterations,
            min(self.config.min_iterations, self.config.iterations),
        )

    def _waiting(self) -> int:
        return self.situation.backlog.get(KEYFRAME_NEW, 0)

    def _refine(self, message: RefineMap) -> Iterator[Output]:
        self._refit.refine(message.iterations, (message.initial_rate, message.final_rate))
        self._semantics.refresh()
        yield from self._refinement()
        yield from self._publish_changes()

    def _refinement(self) -> Iterator[KeyframeRefinement]:
        refinement = self._links.refined(self._map.refined(), self._newest[0])
        if refinement:
            yield refinement

    # --- labels and objects -----------------------------------------------------------------------
    def _take_boxes(self, message: DetectionBoxes) -> Iterator[Output]:
        """Add the detections of a keyframe; the next map delta has the resulting labels.

        If no network ran, the keyframe does not count as a miss of any object.
        """
        vocabulary = self._semantics.vocabulary
        detections = detections_from_message(message, vocabulary) if message.network else None
        fused = self._ordered.add_detections(message.keyframe, detections)
        yield from self._publish_semantics(fused, message.stamp_ns)

    def _take_label(self, message: LabelResult) -> Iterator[Output]:
        answer = RegionLabelResult(message.label, message.confidence, message.alternatives)
        if self._ordered.apply_label(message.region, message.keyframe, answer):
            yield from self._objects()
        yield from self._label_requests()

    def _publish_semantics(
        self, fused: KeyframeSemantics | None, stamp_ns: int
    ) -> Iterator[Output]:
        if fused is not None:
            names = self._semantics.names
            yield from observations_to_messages(fused.observed, names, fused.keyframe, stamp_ns)
            self._requests.add(fused.requested, stamp_ns)
            yield from self._label_requests()
            yield from self._objects()

    def _label_requests(self) -> Iterator[LabelRequest]:
        """Yield as many waiting label requests as the labeller has granted credit for."""
        yield from self._requests.take(self.situation.credits.get(LABEL_REQUEST, UNLIMITED))

    def _objects(self) -> Iterator[MapObjects]:
        """Yield all objects in one message; yield nothing before the first detections."""
        semantics = self._semantics
        if semantics.is_used:
            now = self._publisher.version, self._poses.version, self._newest[0]
            yield self._object_publisher.message(semantics.objects, semantics.names, *now)

    # --- corrections ------------------------------------------------------------------------------
    def _correct(self, message: GraphCorrection) -> Iterator[Output]:
        """Move the Gaussians with their anchor keyframes to the corrected poses.

        The motions are rounded as in the message, so that map replicas stay equal to this map.
        """
        held = self._links.acknowledged(message.last_refinement)
        self._poses.correct(
            message.graph_version, keyframe_poses_from_correction(message), held=held
        )
        self._refit.mark_moved(self._poses)
        motions = tuple(self._motion(keyframe) for keyframe in self._moved_keyframes())
        if motions:
            T_new_old = {m.keyframe: pose_from_message(m.T_new_old) for m in motions}
            self._map.move_keyframes(T_new_old)
            self._ordered.move(T_new_old)
            yield self._publisher.delta(self._message_context(), motions=motions)
            yield from self._objects()

    def _moved_keyframes(self) -> list[int]:
        """Return the ids of the keyframes whose Gaussians must move.

        The pose of such a keyframe differs visibly from the pose to which its Gaussians were last
        moved. Smaller differences accumulate until they are visible.
        """
        config, placed = self.config, self._map.views.poses
        T_now, T_gaussians = self._poses.of(placed), placed.of(placed)
        shows = se3.transforms_differ(
            T_now, T_gaussians, config.motion_min_m, config.motion_min_rad
        )
        return np.array(list(placed), np.int64)[shows].tolist()

    def _motion(self, keyframe: int) -> AnchorMotion:
        """Return the motion of a keyframe's Gaussians from their last to its current pose."""
        T_map_gaussians = self._map.views.poses[keyframe]
        T_new_old = pose_to_message(self._poses[keyframe] @ se3.inverse(T_map_gaussians))
        return AnchorMotion(keyframe=keyframe, T_new_old=T_new_old)

    # --- messages ---------------------------------------------------------------------------------
    def _message_context(self) -> MessageContext:
        return MessageContext(self._newest[0], self._poses.version, self._semantics.names)

    def on_restored(self) -> Iterator[Output]:
        """Publish the whole map, because subscribers may have missed deltas."""
        if self._map.size():
            yield from self._publisher.publish_snapshot(self._message_context())
            yield from self._objects()

    @property
    def idle_after_s(self) -> float:  # type: ignore[override]
        """Time without messages after which idle work starts, seconds."""
        still_after_s = 0.0 if self._is_still else STILL_AFTER_S
        return super().idle_after_s if self._has_urgent_work() else still_after_s

    def _has_urgent_work(self) -> bool:
        can_request = self.has_credit(LABEL_REQUEST) and len(self._requests.queue) > 0
        return can_request or self._refit.has_work()

    def has_idle_work(self) -> bool:
        return self._has_urgent_work() or self._ordered.has_work()

    def on_idle(self) -> Iterator[Output]:
        """Refit the corrected map, send label requests, and repeat labelling with late results."""
        yield from self._label_requests()
        self._idle_steps += 1
        if self._refit.has_work():
            yield from self._refit_idly()
        elif self._ordered.has_work():
            yield from self._order_labels()

    def _refit_idly(self) -> Iterator[Output]:
        self._refit.while_idle()
        is_done = not self._refit.has_work()
        if is_done:
            self._semantics.refresh()
        yield from self._refinement()
        yield from self._publish_changes(is_done=is_done)

    def _order_labels(self) -> Iterator[Output]:
        step = self._ordered.step()
        self._is_still = True
        self._requests.add(step.requests, self._newest[0])
        yield from self._label_requests()
        yield from self._publish_changes(is_done=step.is_done)

    def _publish_changes(self, *, is_done: bool = True) -> Iterator[Output]:
        """Publish after some idle steps or finished work, and make the next checkpoint due."""
        if is_done or self._idle_steps % IDLE_STEPS_PER_DELTA == 0:
            yield from self._publisher.deltas(self._message_context(), with_changed=True)
            yield from self._objects()
        label_steps = LABEL_STEPS_PER_KEYFRAME * self._checkpoint_interval()
        steps = IDLE_STEPS_PER_DELTA if self._refit.has_work() else label_steps
        if is_done or self._idle_steps - self._saved_steps >= steps:
            self._checkpoint = {}  # The next snapshot is a new checkpoint.

    def on_stop(self) -> Iterator[Output]:
        """Publish the final map after removing duplicate Gaussians of the newest keyframes."""
        if self._map.size():
            self._refit.at_end()
            self._semantics.refresh()
            yield from self._publisher.publish_snapshot(self._message_context())
            yield from self._objects()

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """Return the last checkpoint of the map, the same object until the next one is due."""
        newest = self._newest[1]
        saved = self._checkpoint["newest"][1] if self._checkpoint else None
        if newest >= 0 and (saved is None or newest - saved >= self._checkpoint_interval()):
            self._take_checkpoint()
        return {"map": self._checkpoint} if self._checkpoint else {}

    def checkpoint(self) -> dict[str, Any]:
        self._checkpoint = {}
        return self.snapshot()

    def _checkpoint_interval(self) -> int:
        return self.config.checkpoint_interval(len(self._map.gaussians))

    def _take_checkpoint(self) -> None:
        self._saved_steps = self._idle_steps
        self._checkpoint = {
            "newest": self._newest,
            "map": self._map.snapshot(),
            "semantics": self._ordered.snapshot(),
            "poses": self._poses.snapshot(),
            "links": self._links.snapshot(),
            "publisher": self._publisher.snapshot(),
            "refit": self._refit.snapshot(),
            "label_queue": self._requests.queue.pack(),
        }

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        saved = state["map"]
        self._newest = (int(saved["newest"][0]), int(saved["newest"][1]))
        self._map.restore(saved["map"])
        self._ordered.restore(saved["semantics"])
        self._poses.restore(saved["poses"])
        self._links.restore(saved["links"])
        self._publisher.restore(saved["publisher"])
        self._refit.restore(saved["refit"])
        self._requests.queue = LabelRequestQueue.unpack(saved["label_queue"])

    def metrics(self) -> dict[str, float]:
        return {
            "keyframes": len(self._poses),
            "keyframes_repeated": self._repeated,
            # Label requests that wait until the labeller grants credit.
            "label_requests_waiting": len(self._requests.queue),
            **self._refit.metrics(),
            **self._map.metrics(),
            **self._ordered.metrics(),
        }
