"""Reference keyframes and the decision to make one. Conventions: `ldo_service.geometry`."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import radians
from typing import Any

import numpy as np

from ldo_service.calibration.correction import CorrectionChange
from ldo_service.calibration.shutter import FrameMotion, ShutterTiming
from ldo_service.detection.dynamic_classes import Box, DynamicClassConfig, dynamic_class_mask
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3

from .features import FeatureConfig, Features, detect
from .motion_segmentation import MotionSegmentationConfig, grow_mask
from .pyramid import Pyramid, PyramidConfig, ReferencePoints, build_pyramid, build_reference


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    """Settings of the decision to make a keyframe."""

    # Minimum overlap with the reference keyframe; below it, the frame shows new surface to map.
    min_overlap: float = 0.85
    # Maximum rotation and translation from the reference keyframe; the translation is a fraction of
    # the median depth.
    max_rotation_rad: float = radians(15.0)
    max_translation: float = 0.08
    # Minimum number of frames between reference keyframes. A camera that turns by 10 degrees per
    # frame needs a new one at every frame.
    min_frames: int = 1
    # Maximum number of frames between reference keyframes while the camera moves.
    max_frames: int = 30
    # A relay is a reference that is used for tracking but not mapped. While the caller allows no
    # keyframe, as at held-out frames, a frame becomes a relay if its motion exceeds this ratio
    # times the limits above, or if its overlap is below min_overlap / relay_ratio. A ratio of 1
    # would make a relay of each such frame that needs a keyframe, and each relay adds a link to the
    # chain of relative poses.
    relay_ratio: float = 1.5
    # The camera stands still if the overlap is above still_overlap, and rotation (rad) and
    # translation (fraction of the median depth) are below still_motion.
    still_overlap: float = 0.97
    still_motion: float = 0.01
    # A frame becomes a mapping keyframe if its motion since the last mapped frame exceeds this
    # fraction of max_rotation_rad or max_translation; the reference keyframe stays. More views
    # improve the map, and fewer references improve tracking. On the sequence kitchen, mapping
    # keyframes raise the PSNR of held-out views by 0.4 dB on average and by 2 dB for the worst
    # view, with the same number of iterations. With a value above 1, there are no mapping
    # keyframes.
    mapping_only_ratio: float = 0.33

    def __post_init__(self) -> None:
        if not (0 <= self.still_overlap <= 1 and self.still_motion >= 0):
            raise ConfigError(
                f"KeyframeConfig.still_overlap={self.still_overlap:g} must be within 0..1, "
                f"and still_motion={self.still_motion:g} must be at least 0."
            )
        if not min(self.max_rotation_rad, self.max_translation, self.mapping_only_ratio) > 0:
            raise ConfigError(
                f"KeyframeConfig.max_rotation_rad={self.max_rotation_rad:g}, max_translation="
                f"{self.max_translation:g} and "
                f"mapping_only_ratio={self.mapping_only_ratio:g} must be positive."
            )
        if not self.relay_ratio >= 1:
            raise ConfigError(
                f"KeyframeConfig.relay_ratio={self.relay_ratio:g} must be at least 1."
            )
        if not 0 <= self.min_overlap <= 1:
            raise ConfigError(
                f"KeyframeConfig.min_overlap={self.min_overlap:g} must be within 0..1."
            )
        if not 1 <= self.min_frames <= self.max_frames:
            raise ConfigError(
                f"KeyframeConfig.min_frames={self.min_frames} must be at least 1 and at most "
                f"max_frames={self.max_frames}."
            )


@dataclass(frozen=True, eq=False, slots=True)
class Relay:
    """Pose of a relay, relative to the last keyframe before it.

    A relay is a frame that later frames are aligned to although it is no keyframe.
    """

    T_keyframe_relay: np.ndarray  # [4, 4]
    # [6, 6] for T_keyframe_relay * exp(xi), xi = (rotation rad, translation m).
    covariance: np.ndarray

    def pose_of(
        self, T_relay_camera: np.ndarray, information: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Convert a pose relative to the relay into a pose relative to the last keyframe before it.

        A relay is a frame that later frames are aligned to although it is no keyframe.

        Args:
            T_relay_camera: Pose of the camera relative to the relay, [4, 4].
            information: Information of that pose, [6, 6]; zero if the pose is unknown.

        Returns:
            T_keyframe_camera, [4, 4], and its information, [6, 6].
        """
        T_keyframe_camera = self.T_keyframe_relay @ T_relay_camera
        if not information.any():
            return T_keyframe_camera, information
        J = se3.adjoint(se3.inverse(T_relay_camera))
        covariance = J @ self.covariance @ J.T + covariance_of(information)
        return T_keyframe_camera, np.linalg.inv(covariance)


def covariance_of(information: np.ndarray) -> np.ndarray:
    """Return the covariance [6, 6] of an information matrix [6, 6].

    Directions without information get a standard deviation of 1 rad or 1 m.
    """
    return np.linalg.inv(information + np.eye(6))


@dataclass(frozen=True, eq=False)
class ReferenceKeyframe:
    """Reference that frames are aligned to: a keyframe, or a relay (see `Relay`)."""

    view: Pyramid
    T_odom_keyframe: np.ndarray  # [4, 4]
    # Ascending number that odometry assigns. The camera's frame numbers may restart, so they
    # are not used.
    id: int
    submap: int = 0  # Submap in whose odometry frame T_odom_keyframe is expressed.
    # Pixels whose surface has moved, [H, W] bool at the finest pyramid level; found by
    # `segment_motion`.
    moved_mask: np.ndarray | None = None
    ignore_mask: np.ndarray | None = None  # `moved_mask` grown by `grow_mask`, [H, W] bool.
    dynamic_class_mask: np.ndarray | None = None  # Objects of dynamic classes, [H, W] bool.
    # ORB features of a keyframe record; they come from a larger image than `view`.
    stored_features: Features | None = None
    # Pose of the relay relative to the keyframe `id`, if `view` is a relay; None for a keyframe.
    relay: Relay | None = None
    motion: FrameMotion | None = None  # Motion of the camera during the frame; None if unknown.

    @cached_property
    def reference(self) -> ReferencePoints:
        """Surface points that frames are aligned to; masked pixels yield no points."""
        masks = [mask for mask in (self.ignore_mask, self.dynamic_class_mask) if mask is not None]
        return build_reference(self.view, np.logical_or.reduce(masks) if masks else None)

    def features(self, config: FeatureConfig) -> Features:
        """Return the ORB features.

        They are detected on the first call and not earlier, because most keyframes never need any.
        Later calls return the same features. If a frame with known features becomes a keyframe,
        the keyframe has these features.
        """
        if self.stored_features is not None:
            return self.stored_features
        return detect(self.view, config)

    def with_moved(
        self, moved_mask: np.ndarray, config: MotionSegmentationConfig
    ) -> "ReferenceKeyframe":
        """Return the keyframe with a new mask of moved surface, which is ignored from now on.

        Pixels that the keyframe already ignores stay ignored, for example pixels of people who
        stood still.

        Args:
            moved_mask: Pixels whose surface has moved, [H, W] bool at the finest pyramid level.
            config: Settings.
        """
        ignore_mask = grow_mask(moved_mask, self.view, config)
        if self.ignore_mask is not None:
            ignore_mask = ignore_mask | self.ignore_mask
        return replace(self, moved_mask=moved_mask, ignore_mask=ignore_mask)

    def recorrected(self, change: CorrectionChange, config: PyramidConfig) -> "ReferenceKeyframe":
        """Return the keyframe converted to a new correction of vignetting and depth bias."""
        view, camera = self.view, self.view.camera
        gray, depth_m = change.gray(view.gray, camera), change.depth_m(view.depth_m, camera)
        features = self.stored_features
        if features is not None:
            features = replace(
                features, points_camera=change.points(features.points_camera, camera)
            )
        return replace(
            self, view=build_pyramid(gray, depth_m, camera, config), stored_features=features
        )

    def retimed(
        self, timing: ShutterTiming, velocity: np.ndarray, config: PyramidConfig
    ) -> "ReferenceKeyframe":
        """Return the keyframe, compensated for camera motion with a new shutter timing.

        Args:
            timing: The new timing.
            velocity: Velocity of the camera, [6]: rotation in rad/s, then translation in m/s. It is
                used only if `self.motion` is None.
            config: Settings of the pyramid.
        """
        before = self.motion or FrameMotion(velocity, ShutterTiming())
        times_s = np.subtract(timing.times_s, before.timing.times_s).tolist()
        change, view = replace(before, timing=ShutterTiming(*times_s)), self.view
        gray, depth_m = change.warped(view.gray, view.depth_m, view.camera)
        return replace(
            self,
            view=build_pyramid(gray, depth_m, view.camera, config),
            motion=replace(before, timing=timing),
        )

    def pack(self) -> dict[str, Any]:
        """Return the keyframe as arrays and plain values; each call returns the same object."""
        return self._packed

    @cached_property
    def _packed(self) -> dict[str, Any]:
        view, features = self.view, self.stored_features
        return {
            "gray": view.gray,
            "depth_m": view.depth_m,
            "camera": asdict(view.camera),
            "T_odom_keyframe": self.T_odom_keyframe,
            "id": self.id,
            "submap": self.submap,
            "moved_mask": self.moved_mask,
            "left_out": self.ignore_mask,
            "movable": self.dynamic_class_mask,
            "features": None if features is None else asdict(features),
            "relay": None if self.relay is None else asdict(self.relay),
            "motion": None if self.motion is None else self.motion.pack(),
        }

    @staticmethod
    def unpack(kept: dict[str, Any], config: PyramidConfig) -> "ReferenceKeyframe":
        """Return the keyframe from its packed form; `config` must be unchanged since packing."""
        features = None if kept["features"] is None else Features(**kept["features"])
        view = build_pyramid(kept["gray"], kept["depth_m"], Camera.of(kept["camera"]), config)
        return ReferenceKeyframe(
            view,
            kept["T_odom_keyframe"],
            kept["id"],
            kept["submap"],
            kept["moved_mask"],
            kept["left_out"],
            kept["movable"],
            features,
            Relay(**kept["relay"]) if kept.get("relay") else None,
            FrameMotion.unpack(kept["motion"]) if kept.get("motion") else None,
        )


def needs_keyframe(
    T_keyframe_camera: np.ndarray,
    overlap: float,
    median_depth_m: float,
    frames: int,
    config: KeyframeConfig,
) -> bool:
    """Return whether a frame should become the next reference keyframe.

    Args:
        T_keyframe_camera: Pose of the frame in the current reference keyframe, [4, 4].
        overlap: Fraction of the reference keyframe's surface that the frame shows, 0..1.
        median_depth_m: Median depth of the reference keyframe.
        frames: Number of frames since the reference keyframe.
        config: Settings.
    """
    if frames < config.min_frames:
        return False
    translation = se3.distance(T_keyframe_camera) / median_depth_m
    rotation_rad = se3.rotation_angle(T_keyframe_camera)
    if max(translation, rotation_rad) < config.still_motion and overlap > config.still_overlap:
        return False  # A robot that stands still must not add keyframes.
    return frames >= config.max_frames or left_keyframe_view(
        T_keyframe_camera, overlap, median_depth_m, config
    )


def left_keyframe_view(
    T_keyframe_camera: np.ndarray, overlap: float, median_depth_m: float, config: KeyframeConfig
) -> bool:
    """Return whether a frame is too far from a keyframe or shows too little of its surface.

    Args:
        T_keyframe_camera: Pose of the frame in the keyframe, [4, 4].
        overlap: Fraction of the keyframe's surface that the frame shows, 0..1.
        median_depth_m: Median depth of the keyframe.
        config: Limits.
    """
    is_elsewhere = limit_ratio(T_keyframe_camera, median_depth_m, config) > 1
    return is_elsewhere or overlap < config.min_overlap


def needs_mapping_keyframe(
    T_mapped_camera: np.ndarray, median_depth_m: float, config: KeyframeConfig
) -> bool:
    """Return whether the camera has moved far enough for a mapping keyframe.

    Args:
        T_mapped_camera: Pose of the camera relative to the last mapped frame, [4, 4].
        median_depth_m: Median depth of the reference keyframe.
        config: Limits.
    """
    left = limit_ratio(T_mapped_camera, median_depth_m, config)
    return left > config.mapping_only_ratio and config.mapping_only_ratio <= 1


def limit_ratio(
    T_keyframe_camera: np.ndarray, median_depth_m: float, config: KeyframeConfig
) -> float:
    """Return the camera motion since a keyframe as a fraction of the limits in `KeyframeConfig`.

    Args:
        T_keyframe_camera: Pose of the camera in its keyframe, [4, 4].
        median_depth_m: Median depth of the keyframe.
        config: Settings.

    Returns:
        The larger one of (translation / median depth) / max_translation and
        rotation / max_rotation_rad. Above 1, a new keyframe is needed.
    """
    translation = se3.distance(T_keyframe_camera) / median_depth_m
    rotation_rad = se3.rotation_angle(T_keyframe_camera)
    return max(translation / config.max_translation, rotation_rad / config.max_rotation_rad)


def limit_ratios(
    T_keyframe_camera: np.ndarray, median_depth_m: np.ndarray, config: KeyframeConfig
) -> np.ndarray:
    """Return the ratios [...] of `limit_ratio` for poses [..., 4, 4] and median depths [...]."""
    translation = se3.distances(T_keyframe_camera) / median_depth_m
    rotation_rad = se3.rotation_angles(T_keyframe_camera)
    return np.maximum(translation / config.max_translation, rotation_rad / config.max_rotation_rad)


def keyframe_dynamic_class_mask(
    view: Pyramid, boxes: Sequence[Box], config: DynamicClassConfig
) -> np.ndarray:
    """Return the mask of detected objects of dynamic classes, at the finest pyramid level.

    Args:
        view: Pyramid of the keyframe.
        boxes: Detections, in pixels of the full-resolution image.
        config: Settings.

    Returns:
        [H, W] bool; see `dynamic_class_mask`.
    """
    finest = view.levels[0]
    times = view.camera.width / finest.camera.width
    smaller = [box.in_smaller(times) for box in boxes]
    return dynamic_class_mask(smaller, finest.depth_m, config)
