"""Settings of the tracker."""

from dataclasses import dataclass, field
from math import radians
from typing import Annotated

import numpy as np
from msgspec import Meta

from ldo_service.actors.tracker import UNIT_WITHIN
from ldo_service.errors import ConfigError

from .values import (
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Ratio,
    advanced,
)


@dataclass(frozen=True, slots=True)
class MountingSettings:
    """Pose of the camera on the robot: T_base_camera.

    The camera has optical axes: x right, y down, z forward. For a base with x forward and z up
    (REP-103), a camera that looks ahead has the quaternion 0.5 -0.5 0.5 -0.5 (w x y z).
    """

    # Position of the camera in the base frame of the robot, meters.
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Rotation of the camera in the base frame. The default makes the camera frame the base frame.
    quaternion_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        name = "tracker.T_base_camera"
        if not np.isfinite(self.translation_m).all():
            raise ConfigError(f"{name}.translation_m={list(self.translation_m)} must be finite.")
        norm = float(np.linalg.norm(self.quaternion_wxyz))
        if not abs(norm - 1.0) <= UNIT_WITHIN:
            raise ConfigError(
                f"{name}.quaternion_wxyz={list(self.quaternion_wxyz)} must have norm 1, not "
                f"{norm:.4g}. The order is w x y z."
            )


@dataclass(frozen=True, slots=True)
class ImageSettings:
    """Image pyramid for the alignment in tracker and loop closer."""

    # Working width in pixels. An image is halved until it is narrower than 1.5 times this width. A
    # larger width is more accurate and slower.
    width_px: PositiveInt = 320
    # Number of pyramid levels. More levels let the alignment converge over larger motions. With
    # four levels, an image 320 pixels wide ends at 40 pixels.
    pyramid_levels: PositiveInt = advanced(4)
    # Maximum depth that is used, meters. No depth camera measures farther. Larger values, such as
    # 65 m, are errors of the camera.
    max_depth_m: PositiveFloat = 30.0


@dataclass(frozen=True, slots=True)
class DepthNoiseSettings:
    """Axial noise of the depth camera: sigma(z) = floor_m + growth_per_m * (z - 0.4 m)^2."""

    # Noise at 0.4 m, meters. The default is that of the Kinect (Nguyen, Izadi and Lovell 2012).
    floor_m: PositiveFloat = advanced(0.0012)
    # Growth of the noise with the squared distance beyond 0.4 m, per meter.
    growth_per_m: NonNegativeFloat = advanced(0.0019)


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """Direct image alignment."""

    # Maximum number of iterations per pyramid level, the finest level first.
    max_iterations: Annotated[tuple[PositiveInt, ...], Meta(min_length=1)] = advanced(
        (8, 8, 10, 10)
    )


@dataclass(frozen=True, slots=True)
class FeatureSettings:
    """Image features for poses without an initial guess."""

    # Maximum number of ORB features in an image, as in ORB-SLAM3 at 640x480.
    max_features: PositiveInt = advanced(1000)


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """Selection of keyframes."""

    # A new reference keyframe is made if a frame shows less than this fraction of the surface in
    # the reference keyframe.
    min_overlap: Ratio = 0.85
    # A new reference keyframe is made beyond this rotation from the reference keyframe, radians.
    # The default is 15 degrees.
    max_rotation_rad: PositiveFloat = radians(15.0)
    # A new reference keyframe is made beyond this translation from the reference keyframe, as a
    # fraction of the median depth.
    max_translation_ratio: PositiveFloat = 0.08
    # Minimum number of frames between reference keyframes. With 1, each frame may become a
    # reference keyframe. A larger number limits the load of the mapper.
    min_interval_frames: PositiveInt = advanced(1)
    # Maximum number of frames between reference keyframes, if the camera moved at all.
    max_interval_frames: PositiveInt = advanced(30)
    # Fraction of max_rotation_rad or max_translation_ratio. A mapping keyframe is made if the
    # motion since the last mapped frame exceeds it; frames are not tracked against this keyframe.
    # A value above 1 makes none. Mapping keyframes improve PSNR by 0.4 dB on the sequence kitchen.
    mapping_only_ratio: PositiveFloat = advanced(0.33)
    # Number of keyframes after which the tracker searches for a known keyframe before it makes a
    # new keyframe. With fewer keyframes, every new one improves the map. 0 never searches.
    reuse_after: NonNegativeInt = 1500

    def __post_init__(self) -> None:
        if self.min_interval_frames > self.max_interval_frames:
            raise ConfigError(
                f"tracker.keyframes.min_interval_frames={self.min_interval_frames} must be at most "
                f"tracker.keyframes.max_interval_frames={self.max_interval_frames}."
            )


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """Relative-pose measurements between a new keyframe and earlier keyframes."""

    # Maximum number of earlier keyframes to which a new keyframe is aligned, at 4 ms each. A larger
    # number changes little. 0 aligns to none.
    max_measurements: NonNegativeInt = advanced(3)


@dataclass(frozen=True, slots=True)
class RelocalizationSettings:
    """Relocalization after tracking was lost."""

    # Maximum number of keyframes in the keyframe database, 0.13 MB each at 640x480. Beyond this
    # number, keyframes are removed evenly along the path.
    max_keyframes: Annotated[int, Meta(ge=3)] = 1000
    # Number of keyframes of similar appearance that a lost frame is compared with.
    appearance_candidates: NonNegativeInt = advanced(5)
    # Number of further keyframes that a lost frame is compared with by SIFT, which tolerates scale
    # changes. 0 disables SIFT.
    sift_candidates: NonNegativeInt = advanced(8)


@dataclass(frozen=True, slots=True)
class SubmapSettings:
    """Submaps that the tracker starts after it was lost."""

    # Number of LOST frames in a row after which the tracker starts a new submap. A LOST
    # frame that looks different from the LOST frames before it counts as three. Frames of a
    # covered camera do not count. 0 never starts one.
    start_after_lost_frames: NonNegativeInt = 90


@dataclass(frozen=True, slots=True)
class QualitySettings:
    """Limits between the tracking statuses OK, WEAK and LOST."""

    # The pose of a frame is WEAK if the frame shows less than this fraction of the surface in the
    # reference keyframe. The default was chosen on one apartment.
    weak_overlap: Ratio = advanced(0.15)
    # A pose is WEAK if the ratio of its residual to the median residual of the last OK frames
    # exceeds this value. A pose that is closely confirmed by features is WEAK above a ratio of 6,
    # and LOST above 15.
    weak_residual_ratio: Annotated[float, Meta(gt=1)] = advanced(2.5)
    # A pose is LOST if the ratio of its residual to the median residual of the last OK frames
    # exceeds this value.
    lost_residual_ratio: Annotated[float, Meta(gt=1)] = advanced(5.0)
    # The pose of a frame is LOST if the frame shows less than this fraction of the surface in the
    # reference keyframe.
    lost_overlap: Ratio = advanced(0.08)

    def __post_init__(self) -> None:
        if self.lost_overlap > self.weak_overlap:
            raise ConfigError(
                f"tracker.quality.lost_overlap={self.lost_overlap:g} must be at most "
                f"tracker.quality.weak_overlap={self.weak_overlap:g}."
            )
        if self.weak_residual_ratio > self.lost_residual_ratio:
            raise ConfigError(
                f"tracker.quality.weak_residual_ratio={self.weak_residual_ratio:g} must be at most "
                f"tracker.quality.lost_residual_ratio={self.lost_residual_ratio:g}."
            )


@dataclass(frozen=True, slots=True)
class DynamicsSettings:
    """Motion segmentation."""

    # If True, moving surfaces are masked in tracking and in the map. If False, the tracker assumes
    # a static world.
    enabled: bool = True


@dataclass(frozen=True, slots=True)
class OdometryPriorSettings:
    """Use of poses of another odometry as initial guesses."""

    # Maximum time between two poses of the other odometry that are interpolated, seconds. Over a
    # longer time, the path is not straight.
    max_gap_s: PositiveFloat = advanced(0.25)
    # Maximum duration of dead reckoning by the other odometry while LOST, seconds. With the
    # default, a drift of 2 % at 0.5 m/s grows to 30 cm.
    max_dead_reckoning_s: PositiveFloat = advanced(30.0)


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Tracking of the camera pose in each frame."""

    T_base_camera: MountingSettings = field(default_factory=MountingSettings)
    image: ImageSettings = field(default_factory=ImageSettings)
    depth_noise: DepthNoiseSettings = field(default_factory=DepthNoiseSettings)
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)
    features: FeatureSettings = field(default_factory=FeatureSettings)
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    window: WindowSettings = field(default_factory=WindowSettings)
    relocalization: RelocalizationSettings = field(default_factory=RelocalizationSettings)
    submaps: SubmapSettings = field(default_factory=SubmapSettings)
    quality: QualitySettings = field(default_factory=QualitySettings)
    dynamics: DynamicsSettings = field(default_factory=DynamicsSettings)
    odometry_prior: OdometryPriorSettings = field(default_factory=OdometryPriorSettings)
    # True estimates vignetting, depth bias and the timing of the shutter in the first seconds with
    # motion. The timing is the readout of color and depth, and the delay between them. Only
    # significant errors are corrected.
    self_calibration: bool = advanced(True)
    # Folder of a finished run of the same camera, whose calibration this run starts with. Empty
    # starts with an unknown camera.
    calibration_run: str = ""
    # Folder of a finished run, in whose map the camera is localized. The map is not changed. Empty
    # makes a new map.
    localization_map: str = ""
    # Interval of held-out frames, which are tracked but never mapped, to evaluate the map on them.
    # 0 maps every frame.
    hold_out: NonNegativeInt = 0

    def __post_init__(self) -> None:
        if self.hold_out == 1:
            raise ConfigError(
                f"tracker.hold_out={self.hold_out} must be 0 (maps every frame) or at least 2."
            )
