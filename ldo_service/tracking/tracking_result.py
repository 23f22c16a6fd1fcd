"""Results of tracking one frame. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from ldo_service.calibration.shutter import FrameMotion
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .alignment import Alignment
from .keyframes import ReferenceKeyframe, Relay, covariance_of
from .shutter import ShutterState
from .submaps import SubmapMeasurement
from .tracking_quality import TrackingStatus


class KeyframeKind(StrEnum):
    """Role of a keyframe in tracking and mapping."""

    FIRST = "first"  # Starts a submap and is measured from no other keyframe.
    REFERENCE = "reference"  # Becomes the reference: the next frames are aligned to this keyframe.
    MAPPING = "mapping"  # The mapper uses it, but it does not become the reference.


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Tracked pose of a frame, and the kind of keyframe that the frame should become.

    While the status is LOST, the pose is the last accepted pose, and `information` is zero.
    """

    status: TrackingStatus
    # Initial guess of the pose: see `PoseHypothesis.pose_source`. "first" for the first frame of a
    # submap; "none" while LOST.
    pose_source: str
    T_odom_camera: np.ndarray  # [4, 4]
    T_reference_camera: np.ndarray = field(default_factory=lambda: np.eye(4))  # [4, 4]
    reference: int | None = None  # Id of the keyframe that the pose refers to; None if none.
    submap: int = 0  # Submap in whose odometry frame T_odom_camera is expressed.
    # [6, 6] for T_reference_camera * exp(xi) with xi = (rotation rad, translation m).
    information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    overlap: float = 0.0  # Visible fraction of the reference's surface.
    inlier_fraction: float = 0.0  # The smaller of the photometric and the geometric fraction.
    intensity_sigma: float = 0.0  # Photometric noise, gray levels.
    depth_noise_scale: float = 0.0  # Geometric noise as a multiple of `DepthNoise`.
    iterations: int = 0  # Iterations of alignment over all pyramid levels.
    # Distance to the farthest other pose that the images support; 0 if there is none. See
    # `PoseHypothesis`.
    hypothesis_spread_rad: float = 0.0
    is_contradictory: bool = False  # True if color and depth contradict each other.
    # Dynamic pixels, which are not mapped, [H, W] bool at the finest pyramid level.
    dynamic_mask: np.ndarray | None = None
    needed_keyframe: KeyframeKind | None = None  # Set for OK frames only.
    should_start_submap: bool = False  # True if LOST for so long that a new submap should start.
    # Measurement that merges two submaps once the frame is a keyframe.
    submap_measurement: SubmapMeasurement | None = None

    @staticmethod
    def of(
        alignment: Alignment,
        T_odom_camera: np.ndarray,
        keyframe: ReferenceKeyframe,
        status: TrackingStatus,
        pose_source: str,
        *,
        needed_keyframe: KeyframeKind | None = None,
        hypothesis_spread_rad: float = 0.0,
        dynamic_mask: np.ndarray | None = None,
    ) -> "TrackedFrame":
        """Return the tracked frame that results from an alignment to a keyframe.

        Args:
            alignment: The alignment of the frame to the keyframe or to its relay.
            T_odom_camera: Pose of the camera in the odometry frame, [4, 4].
            keyframe: The reference keyframe.
            status: Tracking status of the frame.
            pose_source: Name of the initial guess that the alignment started from.
            needed_keyframe: Kind of keyframe that the frame should become; None if it should not
                become one.
            hypothesis_spread_rad: Distance from this pose to the farthest other pose that the
                images support, computed by `image_motion_rad`; 0 if there is no other pose.
            dynamic_mask: Dynamic pixels, [H, W] bool at the finest pyramid level; None if unknown.
        """
        T_reference_camera, information = alignment.T_reference_camera, alignment.information
        if keyframe.relay is not None:
            T_reference_camera, information = keyframe.relay.pose_of(
                T_reference_camera, information
            )
        return TrackedFrame(
            status,
            pose_source,
            T_odom_camera,
            T_reference_camera,
            keyframe.id,
            keyframe.submap,
            information=information,
            overlap=alignment.overlap,
            inlier_fraction=min(alignment.photometric_inliers, alignment.geometric_inliers),
            intensity_sigma=alignment.intensity_sigma,
            depth_noise_scale=alignment.depth_noise_scale,
            iterations=alignment.iterations,
            hypothesis_spread_rad=hypothesis_spread_rad,
            is_contradictory=bool(alignment.contradiction.any()),
            dynamic_mask=dynamic_mask,
            needed_keyframe=needed_keyframe,
        )

    def relay(self) -> Relay:
        """Return this frame as a relay, with its pose relative to its keyframe.

        A relay is a frame to which later frames are aligned, although it is not a keyframe.
        """
        return Relay(self.T_reference_camera, covariance_of(self.information))


@dataclass(frozen=True, slots=True)
class NewKeyframe:
    """Keyframe that was made from a frame."""

    id: int
    kind: KeyframeKind
    submap: int  # Submap that the keyframe was made in, even if merged with an older submap.
    # Measured poses relative to earlier keyframes other than the reference.
    window: tuple[RelativePose, ...] = ()
    # Measured pose relative to a keyframe of another submap, which merges the submaps.
    submap_measurement: RelativePose | None = None


@dataclass(frozen=True, slots=True)
class TrackingResult:
    """Result of tracking a frame: poses in odometry and in the map, quality, and keyframe.

    While the status is LOST, the pose is the last accepted pose, and `information` is zero.
    """

    # Pose.
    status: TrackingStatus
    # Initial guess of the pose: see `PoseHypothesis.pose_source`. "first" for the first frame of a
    # submap; "none" while LOST.
    pose_source: str
    T_odom_camera: np.ndarray  # [4, 4]
    T_map_odom: np.ndarray  # [4, 4]
    graph_version: int  # Version of the pose graph that T_map_odom comes from.
    submap: int  # The oldest submap that the pose graph has merged with the frame's own.
    # Alignment. `reference` is the id of the keyframe that the pose refers to. The first frame of a
    # submap refers to itself. None before any keyframe, and while localizing in a finished map.
    reference: int | None
    T_reference_camera: np.ndarray  # [4, 4]
    # [6, 6] for T_reference_camera * exp(xi) with xi = (rotation rad, translation m).
    information: np.ndarray
    overlap: float  # Visible fraction of the reference's surface.
    # Quality.
    inlier_fraction: float  # The smaller of the photometric and the geometric fraction.
    intensity_sigma: float  # Photometric noise, gray levels.
    depth_noise_scale: float  # Geometric noise as a multiple of `DepthNoise`.
    iterations: int  # Iterations of alignment over all pyramid levels.
    # Distance to the farthest other pose that the images support; 0 if there is none. See
    # `PoseHypothesis`.
    hypothesis_spread_rad: float
    is_contradictory: bool  # True if color and depth contradict each other.
    # Dynamic pixels, which are not mapped, [H, W] bool at the finest pyramid level.
    dynamic_mask: np.ndarray | None
    has_prior: bool  # True if the odometry prior covers the time of the frame.
    # Motion of the camera during the frame, which is compensated; None if unknown.
    motion: FrameMotion | None = None
    # Timing of the shutter after the frame, with the evidence for it.
    shutter: ShutterState = field(default_factory=ShutterState)
    # Keyframes.
    keyframe: NewKeyframe | None = None  # Keyframe made of the frame; None if none was made.
    # Id of a known keyframe that is the reference from now on; None if none is reused.
    reused_keyframe: int | None = None
    # Kind of keyframe that was needed but not allowed (`Odometry.process`, `may_map`), or None.
    denied_keyframe: KeyframeKind | None = None
    # True if odometry has not started yet, because no keyframe of its first frame was allowed.
    awaits_mapping: bool = False


def make_tracking_result(
    tracked: TrackedFrame,
    T_map_odom: np.ndarray,
    graph_version: int,
    submap: int,
    reference: int | None,
    *,
    has_prior: bool,
    motion: FrameMotion | None,
    shutter: ShutterState,
    keyframe: NewKeyframe | None = None,
    reused_keyframe: int | None = None,
    denied_keyframe: KeyframeKind | None = None,
    awaits_mapping: bool = False,
) -> TrackingResult:
    """Return the result of tracking a frame, with its pose in the map.

    Args:
        tracked: The tracked frame, with its pose in the odometry frame.
        T_map_odom: Pose of the odometry frame in the map, [4, 4]. This function orthonormalizes the
            rotation.
        graph_version: Version of the pose graph that T_map_odom comes from.
        submap: Id of the oldest submap that the pose graph has merged with the frame's submap.
        reference: Id of the keyframe that the pose is relative to; None if there is none.
        has_prior: True if the odometry prior covers the time of the frame.
        motion: Motion of the camera during the frame; None if unknown.
        shutter: State of the shutter compensation after this frame.
        keyframe: The keyframe made from the frame; None if none was made.
        reused_keyframe: Id of an earlier keyframe that becomes the reference keyframe again; None
            if none is reused.
        denied_keyframe: Kind of keyframe that was needed, but that the caller of
            `Odometry.process` did not allow; None if no keyframe was denied.
        awaits_mapping: True if odometry has not started, because the caller did not allow the
            first keyframe.
    """
    return TrackingResult(
        status=tracked.status,
        pose_source=tracked.pose_source,
        T_odom_camera=tracked.T_odom_camera,
        T_map_odom=se3.orthonormalize(T_map_odom),
        graph_version=graph_version,
        submap=submap,
        reference=reference,
        T_reference_camera=tracked.T_reference_camera,
        information=tracked.information,
        overlap=tracked.overlap,
        inlier_fraction=tracked.inlier_fraction,
        intensity_sigma=tracked.intensity_sigma,
        depth_noise_scale=tracked.depth_noise_scale,
        iterations=tracked.iterations,
        hypothesis_spread_rad=tracked.hypothesis_spread_rad,
        is_contradictory=tracked.is_contradictory,
        dynamic_mask=tracked.dynamic_mask,
        has_prior=has_prior,
        motion=motion,
        shutter=shutter,
        keyframe=keyframe,
        reused_keyframe=reused_keyframe,
        denied_keyframe=denied_keyframe,
        awaits_mapping=awaits_mapping,
    )
