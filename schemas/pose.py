"""Poses, and the tracked pose of the camera."""

from typing import Literal

import msgspec
import numpy as np

from ldo_service.schemas.message import Message, require_count, require_finite

# Tolerance of a quaternion's norm: float64 rounding, with margin for float32 math in clients.
QUATERNION_TOLERANCE = 1e-6

# Maximum coordinate of a pose, meters. All coordinates on Earth are below it: geocentric ones reach
# 6.4e6 m, and those of map projections (UTM) 1e7 m. A float64 still resolves 15 nm there.
MAX_COORDINATE_M = 1e8


class Pose(msgspec.Struct, frozen=True):
    """Rigid transform T_a_b from coordinates in frame b to coordinates in frame a.

    The name of a field states the frames: T_map_odom has a = map and b = odom.
    """

    translation: tuple[float, float, float]  # Origin of b in a, meters.
    quaternion: tuple[float, float, float, float]  # Rotation w x y z, unit norm.

    def __post_init__(self) -> None:
        require_finite("pose", (*self.translation, *self.quaternion))
        if max(map(abs, self.translation)) > MAX_COORDINATE_M:
            raise ValueError(
                f"translation {self.translation} m must be within +-{MAX_COORDINATE_M:g} m"
            )
        norm = sum(q * q for q in self.quaternion) ** 0.5
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(f"quaternion {self.quaternion} has norm {norm:.9g}, must be 1")

    def matrix(self) -> np.ndarray:
        """Return the transform as a homogeneous matrix, [4, 4] float64.

        The product of two matrices chains the transforms: `T_map_odom.matrix() @
        T_odom_camera.matrix()` is the matrix of T_map_camera.
        """
        w, *v = self.quaternion
        x, y, z = v
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        T = np.eye(4)
        T[:3, :3] += 2 * (w * cross + cross @ cross)
        T[:3, 3] = self.translation
        return T


IDENTITY = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))

# OK: tracked. WEAK: the pose is uncertain. LOST: the pose of the frame is unknown.
TrackingStatus = Literal["OK", "WEAK", "LOST"]

Matrix6 = tuple[float, ...]  # 36 numbers, row-major; rotation (rad), then translation (m).


def require_matrix6(name: str, values: Matrix6) -> None:
    """Raise ValueError unless a matrix has 36 finite numbers."""
    if len(values) != 36:
        raise ValueError(f"{name} has {len(values)} numbers, must have 36")
    require_finite(name, values)


class TrackedPose(Message, frozen=True, kw_only=True):
    """Camera pose at `stamp_ns`, published on pose/tracked (REP-105 frames).

    The status WEAK means that the pose is uncertain, and that the frame is not mapped. LOST means
    that the pose of the frame is unknown. The message then repeats the last pose with status OK or
    WEAK.
    """

    frame: int  # Frame number, as in camera/rgbd.
    status: TrackingStatus
    T_odom_camera: Pose  # Continuous except after relocalization.
    T_map_odom: Pose  # Changes with corrections; T_map_camera = T_map_odom @ T_odom_camera.
    graph_version: int  # Version of the correction that T_map_odom uses; 0 before the first.
    reference: int | None  # Id of the reference keyframe; None before the first keyframe.
    T_reference_camera: Pose
    keyframe: int | None = None  # Id as a keyframe if this frame became one.
    # Covariance of T_reference_camera for a perturbation on the right: rotation in rad,
    # translation in m. Zeros if unknown: while LOST, and in the first frame of a submap.
    covariance: Matrix6 = (0.0,) * 36
    inlier_fraction: float = 0.0  # Fraction of the residuals within three times their noise.
    residual_color: float = 0.0  # Robust sigma of the color residuals, gray levels 0..255.
    # Robust sigma of the depth residuals, as a multiple of the expected depth noise.
    residual_depth: float = 0.0
    overlap: float = 0.0  # Fraction of the reference keyframe's surface that this frame sees.
    iterations: int = 0  # Iterations of alignment.
    # Initial guess that led to the pose. "direct": the last pose, moved on with its velocity or
    # left as it is; "prior": other odometry; "features": ORB features; "gicp": registration of
    # point clouds; "relocalized": features of an earlier keyframe; "reused": the pose in the map.
    # "first": first frame of a submap; "none": no pose.
    pose_source: str = ""
    # Largest distance to a pose that alignment found from another initial guess and that the images
    # support: angle between the poses plus their translation divided by the median depth, rad.
    hypothesis_spread_rad: float = 0.0
    T_base_camera: Pose = IDENTITY  # T_odom_base = T_odom_camera @ inverse(T_base_camera).
    # 0: T_map_odom leads to the frame of the map. Otherwise, it leads to the frame of the
    # submap with this number, which is not merged with the map yet.
    submap: int = 0

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
