"""Odometry in the map: the map's frame at each keyframe. Conventions: `ldo_service.geometry`.

Odometry is continuous, and the optimizer moves keyframes in the map: T_map_odom takes the jumps
(REP-105). It is read at the keyframe that a frame was aligned to, so that what was tracked against
a keyframe moves with it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses

from .tracking_result import TrackedFrame

RECENT_KEYFRAMES = 32  # Four windows of keyframe/new: the optimizer cannot be further behind.


@dataclass(frozen=True, slots=True)
class MapCorrection:
    """Keyframe poses of one version of the pose graph, decoded when they are asked for."""

    version: int
    roots: Mapping[int, int]  # The oldest submap by each one that was merged with it.
    # T_map_keyframe [4, 4] by id: of all keyframes, or of the given ones and the newest.
    read_poses: Callable[[Iterable[int] | None], Mapping[int, np.ndarray]]


class MapFrame:
    """Odometry frame in the map, by keyframe.

    It keeps the poses of the last keyframes and of the reference keyframe. Older keyframes are
    looked up in the last correction.
    """

    def __init__(self) -> None:
        self._poses = KeyframePoses()
        self._correction: MapCorrection | None = None
        self._T_map: Mapping[int, np.ndarray] | None = None  # Of the correction, once decoded.

    def __contains__(self, keyframe: int | None) -> bool:
        return keyframe is not None and keyframe in self._poses

    @property
    def version(self) -> int:
        """Version of the pose graph that the poses follow; 0 before the first correction."""
        return self._poses.version

    @property
    def T_map_keyframe(self) -> Mapping[int, np.ndarray]:
        """Poses [4, 4] by id, of all keyframes in the last correction."""
        if self._T_map is None:
            self._T_map = {} if self._correction is None else self._correction.read_poses(None)
        return self._T_map

    def correct(self, correction: MapCorrection) -> bool:
        """Follow a correction, and return whether it is newer than the last one."""
        is_newer = correction.version > self._poses.version
        if is_newer:
            self._remember(correction)
            self._poses.correct(correction.version, correction.read_poses(self._poses))
        return is_newer

    def T_map_odom(self, reference: int | None) -> np.ndarray:
        """Return the odometry frame in the map [4, 4], as seen at a keyframe that is kept."""
        return np.eye(4) if reference is None else self._poses.T_map_odom(reference)

    def T_map_camera(self, tracked: TrackedFrame) -> np.ndarray | None:
        """Return the camera in the map [4, 4], or None when its reference is not kept."""
        if tracked.reference is None or tracked.reference not in self._poses:
            return None
        return self._poses[tracked.reference] @ tracked.T_reference_camera

    def root_of(self, submap: int) -> int:
        """Return the oldest submap that the pose graph has merged with a submap."""
        return submap if self._correction is None else self._correction.roots.get(submap, submap)

    def add_keyframe(
        self, keyframe: int, tracked: TrackedFrame, next_reference: int | None
    ) -> None:
        """Place the keyframe that was made of a frame.

        Args:
            keyframe: Id of the new keyframe.
            tracked: The frame.
            next_reference: The keyframe that the next frame is aligned to; it is kept too.
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
        """Place the known keyframe that a frame was aligned to, and that is the next reference.

        The pose is that of the last correction, or that of odometry when the correction lacks it.
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
        """Return the poses that are kept, without the correction."""
        return self._poses.snapshot()

    def restore(self, state: Mapping[str, Any], correction: MapCorrection | None) -> None:
        """Continue from a snapshot and from the last correction before it."""
        self._poses.restore(state)
        self._remember(correction)

    def _remember(self, correction: MapCorrection | None) -> None:
        self._correction, self._T_map = correction, None

    def _keep(self, newest: int, *references: int | None) -> None:
        """Forget all keyframes but references and those that the optimizer may not know yet."""
        self._poses.keep_only(self._needed(newest, references))

    def _needed(self, newest: int, references: tuple[int | None, ...]) -> Iterator[int]:
        return (k for k in self._poses if k > newest - RECENT_KEYFRAMES or k in references)
