"""Conversions between messages and internal types: poses, measurements and corrections."""

from collections.abc import Iterable, Mapping
from functools import partial

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.schemas import (
    Array,
    GraphCorrection,
    GraphLandmark,
    Keyframe,
    KeyframeMeasurements,
    MeasuredPose,
    Pose,
)
from ldo_service.tracking.map_frame import MapCorrection


def pose_to_message(T: np.ndarray) -> Pose:
    """Return the message of a pose T [4, 4]."""
    (x, y, z), (qw, qx, qy, qz) = T[:3, 3].tolist(), se3.quaternion(T[:3, :3]).tolist()
    return Pose((x, y, z), (qw, qx, qy, qz))


def pose_from_message(pose: Pose) -> np.ndarray:
    """Return the pose T [4, 4] of a message."""
    return se3.from_quaternion(np.array(pose.translation), np.array(pose.quaternion))


def matrix6_to_message(matrix: np.ndarray) -> tuple[float, ...]:
    """Return the 36 numbers of a matrix [6, 6], row by row."""
    return tuple(np.asarray(matrix, float).ravel().tolist())


def relative_pose_to_message(measured: RelativePose) -> MeasuredPose:
    """Return the message of a relative-pose measurement."""
    return MeasuredPose(
        reference=measured.a,
        keyframe=measured.b,
        T_reference_keyframe=pose_to_message(measured.T_a_b),
        information=matrix6_to_message(measured.information),
    )


def relative_pose_from_message(message: MeasuredPose) -> RelativePose:
    """Return the relative-pose measurement of a message."""
    return RelativePose(
        message.reference,
        message.keyframe,
        pose_from_message(message.T_reference_keyframe),
        np.array(message.information).reshape(6, 6),
    )


def measurements_from_message(keyframe: Keyframe | KeyframeMeasurements) -> list[RelativePose]:
    """Return all relative-pose measurements in the message of a keyframe.

    If the keyframe has a reference keyframe, the measurement relative to it is the first one.
    """
    window = [relative_pose_from_message(pose) for pose in keyframe.window_measurements]
    if keyframe.reference is None:
        return window
    T_reference_keyframe = pose_from_message(keyframe.T_reference_keyframe)
    information = np.array(keyframe.information).reshape(6, 6)
    first = RelativePose(keyframe.reference, keyframe.keyframe, T_reference_keyframe, information)
    return [first, *window]


def correction_to_message(
    stamp_ns: int,
    graph_version: int,
    T_map_keyframe: dict[int, np.ndarray],
    refinements: int = 0,
    merged: Mapping[int, int] | None = None,
    *,
    closures: Iterable[tuple[int, int]] = (),
    rejected: Iterable[tuple[int, int]] = (),
    landmarks: Iterable[GraphLandmark] = (),
) -> GraphCorrection:
    """Return the message of a correction of the pose graph.

    Args:
        stamp_ns: Stamp of the correction.
        graph_version: Version of the pose graph.
        T_map_keyframe: Corrected poses [4, 4] by id of the keyframe.
        refinements: Number of the last `keyframe/refinement` message that the correction includes.
        merged: Maps the id of each merged submap to the id of the oldest submap that it is merged
            with. None if no submap is merged.
        closures: Accepted loop closures, as pairs of keyframes.
        rejected: Rejected loop closures, as pairs of keyframes.
        landmarks: Objects of the pose graph.
    """
    T = np.array(list(T_map_keyframe.values())).reshape(-1, 4, 4)
    rows = np.concatenate([T[:, :3, 3], se3.quaternion(T[:, :3, :3])], axis=1)
    return GraphCorrection(
        stamp_ns=stamp_ns,
        graph_version=graph_version,
        keyframes=Array.of(np.array(list(T_map_keyframe), np.int64)),
        T_map_keyframe=Array.of(rows),
        last_refinement=refinements,
        merged_submaps=tuple(sorted((merged or {}).items())),
        accepted_closures=tuple(closures),
        rejected_closures=tuple(rejected),
        landmarks=tuple(landmarks),
    )


def keyframe_poses_from_correction(
    correction: GraphCorrection, only: Iterable[int] | None = None
) -> dict[int, np.ndarray]:
    """Return T_map_keyframe [4, 4] of the keyframes in a correction, by id.

    Args:
        correction: The message.
        only: Ids of the keyframes to return; the newest keyframe is always returned too. None
            returns all keyframes.
    """
    keyframes = correction.keyframes.numpy()
    rows = correction.T_map_keyframe.numpy()
    if only is not None and len(keyframes):
        chosen = np.isin(keyframes, list(only))
        chosen[-1] = True
        keyframes, rows = keyframes[chosen], rows[chosen]
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = se3.rotation(rows[:, 3:]), rows[:, :3]
    return dict(zip(keyframes.tolist(), T, strict=True))


def map_correction_of(correction: GraphCorrection) -> MapCorrection:
    """Convert a correction message for tracking; its poses are decoded only when they are used."""
    return MapCorrection(
        version=correction.graph_version,
        roots=dict(correction.merged_submaps),
        read_poses=partial(keyframe_poses_from_correction, correction),
    )
