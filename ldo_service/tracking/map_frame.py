"""Pose of the odometry frame in the map, by keyframe. Conventions: `ldo_service.geometry`.

Poses in odometry are continuous. The pose-graph optimizer moves keyframes in the map, so T_map_odom
may jump (REP-105). Each keyframe has its own T_map_odom = T_map_keyframe * T_keyframe_odom. A frame
uses the T_map_odom of its reference keyframe, so that the frame moves with that keyframe.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses

from .tracking_result import TrackedFrame

# Number of newest keyframes whose poses are stored: four credit windows of the topic keyframe/new.
# The pose-graph optimizer never lags behind by more keyframes, because backpressure slows the
# tracker first.
RECENT_KEYFRAMES = 32


@dataclass(frozen=True, slots=True)
class MapCorrection:
    """Keyframe poses of one version of the pose graph, decoded on demand."""

    version: int  # Version of the pose graph.
    roots: Mapping[int, int]  # Oldest submap that each submap is merged with, by submap.
    # Function that returns T_map_keyframe [4, 4] by id. Its argument lists the ids to return,
    # or is None for all keyframes. The newest keyframe is always returned too.
    read_poses: Callable[[Iterable[int] | None], Mapping[int, np.ndarray]]


class MapFrame:
    """Pose of the odometry frame in the map, by keyframe.

    Each keyframe gives such a pose, as the product of its pose in the map and the inverse of its
    pose in odometry. This class stores the poses of the last keyframes and of the reference
    keyframe. It reads the poses of older keyframes from the last correction by the pose-graph
    optimizer.
    """

    def __init__(self) -> None:
        self._poses = KeyframePoses()
        self._correction: MapCorrection | None = None
        # Poses of all keyframes in the correction, once they are decoded.
        self._T_map: Mapping[int, np.ndarray] | None = None

    def __contains__(self, keyframe: int | None) -> bool:
        return keyframe is not None and keyframe in self._poses

    @property
    def version(self) -> int:
        """Version of the pose graph that the poses come from; 0 before the first correction."""
        return self._poses.version

    @property
    def T_map_keyframe(self) -> Mapping[int, np.ndarray]:
        """Poses [4, 4] of all keyframes in the last correction, by id."""
        if self._T_map is None:
            self._T_map = {} if self._correction is None else self._correction.read_poses(None)
        return self._T_map

    def correct(self, correction: MapCorrection) -> bool:
        """Apply a correction if it is newer than the last one, and return whether it was newer."""
        is_newer = correction.version > self._poses.version
        if is_newer:
            self._remember(correction)
            self._poses.correct(correction.version, correction.read_poses(self._poses))
        return is_newer

    def T_map_odom(self, reference: int | None) -> np.ndarray:
        """Return T_map_odom [4, 4] of a stored keyframe; the identity if `reference` is None."""
        return np.eye(4) if reference is None else self._poses.T_map_odom(reference)

    def T_map_camera(self, tracked: TrackedFrame) -> np.ndarray | None:
        """Return the pose [4, 4] of a frame in the map, or None if its reference is not stored."""
        if tracked.reference is None or tracked.reference not in self._poses:
            return None
        return self._poses[tracked.reference] @ tracked.T_reference_camera

    def root_of(self, submap: int) -> int:
        """Return the oldest submap that the pose graph has merged with `submap`."""
        return submap if self._correction is None else self._correction.roots.get(submap, submap)

    def add_keyframe(
        self, keyframe: int, tracked: TrackedFrame, next_reference: int | None
    ) -> None:
        """Add the keyframe that was made from a frame.

        Args:
            keyframe: Id of the new keyframe.
            tracked: The frame.
            next_reference: Id of the keyframe that the next frame is aligned to, or None. The pose
                of this keyframe stays stored even if the keyframe is not recent.
        """
        self._poses.add(
            keyframe,
            tracked.reference,
            tracked.T_reference_camera,
            tracked.T_odom_camera,
            tracked.submap,
        )
        self._keep(keyframe, tracked.reference, next_reference)

    def place_reference(self, tracked: TrackedFrame) -> None:
        """Store the pose of a frame's reference, a known keyframe whose pose is no longer stored.

        The pose comes from the last correction, or from odometry if the correction lacks the
        keyframe.
        """
        keyframe = tracked.reference
        if keyframe is None:
            return
        T_odom_keyframe = tracked.T_odom_camera @ se3.inverse(tracked.T_reference_camera)
        newest = max(self._poses, default=keyframe)
        self._poses.add(keyframe, None, np.eye(4), T_odom_keyframe, tracked.submap)
        T_map_keyframe = self.T_map_keyframe.get(keyframe)
        if T_map_keyframe is not None:
            self._poses.place(keyframe, T_map_keyframe)
        self._keep(newest, keyframe)

    def snapshot(self) -> dict[str, Any]:
        """Return the stored poses; the last correction itself is not part of them."""
        return self._poses.snapshot()

    def restore(self, state: Mapping[str, Any], correction: MapCorrection | None) -> None:
        """Continue from a snapshot and the last correction before the snapshot."""
        self._poses.restore(state)
        self._remember(correction)

    def _remember(self, correction: MapCorrection | None) -> None:
        self._correction, self._T_map = correction, None

    def _keep(self, newest: int, *references: int | None) -> None:
        """Drop all keyframes except for the references and the last `RECENT_KEYFRAMES`.

        The last keyframes are kept because the last correction may not contain them yet.
        """
        self._poses.keep_only(self._needed(newest, references))

    def _needed(self, newest: int, references: tuple[int | None, ...]) -> Iterator[int]:
        return (k for k in self._poses if k > newest - RECENT_KEYFRAMES or k in references)
