"""Poses, and where the tracker says the camera is."""

from typing import Literal

import msgspec

from ldo_service.schemas.message import Message, require_count, require_finite

QUATERNION_TOLERANCE = 1e-6  # of the norm: float64 rounding, with room for a client's float32 maths


class Pose(msgspec.Struct, frozen=True):
    """T_a_b: maps coordinates in b to coordinates in a. The field that holds it names a and b."""

    translation: tuple[float, float, float]  # of b's origin in a, metres
    quaternion: tuple[float, float, float, float]  # w x y z, unit

    def __post_init__(self) -> None:
        require_finite("pose", (*self.translation, *self.quaternion))
        norm = sum(q * q for q in self.quaternion) ** 0.5
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(f"quaternion {self.quaternion} has norm {norm:.9g}, must be 1")


IDENTITY = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))

TrackingStatus = Literal["OK", "WEAK", "LOST"]

Matrix6 = tuple[float, ...]  # 36 numbers, row-major; rotation (rad), then translation (m)


def require_matrix6(name: str, values: Matrix6) -> None:
    if len(values) != 36:
        raise ValueError(f"{name} has {len(values)} numbers, must have 36")
    require_finite(name, values)


class TrackedPose(Message, frozen=True, kw_only=True):
    """pose/tracked: where the camera was at `stamp_ns` (REP-105 frames).

    WEAK: the pose is a best effort, nothing is mapped from it. LOST: the pose is the last that was
    trusted.
    """

    frame: int  # as in camera/rgbd
    status: TrackingStatus
    T_odom_camera: Pose  # continuous, but where a lost camera is found again
    T_map_odom: Pose  # moves with corrections: T_map_camera = T_map_odom @ T_odom_camera
    graph_version: int  # of the correction that T_map_odom is built on; 0 before the first
    reference: int | None  # the keyframe it was aligned to; None before there is one
    T_reference_camera: Pose
    keyframe: int | None = None  # the id it was given, when this frame became a keyframe
    covariance: Matrix6 = (0.0,) * 36  # of T_reference_camera, perturbed on the right
    inlier_fraction: float = 0.0  # of the residuals
    residual_color: float = 0.0  # robust sigma, grey levels of 0..255
    residual_depth: float = 0.0  # robust sigma over that of the sensor model
    overlap: float = 0.0  # share of the reference's surface that this frame sees
    iterations: int = 0
    # the guess that won: direct, prior, features, gicp, relocalized, reused; first; none
    pose_source: str = ""
    hypothesis_spread_rad: float = 0.0  # between where several guesses led, rad of image motion
    T_base_camera: Pose = IDENTITY  # T_odom_base = T_odom_camera @ inverse(T_base_camera)
    submap: int = 0  # whose frame T_map_odom leads to: 0 is the map's; others are not joined yet

    def check(self) -> None:
        require_count("frame", self.frame)
        require_count("graph_version", self.graph_version)
        require_count("reference", self.reference or 0)
        require_count("keyframe", self.keyframe or 0)
        require_count("iterations", self.iterations)
        require_count("submap", self.submap)
        require_matrix6("covariance", self.covariance)
        require_finite(
            "tracking quality",
            (
                *(self.inlier_fraction, self.residual_color, self.residual_depth, self.overlap),
                self.hypothesis_spread_rad,
            ),
        )
