"""Optimization of the pose graph of keyframes and objects.

Topics, their messages, the delivery policy of each input (with its queue length), and notes:

in   keyframe/measurements  KeyframeMeasurements  Backlog(64)   poses relative to earlier keyframes
in   keyframe/refinement    KeyframeRefinement    Backlog(64)   better relative-pose measurements
in   loop/closure           LoopClosure           Backlog(64)   rare, and costly to detect
in   object/observation     ObjectObservation     Backlog(64)   every observation adds information
out  graph/correction       GraphCorrection                     all keyframe poses and landmarks

gtsam holds the GIL during every call, so this actor runs in a process of its own by default. No
other actor waits for the optimizer. While it is busy, the producers of its inputs keep the messages
on disk.
"""

import logging
from collections.abc import Iterator
from dataclasses import astuple, dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from ldo_service.conversions.frames import camera_from_message
from ldo_service.conversions.landmarks import landmark_observation_from_message
from ldo_service.conversions.objects import landmark_to_message
from ldo_service.conversions.poses import (
    correction_to_message,
    measurements_from_message,
    pose_from_message,
    relative_pose_from_message,
)
from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3
from ldo_service.geometry.keyframe_poses import T_map_submap
from ldo_service.pose_graph.landmarks import MAX_CLASSES, ObjectLandmarkConfig, ObjectLandmarks
from ldo_service.pose_graph.pose_graph import PoseGraph
from ldo_service.pose_graph.pose_graph_config import PoseGraphConfig
from ldo_service.runtime import Actor, Backlog, In, Out
from ldo_service.schemas import (
    GraphCorrection,
    GraphLandmark,
    KeyframeMeasurements,
    KeyframeRefinement,
    LoopClosure,
    MeasuredPose,
    ObjectObservation,
    decode,
    encode,
)
from ldo_service.schemas.topics import (
    GRAPH_CORRECTION,
    KEYFRAME_MEASUREMENTS,
    KEYFRAME_REFINEMENT,
    LOOP_CLOSURE,
    OBJECT_OBSERVATION,
)

log = logging.getLogger(__name__)

# Maximum number of messages of each input in memory. Messages are small, so the value can be large,
# and a backlog is sent from disk in few steps.
WINDOW = 64


@dataclass(frozen=True, slots=True)
class OptimizerConfig:
    """Parameters of the pose-graph optimizer."""

    graph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    landmarks: ObjectLandmarkConfig = field(default_factory=ObjectLandmarkConfig)
    uses_objects: bool = True  # False optimizes poses alone, to measure the benefit of landmarks.
    # Maximum number of closures that are stored until their keyframes arrive. The same maximum
    # applies to observations.
    max_early: int = 512
    # Number of newest keyframes whose intrinsics are kept, for observations that arrive late.
    cameras: int = 64

    def __post_init__(self) -> None:
        if min(self.max_early, self.cameras) < 1:
            raise ConfigError(named(self, "max_early", "cameras") + " must be at least 1.")


class Optimizer(Actor):
    """Actor that optimizes the pose graph.

    No other actor computes keyframe poses in the map or decides which submaps are merged.
    """

    name = "optimizer"
    inputs = (
        In(KEYFRAME_MEASUREMENTS, Backlog(WINDOW)),
        In(KEYFRAME_REFINEMENT, Backlog(WINDOW)),
        In(LOOP_CLOSURE, Backlog(WINDOW)),
        In(OBJECT_OBSERVATION, Backlog(WINDOW)),
    )
    outputs = (Out(GRAPH_CORRECTION),)
    is_backend = True

    def __init__(self, config: OptimizerConfig | None = None) -> None:
        super().__init__()
        self.config = config or OptimizerConfig()
        self._graph = PoseGraph(self.config.graph)
        self._landmarks = ObjectLandmarks(self.config.landmarks, self.config.graph.noise)
        self._classes: list[str] = ["other"]  # Class names in the order of their first observation.
        self._cameras: dict[int, Camera] = {}  # Intrinsics of the newest keyframes by id.
        self._version = 0
        self._stamp_ns = 0  # Stamp of the newest message.
        # Id and T_odom_keyframe of the newest keyframe, by submap.
        self._newest: dict[int, tuple[int, np.ndarray]] = {}
        self._first: dict[int, int] = {}  # First keyframe of each submap.
        # Measurements that arrived before their keyframe, by ids of their two keyframes.
        self._early: dict[tuple[int, int], MeasuredPose] = {}
        self._early_closures: list[LoopClosure] = []
        self._early_observations: list[ObjectObservation] = []
        self._waiting_number = 0  # Number of the last received refinement.
        self._refinements = 0  # Number of the last refinement that the poses fully include.
        self._repeated = self._bridged = self._refined = self._too_early = self._too_late = 0

    def handle(
        self, message: KeyframeMeasurements | KeyframeRefinement | LoopClosure | ObjectObservation
    ) -> Iterator[GraphCorrection]:
        """Yield a correction if the message changes the pose graph."""
        self._stamp_ns = max(self._stamp_ns, message.stamp_ns)
        match message:
            case ObjectObservation() if not self.config.uses_objects:
                return
            case ObjectObservation():
                self._early_observations.append(message)
                self._observe()
                return
            case LoopClosure():
                self._early_closures.append(message)
                if not self._close():
                    return
            case KeyframeRefinement():
                self._refine(message.poses)
                self._waiting_number = message.number
            case KeyframeMeasurements() if message.keyframe in self._graph:
                self._repeated += 1  # Sent again after a restart.
                return
            case KeyframeMeasurements():
                self._take(message)
        yield self._correction(message.stamp_ns)

    def on_restored(self) -> Iterator[GraphCorrection]:
        """Publish the current correction, because the previous process may not have sent it."""
        if len(self._graph):
            yield self._correction(self._stamp_ns)

    def _correction(self, stamp_ns: int) -> GraphCorrection:
        self._version += 1
        if not self._early:
            self._refinements = self._waiting_number
        closures = self._graph.closures
        return correction_to_message(
            stamp_ns,
            self._version,
            self._graph.poses(),
            self._refinements,
            self._merged_submaps(),
            closures=closures.accepted,
            rejected=sorted({*closures.rejected, *closures.removed}),
            landmarks=self._placed_landmarks(),
        )

    # --- keyframes --------------------------------------------------------------------------------
    def _take(self, message: KeyframeMeasurements) -> None:
        """Add a keyframe to the pose graph, then process the messages that waited for it."""
        if self._landmarks.needs_update():
            self._landmarks.update_graph(self._graph)
        self._add(message)
        self._cameras[message.keyframe] = camera_from_message(message.camera)
        while len(self._cameras) > self.config.cameras:
            del self._cameras[next(iter(self._cameras))]
        self._refine(())
        self._close()
        self._observe()

    def _refine(self, poses: tuple[MeasuredPose, ...]) -> None:
        """Replace relative-pose measurements in the pose graph.

        Measurements of a keyframe that has not arrived are stored until it arrives.
        """
        pending = self._early | {(p.reference, p.keyframe): p for p in poses}
        known = {pair: p for pair, p in pending.items() if set(pair) <= self._graph.keyframes}
        newest = max(self._graph.keyframes, default=-1)
        self._early = {pair: p for pair, p in pending.items() if p.keyframe > newest}
        if known:
            self._refined += len(known)
            self._graph.replace([relative_pose_from_message(pose) for pose in known.values()])

    def _add(self, message: KeyframeMeasurements) -> None:
        T_odom_keyframe = pose_from_message(message.T_odom_keyframe)
        newest = self._newest.get(message.submap)
        known = [m for m in measurements_from_message(message) if m.a in self._graph]
        if newest is None:
            # The pose of a new submap relative to the other submaps is unknown.
            self._first[message.submap] = message.keyframe
            self._graph.add_first(message.keyframe, T_map_submap(message.submap) @ T_odom_keyframe)
        elif known:
            self._graph.add(*known)
        else:
            self._add_odometry_fallback(newest, message.keyframe, T_odom_keyframe)
        self._newest[message.submap] = (message.keyframe, T_odom_keyframe)
        for pose in message.submap_measurements:
            self._merge_submap(pose)

    def _add_odometry_fallback(
        self, newest: tuple[int, np.ndarray], keyframe: int, T_odom_keyframe: np.ndarray
    ) -> None:
        """Connect a keyframe to its submap by odometry.

        The keyframe's own measurements cannot be used, because none of their reference keyframes
        was received.

        Args:
            newest: Id and T_odom_keyframe of the newest keyframe of the submap.
            keyframe: Id of the new keyframe.
            T_odom_keyframe: Pose of the new keyframe, [4, 4].
        """
        self._bridged += 1
        known, T_odom_known = newest
        log.warning(
            "optimizer: reference keyframe of keyframe %d was never received; using odometry from "
            "keyframe %d instead. No action needed; many such warnings mean lost messages (see "
            'input gaps in "ldo doctor").',
            keyframe,
            known,
        )
        T_known_keyframe = se3.inverse(T_odom_known) @ T_odom_keyframe
        self._graph.add(self._graph.odometry_fallback(known, keyframe, T_known_keyframe))

    def _merge_submap(self, pose: MeasuredPose) -> None:
        """Add the relative pose between keyframes of two submaps, which merges the submaps.

        If they are merged already, the relative pose is checked like a loop closure.
        """
        if pose.reference not in self._graph:
            log.warning(
                "optimizer: keyframe %d has a submap measurement to unknown keyframe %d; "
                "measurement discarded. No action needed.",
                pose.keyframe,
                pose.reference,
            )
            return
        before = self._merged_submaps()
        self._graph.add_loop_closure(relative_pose_from_message(pose))
        self._log_merged(before)

    def _log_merged(self, before: dict[int, int]) -> None:
        for submap, older in self._merged_submaps().items() - before.items():
            log.info("optimizer: submap %d merged into submap %d", submap, older)

    # --- loops and objects ------------------------------------------------------------------------
    def _close(self) -> bool:
        """Check the stored loop closures between known keyframes; return whether there were any."""
        known = [c for c in self._early_closures if self._is_known(c.pose)]
        later = [c for c in self._early_closures if not self._is_known(c.pose)]
        self._early_closures = self._keep_newest(later)
        for closure in known:
            self._check_closure(closure)
        return bool(known)

    def _is_known(self, pose: MeasuredPose) -> bool:
        return pose.reference in self._graph and pose.keyframe in self._graph

    def _check_closure(self, closure: LoopClosure) -> None:
        before = self._merged_submaps()
        weight = self._landmarks.weight(closure.entropy)
        measured = relative_pose_from_message(closure.pose)
        decision = self._graph.add_loop_closure(
            replace(measured, information=weight * measured.information)
        )
        pair = closure.pose.reference, closure.pose.keyframe
        log.info(
            "optimizer: loop closure %d-%d %s",
            *pair,
            "accepted" if decision.is_accepted else "rejected",
        )
        for reference, keyframe in decision.dropped:
            log.info(
                "optimizer: loop closure %d-%d removed; later closures contradict it",
                reference,
                keyframe,
            )
        self._log_merged(before)

    def _observe(self) -> None:
        """Pass the stored observations in known keyframes on to the landmarks.

        The observations enter the pose graph when a later keyframe is added.
        """
        later = []
        for seen in self._early_observations:
            camera = self._cameras.get(seen.keyframe)
            if camera is not None:
                self._landmarks.observe(
                    landmark_observation_from_message(seen, camera, self._class)
                )
            elif seen.keyframe not in self._graph:
                later.append(seen)
            else:
                self._too_late += 1
        self._early_observations = self._keep_newest(later)

    def _class(self, name: str) -> int:
        """Return the index of a class; 0 (`other`) for a new class beyond `MAX_CLASSES`."""
        if name not in self._classes and len(self._classes) < MAX_CLASSES:
            self._classes.append(name)
        return self._classes.index(name) if name in self._classes else 0

    def _keep_newest(self, waiting: list[Any]) -> list[Any]:
        """Return the newest `max_early` messages; older ones are counted and discarded."""
        excess = max(0, len(waiting) - self.config.max_early)
        self._too_early += excess
        return waiting[excess:]

    def _placed_landmarks(self) -> list[GraphLandmark]:
        known = self._landmarks.known
        return [
            landmark_to_message(k, centroid, known[k].distribution, self._classes)
            for k, centroid in self._graph.landmarks().items()
        ]

    # --- submaps ---------------------------------------------------------------------------------
    def _merged_submaps(self) -> dict[int, int]:
        """Return, for each merged submap, the older submap that it was merged into."""
        submaps = {first: submap for submap, first in self._first.items()}
        placed = {s: submaps[self._graph.component_root(first)] for s, first in self._first.items()}
        return {submap: older for submap, older in placed.items() if older < submap}

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """Return the state in three parts: `graph`, `landmarks` and `rest`.

        `graph` is the pose graph at the last rebuild of its solver. Snapshots share this object
        until the next rebuild, some keyframes later. `rest` has the changes of the pose graph since
        the last rebuild, and all other state.
        """
        graph = self._graph.snapshot()
        rest = {
            "version": self._version,
            "stamp_ns": self._stamp_ns,
            "submaps": [
                (submap, self._first[submap], *newest) for submap, newest in self._newest.items()
            ],
            "refinements": (self._waiting_number, self._refinements),
            "changes": graph["changes"],
            "early": [msgspec.msgpack.encode(pose) for pose in self._early.values()],
            "closures": [encode(closure) for closure in self._early_closures],
            "observations": [encode(seen) for seen in self._early_observations],
            "cameras": [(k, astuple(camera)) for k, camera in self._cameras.items()],
            "classes": list(self._classes),
        }
        landmarks = self._landmarks.snapshot()
        rest |= {"waiting": landmarks["waiting"], "skipped": landmarks["skipped"]}
        return {"graph": graph["base"], "landmarks": landmarks["known"], "rest": rest}

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        """Continue from a snapshot."""
        saved = state["rest"]
        self._version, self._stamp_ns = saved["version"], saved["stamp_ns"]
        self._first = {submap: first for submap, first, *_ in saved["submaps"]}
        self._newest = {submap: (newest, T) for submap, _, newest, T in saved["submaps"]}
        self._waiting_number, self._refinements = saved["refinements"]
        self._graph.restore({"base": state["graph"], "changes": saved["changes"]})
        self._landmarks.restore({**saved, "known": state["landmarks"]})
        early = [msgspec.msgpack.decode(body, type=MeasuredPose) for body in saved["early"]]
        self._early = {(pose.reference, pose.keyframe): pose for pose in early}
        self._early_closures = [decode(body, LoopClosure) for body in saved["closures"]]
        self._early_observations = [decode(b, ObjectObservation) for b in saved["observations"]]
        self._cameras = {k: Camera(*numbers) for k, numbers in saved["cameras"]}
        self._classes = list(saved["classes"])

    def metrics(self) -> dict[str, float]:
        """Return counters of the pose graph, loop closures, landmarks and submaps."""
        graph = self._graph
        return {
            "keyframes": len(graph),
            "graph_variables": graph.variables,
            "optimizations": graph.solved_times,
            "optimizations_skipped": self._landmarks.skipped,
            "closures": len(graph.closures.accepted),
            "closures_rejected": len(graph.closures.rejected),
            "closures_removed": len(graph.closures.removed),
            "landmarks": len(graph.landmarks()),
            "keyframes_repeated": self._repeated,
            "keyframes_odometry_fallback": self._bridged,
            "keyframes_refined": self._refined,
            "early_messages_discarded": self._too_early,
            # Observations in keyframes whose intrinsics were no longer kept.
            "late_observations_discarded": self._too_late,
            "submaps_unmerged": len(self._first) - len(self._merged_submaps()),
        }
