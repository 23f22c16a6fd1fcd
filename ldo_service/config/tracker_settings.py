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
    (REP-103), a camera that looks ahead has the quaternion 0.5 -0.5 0.5 -0.5.
    """

    # This is the center of the camera in the base frame of the robot, in meters.
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # This is the rotation of the camera in the base frame. The default makes the camera the base.
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
    """Image pyramid that the tracker and the loop closer align."""

    # An image is halved until it is narrower than 1.5 times this width. Larger is more accurate
    # and slower.
    width_px: PositiveInt = 320
    # More levels let the alignment converge over larger motions. Four levels of 320 pixels end at
    # 40 pixels.
    pyramid_levels: PositiveInt = advanced(4)
    # Depth beyond this is ignored: no depth camera measures farther, and a stray 65 m must not
    # count.
    max_depth_m: PositiveFloat = 30.0


@dataclass(frozen=True, slots=True)
class DepthNoiseSettings:
    """Axial noise of the depth camera: sigma(z) = floor + growth (z - 0.4 m)^2."""

    # This is the noise at 0.4 m. The default is the Kinect's (Nguyen, Izadi and Lovell 2012).
    floor_m: PositiveFloat = advanced(0.0012)
    # The noise grows by this factor times the squared distance beyond 0.4 m.
    growth_per_m: NonNegativeFloat = advanced(0.0019)


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """Direct image alignment."""

    # The alignment stops after so many iterations per pyramid level, the finest level first.
    max_iterations: Annotated[tuple[PositiveInt, ...], Meta(min_length=1)] = advanced(
        (8, 8, 10, 10)
    )


@dataclass(frozen=True, slots=True)
class FeatureSettings:
    """Image features for poses without a prediction."""

    # ORB keeps so many features of an image, as ORB-SLAM3 does at 640x480.
    max_features: PositiveInt = advanced(1000)


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """Selection of keyframes."""

    # A keyframe is made when less of the visible surface overlaps with the last keyframe.
    min_overlap: Ratio = 0.85
    # A keyframe is made when the camera has turned farther than this (15 degrees).
    max_rotation_rad: PositiveFloat = radians(15.0)
    # A keyframe is made when the camera has moved farther than this, as a fraction of the median
    # depth.
    max_translation_ratio: PositiveFloat = 0.08
    # A keyframe is made at most every so many frames, which bounds the work of the mapper.
    min_interval_frames: PositiveInt = advanced(2)
    # A keyframe is made at least every so many frames, if the camera moved at all.
    max_interval_frames: PositiveInt = advanced(30)
    # A frame is mapped but not tracked against after this fraction of the two motion limits. Above
    # 1 there are no such frames. On the kitchen they gain 0.4 dB.
    mapping_only_ratio: PositiveFloat = advanced(0.33)
    # From so many keyframes on the tracker looks for a known keyframe before it makes one. 0 never
    # looks. Until then new views improve the map.
    reuse_after: NonNegativeInt = 1500

    def __post_init__(self) -> None:
        if self.min_interval_frames > self.max_interval_frames:
            raise ConfigError(
                f"tracker.keyframes.min_interval_frames={self.min_interval_frames} must be at most "
                f"tracker.keyframes.max_interval_frames={self.max_interval_frames}."
            )


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """Measurements between a keyframe and earlier ones."""

    # A keyframe is measured against so many earlier ones, at 4 ms each. More change little; 0 is
    # none.
    max_measurements: NonNegativeInt = advanced(3)


@dataclass(frozen=True, slots=True)
class RelocalizationSettings:
    """Search for the camera after tracking was lost."""

    # The tracker and the loop closer keep so many keyframes, 0.13 MB each at 640x480. Beyond, the
    # path is thinned.
    max_keyframes: Annotated[int, Meta(ge=3)] = 1000
    # A lost frame is compared with so many keyframes of similar appearance.
    appearance_candidates: NonNegativeInt = advanced(5)
    # A lost frame is compared with so many more keyframes by SIFT, which tolerates changes of
    # scale. 0 disables SIFT.
    sift_candidates: NonNegativeInt = advanced(8)


@dataclass(frozen=True, slots=True)
class SubmapSettings:
    """Submaps, which the tracker starts where it is lost."""

    # The tracker starts a new submap after so long without a pose, as ORB-SLAM3 does. 0 never
    # starts one.
    start_after_lost_s: NonNegativeFloat = 3.0


@dataclass(frozen=True, slots=True)
class QualitySettings:
    """Limits between the states OK, WEAK and LOST."""

    # A pose is WEAK when less of the visible reference surface is matched. Chosen on one apartment.
    weak_overlap: Ratio = advanced(0.15)
    # A pose is WEAK when its residual exceeds the running median by this factor.
    weak_residual_ratio: Annotated[float, Meta(gt=1)] = advanced(2.5)
    # A pose is LOST when its residual exceeds the running median by this factor.
    lost_residual_ratio: Annotated[float, Meta(gt=1)] = advanced(5.0)
    # A pose is LOST when less of the visible reference surface is matched.
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
    """Segmentation of moving surfaces."""

    # Surfaces that move are left out of tracking and of the map. False takes the world as static.
    enabled: bool = True


@dataclass(frozen=True, slots=True)
class OdometryPriorSettings:
    """Use of an external odometry."""

    # Two poses farther apart in time are not interpolated, because the path between is no straight
    # line.
    max_gap_s: PositiveFloat = advanced(0.25)
    # The tracker follows the external odometry for so long while LOST: 2 % drift at 0.5 m/s is
    # then 30 cm.
    max_dead_reckoning_s: PositiveFloat = advanced(30.0)


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Camera pose of each frame."""

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
    # The tracker localizes in the map of this finished run and does not change it. Empty maps.
    localization_map: str = ""
    # Every n-th frame is tracked but never mapped, to evaluate the map on it. 0 maps every frame.
    hold_out: NonNegativeInt = 0

    def __post_init__(self) -> None:
        if self.hold_out == 1:
            raise ConfigError(f"tracker.hold_out={self.hold_out} must be 0, or 2 and more.")
