"""Poses of the camera and of the keyframes of a running service."""

import numpy as np

from ldo_service.conversions.poses import keyframe_poses_from_correction, pose_from_message
from ldo_service.geometry import se3
from ldo_service.schemas import GraphCorrection, TrackedPose

NOWHERE = np.full(3, np.nan)


class LiveKeyframes:
    """Poses T_map_keyframe of the keyframes, [4, 4], by id.

    A pose-graph correction contains all keyframes that existed when it was computed. Newer
    keyframes keep their poses relative to their reference keyframes.
    """

    def __init__(self) -> None:
        self.T_map: dict[int, np.ndarray] = {}
        # Reference and T_reference_keyframe of the keyframes newer than the last correction, by id.
        self._newer: dict[int, tuple[int | None, np.ndarray]] = {}

    def add(self, pose: TrackedPose, T_map_camera: np.ndarray) -> None:
        """Add a frame that became a keyframe, with its pose [4, 4] as published."""
        assert pose.keyframe is not None
        self.T_map = {**self.T_map, pose.keyframe: T_map_camera}
        self._newer[pose.keyframe] = pose.reference, pose_from_message(pose.T_reference_camera)

    def correct(self, correction: GraphCorrection) -> None:
        """Apply a pose-graph correction.

        Keyframes that are newer than the correction move with their reference keyframes.
        """
        T_map = keyframe_poses_from_correction(correction)
        newest = max(T_map, default=-1)
        self._newer = {k: link for k, link in self._newer.items() if k > newest}
        for keyframe, (reference, T_reference_keyframe) in sorted(self._newer.items()):
            if reference in T_map:
                T_map[keyframe] = T_map[reference] @ T_reference_keyframe
            else:
                T_map[keyframe] = self.T_map[keyframe]
        self.T_map = T_map


class LivePath:
    """Positions of the camera, as published and after pose-graph corrections.

    A corrected position moves with the reference keyframe of its frame. When there are more than
    `most` positions, every second one is dropped. From then on, new positions are stored half as
    often.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._every = 1
        self._heard = 0
        self._online: list[np.ndarray] = []
        self._references: list[int] = []  # Reference keyframe of each frame; -1 if it has none.
        # Position of the camera in the frame of the reference keyframe, [3], meters.
        self._p_reference: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._online)

    def add(self, pose: TrackedPose, T_map_camera: np.ndarray) -> None:
        """Add the camera position of a frame whose tracking status is not LOST.

        Args:
            pose: Tracked pose of the frame.
            T_map_camera: Published pose of the camera, [4, 4]. If the frame is in a submap other
                than 0, this pose is not in the map frame. Its position is then stored as unknown.
        """
        self._heard += 1
        if self._heard % self._every:
            return
        self._online.append(NOWHERE if pose.submap else T_map_camera[:3, 3])
        self._references.append(-1 if pose.reference is None else pose.reference)
        self._p_reference.append(np.array(pose.T_reference_camera.translation))
        if len(self) > self._most:
            for values in (self._online, self._references, self._p_reference):
                del values[::2]
            self._every *= 2

    def online(self) -> np.ndarray:
        """Return the published positions, [K, 3]; NaN where they are unknown."""
        return np.array(self._online).reshape(-1, 3)

    def final(self, T_map_keyframe: dict[int, np.ndarray]) -> np.ndarray:
        """Return the corrected positions of all frames with a known reference keyframe.

        The camera position in the frame of the reference keyframe is transformed to the map frame.
        The result has the shape [K, 3], in meters, in order of time.

        Args:
            T_map_keyframe: Pose of each keyframe, [4, 4], by id.
        """
        ids = np.array(sorted(T_map_keyframe), np.int64)
        references = np.array(self._references, np.int64)
        known = np.isin(references, ids)
        T_map = np.array([T_map_keyframe[k] for k in ids]).reshape(-1, 4, 4)
        T = T_map[np.searchsorted(ids, references[known])]
        p = np.array(self._p_reference).reshape(-1, 3)[known]
        return (T[:, :3, :3] @ p[..., None])[..., 0] + T[:, :3, 3]


def T_map_camera_of(pose: TrackedPose) -> np.ndarray:
    """Return T_map_camera [4, 4] of a tracked pose."""
    return se3.orthonormalize(
        pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
    )
