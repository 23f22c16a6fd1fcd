"""Keyframe poses that agree with every measurement.                       actors/optimizer.py

in   keyframe/new          Keyframe             Lossless(8)   a missing link would break the chain
in   keyframe/refinement   KeyframeRefinement   Lossless(8)   the better measurement
out  graph/correction   Correction

gtsam holds the GIL during every call: by default this actor runs in a process of its own.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import T_map_segment
from ldo_service.graph.keyframe_graph import KeyframeGraph, KeyframeGraphConfig
from ldo_service.runtime import Actor, In, Lossless, Out
from ldo_service.schemas import Correction, Keyframe, KeyframeRefinement, MeasuredPose
from ldo_service.schemas.topics import GRAPH_CORRECTION, KEYFRAME_NEW, KEYFRAME_REFINEMENT
from ldo_service.wire import correction_message, measured_of, measurements_of, transform

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OptimizerConfig:
    graph: KeyframeGraphConfig = field(default_factory=KeyframeGraphConfig)


class Optimizer(Actor):
    """The one owner of keyframe poses in the map, and of which segments are joined."""

    name = "optimizer"
    inputs = (In(KEYFRAME_NEW, Lossless(8)), In(KEYFRAME_REFINEMENT, Lossless(8)))
    outputs = (Out(GRAPH_CORRECTION),)

    def __init__(self, config: OptimizerConfig | None = None) -> None:
        super().__init__()
        self.config = config or OptimizerConfig()
        self._graph = KeyframeGraph(self.config.graph)
        self._version = 0
        self._newest: dict[int, tuple[int, np.ndarray]] = {}  # by segment: id and T_odom_keyframe
        self._first: dict[int, int] = {}  # keyframe of each segment
        self._early: dict[tuple[int, int], MeasuredPose] = {}  # came before their keyframe
        self._waiting_number = 0  # of the last refinement that came
        self._refinements = 0  # number of the last one that all poses agree with
        self._repeated = self._bridged = self._refined = 0
        self._saved: dict[str, Any] = {}

    def handle(self, message: Keyframe | KeyframeRefinement) -> Iterator[Correction]:
        if isinstance(message, KeyframeRefinement):
            self._refine(message.poses)
            self._waiting_number = message.number
        elif message.keyframe in self._graph:
            self._repeated += 1  # sent again after a restart
            return
        else:
            self._add(message)
            self._refine(())
        self._version += 1
        if not self._early:
            self._refinements = self._waiting_number
        yield correction_message(
            message.stamp_ns,
            self._version,
            self._graph.poses(),
            self._refinements,
            self._joined(),
        )

    def _refine(self, poses: tuple[MeasuredPose, ...]) -> None:
        """Replace measurements; those of a keyframe that is still under way wait for it."""
        asked = self._early | {(p.reference, p.keyframe): p for p in poses}
        known = {pair: p for pair, p in asked.items() if set(pair) <= self._graph.keyframes}
        newest = max(self._graph.keyframes, default=-1)
        self._early = {pair: p for pair, p in asked.items() if p.keyframe > newest}
        if known:
            self._refined += len(known)
            self._graph.replace([measured_of(pose) for pose in known.values()])

    def _add(self, message: Keyframe) -> None:
        T_odom_keyframe = transform(message.T_odom_keyframe)
        newest = self._newest.get(message.segment)
        known = [m for m in measurements_of(message) if m.a in self._graph]
        if newest is None:
            self._begin(message, T_odom_keyframe)
        elif known:
            self._graph.add(*known)
        else:
            self._bridge(newest, message.keyframe, T_odom_keyframe)
        self._newest[message.segment] = (message.keyframe, T_odom_keyframe)
        for pose in message.joins:
            self._join(pose)

    def _begin(self, message: Keyframe, T_odom_keyframe: np.ndarray) -> None:
        """The first keyframe of a segment; where it is among the others, nobody knows yet."""
        self._first[message.segment] = message.keyframe
        T_map_keyframe = T_map_segment(message.segment) @ T_odom_keyframe
        self._graph.add_first(message.keyframe, T_map_keyframe)

    def _bridge(
        self, newest: tuple[int, np.ndarray], keyframe: int, T_odom_keyframe: np.ndarray
    ) -> None:
        """Nothing that it was measured from was received: odometry from the newest stands in."""
        self._bridged += 1
        known, T_odom_known = newest
        log.warning("keyframe %d: its reference is missing, joined to %d", keyframe, known)
        T_known_keyframe = se3.inverse(T_odom_known) @ T_odom_keyframe
        self._graph.add(self._graph.missed_odometry(known, keyframe, T_known_keyframe))

    def _join(self, pose: MeasuredPose) -> None:
        """One keyframe in another, of the same segment or not."""
        if pose.reference not in self._graph:
            log.warning("keyframe %d joins %d, which is missing", pose.keyframe, pose.reference)
            return
        before = self._joined()
        self._graph.connect(measured_of(pose))
        for segment, older in self._joined().items() - before.items():
            log.info("segment %d is placed in %d now", segment, older)

    def _joined(self) -> dict[int, int]:
        """Segments that are placed in an older one, and in which."""
        segments = {first: segment for segment, first in self._first.items()}
        placed = {s: segments[self._graph.first_of(first)] for s, first in self._first.items()}
        return {segment: older for segment, older in placed.items() if older < segment}

    def snapshot(self) -> dict[str, Any]:
        if self._saved.get("version") != self._version:
            self._saved = {
                "version": self._version,
                "segments": [
                    (segment, self._first[segment], *newest)
                    for segment, newest in self._newest.items()
                ],
                "refinements": (self._waiting_number, self._refinements),
                "graph": self._graph.snapshot(),
                "early": [msgspec.msgpack.encode(pose) for pose in self._early.values()],
            }
        return {"graph": self._saved}

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        saved = state["graph"]
        self._version = saved["version"] + 1  # one more may have been sent and not saved
        self._first = {segment: first for segment, first, *_ in saved["segments"]}
        self._newest = {segment: (newest, T) for segment, _, newest, T in saved["segments"]}
        self._waiting_number, self._refinements = saved["refinements"]
        self._graph.restore(saved["graph"])
        early = [msgspec.msgpack.decode(body, type=MeasuredPose) for body in saved["early"]]
        self._early = {(pose.reference, pose.keyframe): pose for pose in early}

    def facts(self) -> dict[str, float]:
        return {
            "keyframes": len(self._graph),
            "optimizations": self._version,
            "keyframes_repeated": self._repeated,
            "keyframes_bridged": self._bridged,
            "keyframes_refined": self._refined,
            "segments_apart": len(self._first) - len(self._joined()),
        }
