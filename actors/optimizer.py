"""Keyframe poses that agree with every measurement.                       actors/optimizer.py

in   keyframe/new       Keyframe     Lossless(8)   a missing link would break the chain
out  graph/correction   Correction

gtsam holds the GIL during every call: by default this actor runs in a process of its own.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ldo_service.geometry import se3
from ldo_service.graph.keyframe_graph import KeyframeGraph, KeyframeGraphConfig, RelativePose
from ldo_service.runtime import Actor, In, Lossless, Out
from ldo_service.schemas import Correction, Keyframe
from ldo_service.schemas.topics import GRAPH_CORRECTION, KEYFRAME_NEW
from ldo_service.wire import correction_message, transform

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OptimizerConfig:
    graph: KeyframeGraphConfig = field(default_factory=KeyframeGraphConfig)


class Optimizer(Actor):
    """The one owner of keyframe poses in the map."""

    name = "optimizer"
    inputs = (In(KEYFRAME_NEW, Lossless(8)),)
    outputs = (Out(GRAPH_CORRECTION),)

    def __init__(self, config: OptimizerConfig | None = None) -> None:
        super().__init__()
        self.config = config or OptimizerConfig()
        self._graph = KeyframeGraph(self.config.graph)
        self._version = 0
        self._T_odom_newest = np.eye(4)
        self._repeated = self._bridged = 0
        self._saved: dict[str, Any] = {}

    def handle(self, message: Keyframe) -> Iterator[Correction]:
        if message.keyframe in self._graph:
            self._repeated += 1  # sent again after a restart
            return
        self._add(message)
        self._version += 1
        yield correction_message(message.stamp_ns, self._version, self._graph.poses())

    def _add(self, message: Keyframe) -> None:
        T_odom_keyframe = transform(message.T_odom_keyframe)
        newest = self._graph.newest
        if newest is None:
            self._graph.add_first(message.keyframe, T_odom_keyframe)
        elif message.reference is not None and message.reference in self._graph:
            information = np.array(message.information).reshape(6, 6)
            T_reference_keyframe = transform(message.T_reference_keyframe)
            self._graph.add(
                RelativePose(message.reference, message.keyframe, T_reference_keyframe, information)
            )
        else:
            self._bridge(newest, message.keyframe, T_odom_keyframe)
        self._T_odom_newest = T_odom_keyframe

    def _bridge(self, newest: int, keyframe: int, T_odom_keyframe: np.ndarray) -> None:
        """The reference was never received: odometry from the newest keyframe stands in."""
        self._bridged += 1
        log.warning("keyframe %d: its reference is missing, joined to %d", keyframe, newest)
        T_newest_keyframe = se3.inverse(self._T_odom_newest) @ T_odom_keyframe
        self._graph.add(self._graph.missed_odometry(newest, keyframe, T_newest_keyframe))

    def snapshot(self) -> dict[str, Any]:
        if self._saved.get("version") != self._version:
            self._saved = {
                "version": self._version,
                "T_odom_newest": self._T_odom_newest,
                "graph": self._graph.snapshot(),
            }
        return {"graph": self._saved}

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        saved = state["graph"]
        self._version = saved["version"] + 1  # one more may have been sent and not saved
        self._T_odom_newest = saved["T_odom_newest"]
        self._graph.restore(saved["graph"])

    def facts(self) -> dict[str, float]:
        return {
            "keyframes": len(self._graph),
            "optimizations": self._version,
            "keyframes_repeated": self._repeated,
            "keyframes_bridged": self._bridged,
        }
