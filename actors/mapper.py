"""The map of Gaussians.                                                        actors/mapper.py

in   keyframe/new       Keyframe      Lossless(8)   a missing keyframe is a hole in the map
in   graph/correction   Correction    Latest(1)     a versioned absolute state
out  map/view           ModelView     the map as rendered at the newest keyframe
out  map/delta          MapDelta      what changed
out  map/snapshot       MapSnapshot   the whole of it, in parts, now and then
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.gaussians.insertion import InsertionConfig, insert
from ldo_service.gaussians.model import ROW, GaussianMap
from ldo_service.gaussians.render import render
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.schemas import (
    AnchorMotion,
    Array,
    Correction,
    Gaussians,
    Keyframe,
    MapDelta,
    MapSnapshot,
    ModelView,
)
from ldo_service.schemas.topics import (
    GRAPH_CORRECTION,
    KEYFRAME_NEW,
    MAP_DELTA,
    MAP_SNAPSHOT,
    MAP_VIEW,
)
from ldo_service.wire import (
    camera_message,
    keyframe_poses_of,
    pose_message,
    rgbd_of,
    transform,
)

Output = ModelView | MapDelta | MapSnapshot


# A successor starts from a checkpoint and must not use a version again that followers may hold:
# more than a mapper could use up between two checkpoints.
VERSIONS_IN_A_CHECKPOINT = 1 << 20


@dataclass(frozen=True, slots=True)
class MapperConfig:
    insertion: InsertionConfig = field(default_factory=InsertionConfig)
    threads: int = 0  # of the renderer; 0: all cores but one, which the tracker needs
    snapshot_keyframes: int = 10  # between snapshots on the network
    snapshot_growth: float = 0.25  # and at least this share of new Gaussians: a large map is sent
    # seldom, so that snapshots never cost more than a few times the deltas
    part_gaussians: int = 16_384  # in one message: 1.2 MB, so that none blocks the others long
    checkpoint_keyframes: int = 5  # between saved states; a crash costs at most so many of the map
    motion_min_m: float = 1e-6  # a correction that moves a keyframe less changes no pixel
    motion_min_rad: float = 1e-6

    def __post_init__(self) -> None:
        counts = (self.snapshot_keyframes, self.part_gaussians, self.checkpoint_keyframes)
        if min(counts) < 1 or self.threads < 0 or self.snapshot_growth < 0:
            raise ConfigError(
                f"mapper: counts {counts} must be at least 1, threads {self.threads} and "
                f"snapshot_growth {self.snapshot_growth:g} at least 0."
            )

    def thread_count(self) -> int:
        return self.threads or max(1, (os.cpu_count() or 1) - 1)


class Mapper(Actor):
    """Maps a keyframe at once; corrections move each Gaussian with the keyframe that made it."""

    name = "mapper"
    inputs = (In(KEYFRAME_NEW, Lossless(8)), In(GRAPH_CORRECTION, Latest(1)))
    outputs = (Out(MAP_VIEW), Out(MAP_DELTA), Out(MAP_SNAPSHOT))

    def __init__(self, config: MapperConfig | None = None) -> None:
        super().__init__()
        self.config = config or MapperConfig()
        self._threads = self.config.thread_count()
        self._map = GaussianMap()
        self._poses = KeyframePoses()
        self._applied: dict[int, np.ndarray] = {}  # T_map_keyframe that the Gaussians stand at
        self._newest: tuple[int, int] = (0, -1)  # stamp_ns and id of the newest keyframe
        self._since_snapshot = (
            self.config.snapshot_keyframes
        )  # so that the first keyframe sends one
        self._in_snapshot = 0  # Gaussians in the last one
        self._checkpoint: dict[str, Any] = {}
        self._repeated = 0

    def handle(self, message: Keyframe | Correction) -> Iterator[Output]:
        if isinstance(message, Correction):
            yield from self._correct(message)
        elif message.keyframe in self._poses:
            self._repeated += 1  # sent again after a restart
        else:
            yield from self._insert(message)

    # --- keyframes --------------------------------------------------------------------------------
    def _insert(self, message: Keyframe) -> Iterator[Output]:
        # place it
        T_map_keyframe = self._poses.chain(
            message.keyframe,
            message.reference,
            transform(message.T_reference_keyframe),
            transform(message.T_odom_keyframe),
        )
        self._applied[message.keyframe] = T_map_keyframe
        self._newest = (message.stamp_ns, message.keyframe)
        frame = rgbd_of(message)
        # add what the map does not explain
        since = self._map.version
        ids = insert(
            self._map,
            frame,
            T_map_keyframe,
            message.keyframe,
            self.config.insertion,
            threads=self._threads,
        )
        # tell
        if len(ids):
            newest = slice(len(self._map) - len(ids), None)
            yield self._delta(since, added=self._gaussians(newest))
        yield self._view(frame, T_map_keyframe)
        yield from self._snapshot_when_due()

    # --- corrections ------------------------------------------------------------------------------
    def _correct(self, message: Correction) -> Iterator[MapDelta]:
        """Move Gaussians with their keyframes; subscribers apply the same rounded motions."""
        moved = self._poses.correct(message.graph_version, keyframe_poses_of(message))
        motions = tuple(filter(None, map(self._motion, moved)))
        if motions and len(self._map):
            since = self._map.version
            self._map.move_anchors({m.keyframe: transform(m.T_new_old) for m in motions})
            yield self._delta(since, motions=motions)

    def _motion(self, keyframe: int) -> AnchorMotion | None:
        """From where its Gaussians are to where the keyframe is; None while it is too little, which
        adds up until it is enough."""
        T_new_old = pose_message(self._poses[keyframe] @ se3.inverse(self._applied[keyframe]))
        motion = transform(T_new_old)
        if (
            float(np.linalg.norm(motion[:3, 3])) <= self.config.motion_min_m
            and se3.rotation_angle(motion) <= self.config.motion_min_rad
        ):
            return None
        self._applied[keyframe] = motion @ self._applied[keyframe]
        return AnchorMotion(keyframe=keyframe, T_new_old=T_new_old)

    # --- messages ---------------------------------------------------------------------------------
    def _delta(
        self,
        since: int,
        motions: tuple[AnchorMotion, ...] = (),
        added: Gaussians | None = None,
    ) -> MapDelta:
        return MapDelta(
            stamp_ns=self._newest[0],
            since=since,
            version=self._map.version,
            graph_version=self._poses.version,
            motions=motions,
            removed=Array.of(np.zeros(0, np.int64)),
            changed=NO_GAUSSIANS,
            added=added or NO_GAUSSIANS,
        )

    def _view(self, frame: RgbdFrame, T_map_camera: np.ndarray) -> ModelView:
        T_camera_map = se3.inverse(T_map_camera)
        rendering = render(self._map.rows, frame.camera, T_camera_map, threads=self._threads)
        return ModelView(
            stamp_ns=frame.stamp_ns,
            keyframe=self._newest[1],
            version=self._map.version,
            graph_version=self._poses.version,
            camera=camera_message(frame.camera),
            T_map_camera=pose_message(T_map_camera),
            color=Array.of(to_bytes(rendering.color)),
            depth_m=Array.of(rendering.median_depth_m),
            opacity=Array.of(to_bytes(rendering.opacity)),
        )

    def _snapshot_when_due(self) -> Iterator[MapSnapshot]:
        self._since_snapshot += 1
        grown = len(self._map) - self._in_snapshot
        if (
            self._since_snapshot >= self.config.snapshot_keyframes
            and grown >= self.config.snapshot_growth * self._in_snapshot
        ):
            yield from self._snapshot()

    def _snapshot(self) -> Iterator[MapSnapshot]:
        self._since_snapshot, self._in_snapshot = 0, len(self._map)
        size = self.config.part_gaussians
        starts = range(0, max(len(self._map), 1), size)
        for part, start in enumerate(starts):
            chosen = slice(start, start + size)
            yield MapSnapshot(
                stamp_ns=self._newest[0],
                version=self._map.version,
                graph_version=self._poses.version,
                part=part,
                parts=len(starts),
                gaussians=self._gaussians(chosen),
            )

    def _gaussians(self, chosen: slice) -> Gaussians:
        return Gaussians(
            ids=Array.of(self._map.ids[chosen]),
            params=Array.of(self._map.rows[chosen]),
            anchors=Array.of(self._map.anchors[chosen]),
        )

    def finish(self) -> Iterator[MapSnapshot]:
        """The whole map, so that whoever listens ends with it."""
        if len(self._map):
            yield from self._snapshot()

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

    def _put_away(self) -> None:
        self._checkpoint = {
            "newest": self._newest,
            "map": self._map.snapshot(),
            "poses": self._poses.snapshot(),
            "applied": np.array(list(self._applied.values())).reshape(-1, 4, 4),
        }

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        saved = state["map"]
        stamp_ns, keyframe = saved["newest"]
        self._newest = (int(stamp_ns), int(keyframe))
        self._map = GaussianMap.restore(saved["map"])
        self._map.version += VERSIONS_IN_A_CHECKPOINT
        self._poses.restore(saved["poses"])
        self._applied = dict(zip(self._poses, saved["applied"], strict=True))

    def facts(self) -> dict[str, float]:
        return {
            "gaussians": len(self._map),
            "keyframes": len(self._poses),
            "keyframes_repeated": self._repeated,
        }


NO_GAUSSIANS = Gaussians(
    ids=Array.of(np.zeros(0, np.int64)),
    params=Array.of(np.zeros((0, ROW), np.float32)),
    anchors=Array.of(np.zeros(0, np.int32)),
)


def to_bytes(image: np.ndarray) -> np.ndarray:
    """0..1 float to 0..255 uint8."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
