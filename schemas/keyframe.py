"""Keyframes from the tracker, and their refined poses from the mapper."""

import msgspec
import numpy as np

from ldo_service.schemas.array import Array
from ldo_service.schemas.frames import CameraModel, require_rgbd
from ldo_service.schemas.message import Message, require_count, require_finite
from ldo_service.schemas.pose import Matrix6, Pose, require_matrix6

NO_MASK = Array.of(np.zeros((0, 0), np.uint8))


class MeasuredPose(msgspec.Struct, frozen=True, kw_only=True):
    """Relative-pose measurement between two keyframes."""

    reference: int  # Id of the keyframe in whose frame the pose is given.
    keyframe: int  # Id of the measured keyframe.
    T_reference_keyframe: Pose
    information: Matrix6  # Information matrix for a perturbation on the right.

    def __post_init__(self) -> None:
        require_count("reference", self.reference)
        require_count("keyframe", self.keyframe)
        require_matrix6("information", self.information)
        if self.reference == self.keyframe:
            raise ValueError(
                f"keyframe {self.keyframe} is measured against itself; reference and keyframe "
                "must differ"
            )


# Three coefficients of a polynomial, as in `CameraCorrection`.
Terms = tuple[float, float, float]
NO_TERMS: Terms = (0.0, 0.0, 0.0)


class CameraCorrection(msgspec.Struct, frozen=True, kw_only=True):
    """Correction that the self-calibration of the camera applied to color and depth.

    A pixel (u, v) of an image with width w and center (cu, cv) has the coordinates x =
    (u - cu) / (w/2) and y = (v - cv) / (w/2). Its distance r from the center is scaled to 1 in the
    corners. The corrected depth z follows from 1/z = 1/z_measured + b1 x^2 + b2 x y + b3 y^2. The
    vignetting V of a channel follows from log V = a1 r^2 + a2 r^4 + a3 r^6. The corrected color is
    the measured color times V_min / V. V_min is the smallest V of the channel in the image, so the
    correction clips no color.

    readout_s, depth_readout_s and depth_delay_s are times of the camera's shutter. They are 0 until
    the self-calibration has estimated them. From then on, color and depth are corrected as if the
    camera had recorded all rows at one instant. This correction needs the motion of the camera, and
    is skipped for a frame whose motion is unknown.
    """

    depth_bias: Terms = NO_TERMS  # b1, b2, b3 in 1/m.
    # a1, a2, a3 of red, green and blue.
    vignetting: tuple[Terms, Terms, Terms] = (NO_TERMS, NO_TERMS, NO_TERMS)
    readout_s: float = 0.0  # First to last row of the color image.
    depth_readout_s: float = 0.0  # First to last row of depth.
    depth_delay_s: float = 0.0  # Color to depth, middle rows; negative if depth is earlier.

    def __post_init__(self) -> None:
        require_finite("depth_bias", self.depth_bias)
        require_finite("timing", (self.readout_s, self.depth_readout_s, self.depth_delay_s))
        for channel in self.vignetting:
            require_finite("vignetting", channel)


class Keyframe(Message, frozen=True, kw_only=True):
    """Frame to be mapped, with its pose relative to a reference keyframe.

    The message is published on keyframe/new. It has no pose in the map, because the pose-graph
    optimizer changes the poses in the map. A receiver computes T_map_keyframe = T_map_reference @
    T_reference_keyframe. A receiver that missed the reference keyframe computes T_map_keyframe from
    T_odom_keyframe and any other keyframe of the submap.

    The first keyframe of a submap has no reference keyframe. Tracking started with this first
    keyframe or was lost before it, so its pose in other submaps is unknown.
    """

    keyframe: int  # Id, ascending.
    frame: int  # Frame number, as in camera/rgbd.
    camera: CameraModel  # Intrinsics without distortion.
    color: Array  # RGB, u1 [H, W, 3].
    depth_m: Array  # Depth z in meters, f4 [H, W]; 0 where not measured.
    reference: int | None  # Id of the reference keyframe; None for the first of a submap.
    T_reference_keyframe: Pose
    information: Matrix6  # Information of T_reference_keyframe for a perturbation on the right.
    T_odom_keyframe: Pose
    overlap: float = 1.0  # Fraction of the reference keyframe's surface that this keyframe sees.
    # Poses of this keyframe in keyframes of the same submap other than `reference`.
    window_measurements: tuple[MeasuredPose, ...] = ()
    # Mask u1 [H, W]; 1 where pixels move and are not mapped. Shape [0, 0] if nothing moves.
    dynamic_mask: Array = NO_MASK
    # Number of the submap. If relocalization fails for many LOST frames, the tracker starts a new
    # submap.
    submap: int = 0
    # Poses of this keyframe in keyframes of other submaps; they connect the submaps.
    submap_measurements: tuple[MeasuredPose, ...] = ()
    # Correction that `color` and `depth_m` already contain.
    camera_correction: CameraCorrection = CameraCorrection()

    def check(self) -> None:
        require_rgbd(self.camera, self.color, self.depth_m)
        require_count("frame", self.frame)
        require_finite("overlap", (self.overlap,))
        if self.dynamic_mask.shape != (0, 0):
            self.dynamic_mask.require("dynamic_mask", "u1", (self.camera.height, self.camera.width))
        _check_measurements(self)


class KeyframeMeasurements(Message, frozen=True, kw_only=True):
    """Pose measurements of a keyframe without its images; published on keyframe/measurements.

    Each field means the same as in `Keyframe`. The pose-graph optimizer reads this message instead
    of `Keyframe`, because a backlog of messages without images stays small.
    """

    keyframe: int
    camera: CameraModel
    reference: int | None
    T_reference_keyframe: Pose
    information: Matrix6
    T_odom_keyframe: Pose
    window_measurements: tuple[MeasuredPose, ...] = ()
    submap: int = 0
    submap_measurements: tuple[MeasuredPose, ...] = ()

    def check(self) -> None:
        _check_measurements(self)


def _check_measurements(message: Keyframe | KeyframeMeasurements) -> None:
    """Check the fields that both messages have.

    Raises:
        ValueError: If a field is out of range, or a measurement belongs to another keyframe.
    """
    keyframe = message.keyframe
    require_count("keyframe", keyframe)
    require_matrix6("information", message.information)
    require_count("submap", message.submap)
    if any(pose.keyframe != keyframe for pose in message.submap_measurements):
        raise ValueError(
            f"submap_measurements of keyframe {keyframe} contain the pose of another keyframe; all "
            f"must be poses of keyframe {keyframe}"
        )
    if message.reference is not None and not 0 <= message.reference < keyframe:
        raise ValueError(
            f"keyframe {keyframe} has the reference {message.reference}; the reference must be an "
            f"older keyframe, in 0..{keyframe - 1}"
        )
    for pose in message.window_measurements:
        if not pose.reference < pose.keyframe == keyframe:
            raise ValueError(
                f"window_measurements of keyframe {keyframe} contain the pose of keyframe "
                f"{pose.keyframe} in keyframe {pose.reference}; they must be poses of keyframe "
                f"{keyframe} in older keyframes"
            )


class KeyframeRefinement(Message, frozen=True, kw_only=True):
    """Refined relative poses of keyframes, published on keyframe/refinement by the mapper.

    Each pose replaces the earlier measurement of the same pair of keyframes.
    """

    poses: tuple[MeasuredPose, ...]
    number: int = 0  # Number of the message, ascending from 1; 0 if not numbered.

    def check(self) -> None:
        require_count("number", self.number)
