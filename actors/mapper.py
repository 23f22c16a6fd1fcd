"""The map of Gaussians.                                                        actors/mapper.py

in   keyframe/new          Keyframe             Lossless(8)       a missing one is a hole in the map
in   detection/boxes       DetectionBoxes       Lossless(8)       without it there are no labels
in   label/result          LabelResult          Latest(1 per key) the newest look at a region
in   graph/correction      GraphCorrection      Latest(1)         a versioned absolute state
in   map/refine            RefineMap            Latest(1)         what was asked last
out  map/view              MapRendering         the map as rendered at the newest keyframe
out  map/delta             MapDelta             what changed
out  map/snapshot          MapSnapshot          the whole of it, in parts, now and then
out  label/request         LabelRequest         what a labeller is to name, if there is one
out  map/objects           MapObjects           what stands in it, once somebody looked
out  object/observation    ObjectObservation    where a keyframe shows that, or ought to
out  keyframe/refinement   KeyframeRefinement   where the renderer wants the keyframes
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.conversions.frames import frame_from_message, mask_from_array
from ldo_service.conversions.objects import (
    detections_from_message,
    label_request_to_message,
    observations_to_messages,
)
from ldo_service.conversions.poses import (
    keyframe_poses_from_correction,
    pose_from_message,
    pose_to_message,
)
from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.loop_refit import LoopRefit, LoopRefitConfig
from ldo_service.gaussians.map_builder import MapBuilder, MapBuilderConfig
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.maps.publisher import MapPublisher, MessageContext, ObjectPublisher, PublishConfig
from ldo_service.maps.relative_measurements import RelativeMeasurements
from ldo_service.regions.region import RegionLabelResult
from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.schemas import (
    AnchorMotion,
    Array,
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
from ldo_service.semantics.semantic_map import KeyframeSemantics, SemanticMap, SemanticMapConfig

MapOutput = MapRendering | MapDelta | MapSnapshot | MapObjects
Output = MapOutput | LabelRequest | ObjectObservation | KeyframeRefinement


@dataclass(frozen=True, slots=True)
class MapperConfig:
    builder: MapBuilderConfig = field(default_factory=MapBuilderConfig)
    semantics: SemanticMapConfig = field(default_factory=SemanticMapConfig)
    iterations: int = 12  # of the optimiser per keyframe, fewer where the map is dense: 12 FPS on
    # two cores at 640x480
    least_iterations: int = 3  # however many keyframes wait: none is left as it was inserted
    folder: str = ""  # for the images of keyframes; empty: a temporary one, or within the state
    threads: int = 0  # of the renderer; 0: all cores but one, which the tracker needs
    snapshot_keyframes: int = 10  # between snapshots on the network
    snapshot_growth: float = 0.25  # and at least this share of new Gaussians: a large map is sent
    # seldom, so that snapshots never cost more than a few times the deltas
    snapshot_keyframes_max: int = 200  # but after so many in any case: who joined late, or missed a
    # delta, waits no longer
    part_gaussians: int = 16_384  # in one message: 1.2 MB, 1.8 MB with labels, so that none blocks
    # the others long
    changed_keyframes: int = 5  # between telling how old Gaussians changed: the optimiser touches
    # all that is in view at every keyframe
    measured_keyframes: int = 64  # the newest, of which each measurement is taken anew when the
    # renderer moves them; of older ones, which the optimizer has condensed, that from the reference
    checkpoint_keyframes: int = 5  # between saved maps: after a crash so many are mapped again
    motion_min_m: float = 2e-4  # a correction that moves a keyframe less shows nowhere: 0.1 px.
    motion_min_rad: float = 2e-4  # Equal to MapBuilderConfig.refined_rad
    mending_min_m: float = 0.01  # a keyframe that a correction moves farther is mended: it may lie
    mending_min_rad: float = 0.01  # over surface that the map holds already. Less is refined anyway
    mended_keyframes: int = 2  # per new one: a closure that moves a hundred is mended in fifty
    mended_at_end: int = 200  # when the stream ends, the newest: some seconds
    mending_iterations: int = 3  # of the optimiser, as for a new keyframe when many wait
    due_iterations: int = 12  # for a keyframe that a correction moves so far against the first one,
    # half of them against others: as many as a new one gets
    paid_iterations: int = 6  # of these, with each new keyframe while no other waits: it takes half
    # as long again. A run over a file does the rest at its end, `map/refine` when asked

    def __post_init__(self) -> None:
        amounts = (
            *("iterations", "least_iterations", "threads", "snapshot_growth"),
            *("mended_keyframes", "mended_at_end", "mending_iterations"),
            *("due_iterations", "paid_iterations"),
        )
        if min(getattr(self, name) for name in amounts) < 0:
            raise ConfigError(named(self, *amounts) + ": none may be negative.")
        counts = (
            *("snapshot_keyframes", "part_gaussians", "checkpoint_keyframes"),
            *("changed_keyframes", "measured_keyframes"),
        )
        if min(getattr(self, name) for name in counts) < 1:
            raise ConfigError(named(self, *counts) + ": each must be at least 1.")

    def thread_count(self) -> int:
        return self.threads or max(1, (os.cpu_count() or 1) - 1)

    def pace(self) -> PublishConfig:
        """Of telling others."""
        return PublishConfig(**{f.name: getattr(self, f.name) for f in fields(PublishConfig)})

    def repair(self) -> LoopRefitConfig:
        """After corrections."""
        return LoopRefitConfig(**{f.name: getattr(self, f.name) for f in fields(LoopRefitConfig)})


class Mapper(Actor):
    """Maps a keyframe at once; corrections move each Gaussian with the keyframe that made it."""

    name = "mapper"
    lags = True  # it writes the whole map every few keyframes
    finishes_last = True  # a closure of the last keyframes corrects the map
    inputs = (
        In(KEYFRAME_NEW, Lossless(8)),
        In(DETECTION_BOXES, Lossless(8)),
        In(LABEL_RESULT, Latest(1, per_key=True)),
        In(GRAPH_CORRECTION, Latest(1)),
        In(MAP_REFINE, Latest(1)),
    )
    outputs = (
        Out(MAP_VIEW),
        Out(MAP_DELTA),
        Out(MAP_SNAPSHOT),
        Out(LABEL_REQUEST),
        Out(MAP_OBJECTS),
        Out(OBJECT_OBSERVATION),
        Out(KEYFRAME_REFINEMENT),
    )

    def __init__(self, config: MapperConfig | None = None, *, has_labeller: bool = False) -> None:
        """`has_labeller`: there is an actor that answers label/request with names."""
        super().__init__()
        self.config = config or MapperConfig()
        folder = Path(self.config.folder) if self.config.folder else None
        threads = self.config.thread_count()
        self._map = MapBuilder(self.config.builder, folder=folder, threads=threads)
        self._semantics = SemanticMap(
            self._map, self.config.semantics, has_labeller=has_labeller, threads=threads
        )
        self._objects_teller = ObjectPublisher()
        self._poses = KeyframePoses()
        self._links = RelativeMeasurements(self._poses, self.config.measured_keyframes)
        self._publisher = MapPublisher(self._map, self.config.pace())
        self._newest: tuple[int, int] = (0, -1)  # stamp_ns and id of the newest keyframe
        self._repair = LoopRefit(self._map, self.config.repair())
        self._checkpoint: dict[str, Any] = {}
        self._repeated = 0

    def handle(
        self, message: Keyframe | DetectionBoxes | LabelResult | GraphCorrection | RefineMap
    ) -> Iterator[Output]:
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
                self._repeated += 1  # sent again after a restart
            case Keyframe():
                yield from self._add(message)

    # --- keyframes --------------------------------------------------------------------------------
    def _add(self, message: Keyframe) -> Iterator[Output]:
        # place it
        T_map_keyframe = self._poses.add(
            message.keyframe,
            message.reference,
            pose_from_message(message.T_reference_keyframe),
            pose_from_message(message.T_odom_keyframe),
            message.submap,
        )
        self._links.add(message)
        self._newest = (message.stamp_ns, message.keyframe)
        # map it
        frame = frame_from_message(message)
        moving = mask_from_array(message.dynamic_mask)
        self._map.add(frame, T_map_keyframe, message.keyframe, self._iterations(), moving)
        learnt = self._semantics.on_keyframe_mapped(message.keyframe)
        self._repair.with_keyframe(is_behind=self._waiting() > 0)
        # tell
        yield from self._refinement()
        yield from self._publisher.on_keyframe(self._message_context())
        yield self._view(message)
        yield from self._publisher.snapshot_if_due(self._message_context())
        yield from self._publish_semantics(learnt, message.stamp_ns)

    def _iterations(self) -> int:
        """Fewer, the more keyframes wait: then the map is behind, and each is optimised again as
        the neighbour of the next. Those that are mended with it have their share."""
        config = self.config
        return max(
            config.iterations // (1 + self._waiting()) - self._repair.mending_iterations,
            min(config.least_iterations, config.iterations),
        )

    def _waiting(self) -> int:
        return self.situation.backlog.get(KEYFRAME_NEW, 0)

    def _refine(self, message: RefineMap) -> Iterator[Output]:
        self._repair.refine(message.iterations, (message.initial_rate, message.final_rate))
        self._semantics.refresh()
        self._checkpoint = {}  # is due: half a minute of work, and perhaps no keyframe follows
        yield from self._refinement()
        yield from self._publisher.deltas(self._message_context(), with_changed=True)
        yield from self._objects()

    def _refinement(self) -> Iterator[KeyframeRefinement]:
        refinement = self._links.refined(self._map.refined(), self._newest[0])
        if refinement:
            yield refinement

    # --- labels and objects -----------------------------------------------------------------------
    def _take_boxes(self, message: DetectionBoxes) -> Iterator[Output]:
        """Followers are told of labels with what changes next. Where nobody looked, nothing was
        missed."""
        vocabulary = self._semantics.vocabulary
        claims = detections_from_message(message, vocabulary) if message.network else None
        learnt = self._semantics.add_detections(message.keyframe, claims)
        yield from self._publish_semantics(learnt, message.stamp_ns)

    def _take_label(self, message: LabelResult) -> Iterator[Output]:
        answer = RegionLabelResult(message.label, message.confidence, message.alternatives)
        if self._semantics.apply_label(message.region, message.keyframe, answer):
            yield from self._objects()

    def _publish_semantics(
        self, learnt: KeyframeSemantics | None, stamp_ns: int
    ) -> Iterator[Output]:
        if learnt is not None:
            names = self._semantics.names
            yield from observations_to_messages(learnt.observed, names, learnt.keyframe, stamp_ns)
            yield from (label_request_to_message(region, stamp_ns) for region in learnt.asked)
            yield from self._objects()

    def _objects(self) -> Iterator[MapObjects]:
        """All of them; nothing where nobody ever looked."""
        semantics = self._semantics
        if semantics.is_used:
            now = self._publisher.version, self._poses.version, self._newest[0]
            yield self._objects_teller.message(semantics.objects, semantics.names, *now)

    # --- corrections ------------------------------------------------------------------------------
    def _correct(self, message: GraphCorrection) -> Iterator[Output]:
        """Move Gaussians with their keyframes; subscribers apply the same rounded motions."""
        held = self._links.acknowledged(message.last_refinement)
        self._poses.correct(
            message.graph_version, keyframe_poses_from_correction(message), held=held
        )
        self._repair.mark_moved(self._poses)
        motions = tuple(self._motion(keyframe) for keyframe in self._moved_keyframes())
        if motions:
            T_new_old = {m.keyframe: pose_from_message(m.T_new_old) for m in motions}
            self._map.move(T_new_old)
            self._semantics.objects.move(T_new_old)
            yield self._publisher.delta(self._message_context(), motions=motions)
            yield from self._objects()

    def _moved_keyframes(self) -> list[int]:
        """Keyframes that are so far from where their Gaussians are that it shows; too little to
        show adds up until it is enough."""
        config, placed = self.config, self._map.views.poses
        T_now, T_gaussians = self._poses.of(placed), placed.of(placed)
        shows = se3.transforms_differ(
            T_now, T_gaussians, config.motion_min_m, config.motion_min_rad
        )
        return np.array(list(placed), np.int64)[shows].tolist()

    def _motion(self, keyframe: int) -> AnchorMotion:
        """From where its Gaussians are to where the keyframe is."""
        T_map_gaussians = self._map.views.poses[keyframe]
        T_new_old = pose_to_message(self._poses[keyframe] @ se3.inverse(T_map_gaussians))
        return AnchorMotion(keyframe=keyframe, T_new_old=T_new_old)

    # --- messages ---------------------------------------------------------------------------------
    def _message_context(self) -> MessageContext:
        return MessageContext(self._newest[0], self._poses.version, self._semantics.names)

    def _view(self, keyframe: Keyframe) -> MapRendering:
        views, k = self._map.views, keyframe.keyframe
        rendering = self._map.render_keyframe(k, contributions=self._semantics.is_used)
        return MapRendering(
            stamp_ns=keyframe.stamp_ns,
            keyframe=keyframe.keyframe,
            version=self._publisher.version,
            graph_version=self._poses.version,
            camera=keyframe.camera,
            T_map_camera=pose_to_message(views.poses[k]),
            color=Array.of(to_bytes(views.exposures[k].applied(rendering.color))),
            depth_m=Array.of(rendering.median_depth_m),
            opacity=Array.of(to_bytes(rendering.opacity)),
        )

    def on_restored(self) -> Iterator[Output]:
        """The whole map: followers may have missed deltas, and late joiners find nothing else."""
        if self._map.size():
            yield from self._publisher.publish_snapshot(self._message_context())
            yield from self._objects()

    def on_stop(self) -> Iterator[Output]:
        """The whole map, so that whoever listens ends with it."""
        if self._map.size():
            self._repair.at_end()
            self._semantics.refresh()
            yield from self._publisher.publish_snapshot(self._message_context())
            yield from self._objects()

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """The map every few keyframes: between, the same object as before."""
        newest = self._newest[1]
        saved = self._checkpoint["newest"][1] if self._checkpoint else None
        is_due = saved is None or newest - saved >= self.config.checkpoint_keyframes
        if newest >= 0 and is_due:
            self._put_away()
        return {"map": self._checkpoint} if self._checkpoint else {}

    def checkpoint(self) -> dict[str, Any]:
        """With the map as it is now."""
        self._checkpoint = {}
        return self.snapshot()

    def on_saved(self) -> None:
        self._map.saved()

    def _put_away(self) -> None:
        self._checkpoint = {
            "newest": self._newest,
            "map": self._map.snapshot(),
            "semantics": self._semantics.snapshot(),
            "poses": self._poses.snapshot(),
            "links": self._links.snapshot(),
            "told": self._publisher.snapshot(),
            **self._repair.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        saved = state["map"]
        stamp_ns, keyframe = saved["newest"]
        self._newest = (int(stamp_ns), int(keyframe))
        self._map.restore(saved["map"])
        self._semantics.restore(saved["semantics"])
        self._poses.restore(saved["poses"])
        self._links.restore(saved["links"])
        self._publisher.restore(saved["told"])
        self._repair.restore(saved)

    def metrics(self) -> dict[str, float]:
        return {
            "keyframes": len(self._poses),
            "keyframes_repeated": self._repeated,
            **self._repair.metrics(),
            **self._map.metrics(),
            **self._semantics.metrics(),
        }


def to_bytes(image: np.ndarray) -> np.ndarray:
    """0..1 float to 0..255 uint8."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
