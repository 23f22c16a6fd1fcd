"""What the odometry says of a frame. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass, field

import numpy as np

from .alignment import Alignment
from .keyframes import Keyframe
from .submaps import SubmapMeasurement
from .tracking_quality import Status


@dataclass(frozen=True, slots=True)
class Tracked:
    """Where a frame was taken. While LOST the pose is the last trusted one.

    information [6, 6] is that of T_keyframe_camera * exp(xi), rotation rad then translation m;
    zero while LOST.
    """

    T_odom_camera: np.ndarray  # [4, 4]
    T_keyframe_camera: np.ndarray  # [4, 4]
    keyframe: int | None  # id of the keyframe it was aligned to; None before the first
    status: Status
    method: str  # the guess that won: "first", "direct", "prior", "features", "shape", ...
    wants_keyframe: bool
    wants_mapping: bool = False  # as a supporting keyframe: mapped, and not tracked against
    information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    inlier_fraction: float = 0.0  # smaller of the photometric and the geometric
    intensity_sigma: float = 0.0  # photometric residual, grey levels
    depth_noise_scale: float = 0.0  # geometric residual, times the sensor model
    overlap: float = 0.0  # visible fraction of the keyframe's surface
    iterations: int = 0
    disagreement_rad: float = 0.0  # between the guesses' outcomes, where several were tried
    is_moving: np.ndarray | None = None  # [H, W] bool at working resolution: not to be mapped
    segment: int = 0  # whose odometry frame T_odom_camera leads to
    may_begin: bool = False  # LOST for so long that a new segment is better than none
    join: SubmapMeasurement | None = (
        None  # where it is in another segment; counts once it is a keyframe
    )


def report(
    alignment: Alignment,
    T_odom_camera: np.ndarray,
    keyframe: Keyframe,
    status: Status,
    method: str,
    *,
    wants_keyframe: bool = False,
    wants_mapping: bool = False,
    disagreement_rad: float = 0.0,
    is_moving: np.ndarray | None = None,
) -> Tracked:
    """What an alignment to a keyframe says of a frame, with what is asked of the caller."""
    return Tracked(
        T_odom_camera,
        alignment.T_reference_camera,
        keyframe.id,
        status,
        method,
        wants_keyframe,
        wants_mapping,
        information=alignment.information,
        inlier_fraction=min(alignment.photometric_inliers, alignment.geometric_inliers),
        intensity_sigma=alignment.intensity_sigma,
        depth_noise_scale=alignment.depth_noise_scale,
        overlap=alignment.overlap,
        iterations=alignment.iterations,
        disagreement_rad=disagreement_rad,
        is_moving=is_moving,
        segment=keyframe.segment,
    )
