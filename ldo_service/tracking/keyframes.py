"""When a frame becomes a keyframe, and what is kept of it. Conventions: `ldo_service.geometry`."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from math import radians
from typing import Any

import numpy as np

from ldo_service.detection.dynamic_classes import Box, DynamicClassConfig, dynamic_class_mask
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3

from .features import FeatureConfig, Features, detect
from .pyramid import Pyramid, PyramidConfig, ReferencePoints, build_pyramid, build_reference


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    min_overlap: float = 0.85  # of the visible surface: below, new surface is worth mapping
    max_rotation_rad: float = radians(15.0)
    max_translation: float = 0.08  # of the median depth
    min_frames: int = 2  # at most every 2nd frame
    max_frames: int = 30  # at least every 30th, if the camera moved at all
    still_overlap: float = 0.97  # of the visible surface: above, and
    still_motion: float = 0.01  # rad, and fraction of the median depth: below, it stands still
    # Share of max_rotation_rad and max_translation after which a frame is mapped although tracking
    # goes on against the same keyframe: the map gains by more views, tracking by fewer references.
    # Kitchen, held-out views at equal iterations: +0.4 dB, the worst +2 dB. Above 1: none.
    supporting: float = 0.33

    def __post_init__(self) -> None:
        if not (0 <= self.still_overlap <= 1 and self.still_motion >= 0):
            raise ConfigError("still_overlap must be within 0..1, still_motion at least 0.")
        if not min(self.max_rotation_rad, self.max_translation, self.supporting) > 0:
            raise ConfigError(
                f"max_rotation_rad={self.max_rotation_rad:g}, max_translation="
                f"{self.max_translation:g} and supporting={self.supporting:g} must be positive."
            )
        if not 0 <= self.min_overlap <= 1:
            raise ConfigError(f"min_overlap={self.min_overlap:g} must be within 0..1.")
        if not 1 <= self.min_frames <= self.max_frames:
            raise ConfigError(
                f"min_frames={self.min_frames} must be at least 1 and at most "
                f"max_frames={self.max_frames}."
            )


@dataclass(frozen=True, eq=False)
class ReferenceKeyframe:
    """A frame that others are aligned to."""

    view: Pyramid
    T_odom_keyframe: np.ndarray  # [4, 4]
    id: int  # ascending, given by the odometry: a camera's frame numbers may start again
    submap: int = 0  # whose odometry frame T_odom_keyframe leads to
    moved_mask: np.ndarray | None = None  # [H, W] bool at working resolution, as `watch` found it
    ignore_mask: np.ndarray | None = None  # [H, W] bool: what of it was seen to move
    dynamic_class_mask: np.ndarray | None = (
        None  # [H, W] bool: what of it a detector knows to move by itself
    )
    stored_features: Features | None = None  # of a place; its image is smaller than what they saw

    @cached_property
    def reference(self) -> ReferencePoints:
        """Without what moves."""
        masks = [mask for mask in (self.ignore_mask, self.dynamic_class_mask) if mask is not None]
        return build_reference(self.view, np.logical_or.reduce(masks) if masks else None)

    def features(self, config: FeatureConfig) -> Features:
        """Detected when first asked for: most keyframes never are."""
        if self.stored_features is not None:
            return self.stored_features
        if "_features" not in self.__dict__:
            self.__dict__["_features"] = detect(self.view, config)
        return self.__dict__["_features"]

    def pack(self) -> dict[str, Any]:
        """Return arrays and plain values, the same object each time."""
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
        }

    @staticmethod
    def unpack(kept: dict[str, Any], config: PyramidConfig) -> "ReferenceKeyframe":
        """The inverse of `pack`, under the same configuration."""
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
        )


def needs_keyframe(
    T_keyframe_camera: np.ndarray,
    overlap: float,
    median_depth_m: float,
    frames: int,
    config: KeyframeConfig,
) -> bool:
    """Whether a view has left its keyframe far enough, `frames` frames after it."""
    if frames < config.min_frames:
        return False
    translation = se3.distances(T_keyframe_camera) / median_depth_m
    rotation_rad = se3.rotation_angle(T_keyframe_camera)
    if max(translation, rotation_rad) < config.still_motion and overlap > config.still_overlap:
        return False  # a robot that waits must not fill its map
    return frames >= config.max_frames or left_keyframe_view(
        T_keyframe_camera, overlap, median_depth_m, config
    )


def left_keyframe_view(
    T_keyframe_camera: np.ndarray, overlap: float, median_depth_m: float, config: KeyframeConfig
) -> bool:
    """Whether a view is elsewhere than its keyframe, or shows too little of it."""
    is_elsewhere = bool(limit_ratios(T_keyframe_camera, median_depth_m, config) > 1)
    return is_elsewhere or overlap < config.min_overlap


def needs_mapping_keyframe(
    T_mapped_camera: np.ndarray, median_depth_m: float, config: KeyframeConfig
) -> bool:
    """Whether a view has left the last one that was mapped far enough to support it."""
    left = float(limit_ratios(T_mapped_camera, median_depth_m, config))
    return left > config.supporting and config.supporting <= 1


def limit_ratios(
    T_keyframe_camera: np.ndarray, median_depth_m: np.ndarray | float, config: KeyframeConfig
) -> np.ndarray:
    """[...] of how far a camera may go before a keyframe is due, the larger share of translation
    and rotation. T_keyframe_camera [..., 4, 4], median_depth_m [...]."""
    translation = se3.distances(T_keyframe_camera) / median_depth_m
    rotation_rad = se3.rotation_angles(T_keyframe_camera)
    return np.maximum(translation / config.max_translation, rotation_rad / config.max_rotation_rad)


def keyframe_dynamic_class_mask(
    view: Pyramid, boxes: Sequence[Box], config: DynamicClassConfig
) -> np.ndarray:
    """`dynamic_class_mask` [H, W] bool at working resolution, of boxes in pixels of the whole
    image."""
    finest = view.levels[0]
    times = view.camera.width / finest.camera.width
    smaller = [box.in_smaller(times) for box in boxes]
    return dynamic_class_mask(smaller, finest.depth_m, config)
