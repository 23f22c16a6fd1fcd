"""Settings of odometry and all its steps."""

from dataclasses import dataclass, field

from ldo_service.detection.dynamic_classes import DynamicClassConfig
from ldo_service.errors import ConfigError
from ldo_service.kernels.gpu.device import Device

from .alignment import AlignConfig
from .features import FeatureConfig, GicpConfig
from .keyframe_database import KeyframeDatabaseConfig
from .keyframe_reuse import KeyframeReuseConfig
from .keyframes import KeyframeConfig
from .motion_segmentation import MotionSegmentationConfig
from .odometry_prior import PriorConfig
from .pose_candidates import PoseHypothesisConfig
from .pyramid import PyramidConfig
from .relocalization import RelocalizationConfig
from .shutter import ShutterConfig
from .submaps import SubmapConfig
from .tracking_quality import TrackingQualityConfig
from .window import WindowConfig


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Settings of odometry and all its steps."""

    # Device of the alignment; cuda: a GPU if it passes a self-test, otherwise the CPU.
    device: Device = "cpu"
    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    shape: GicpConfig = field(default_factory=GicpConfig)
    candidates: PoseHypothesisConfig = field(default_factory=PoseHypothesisConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    keyframe_database: KeyframeDatabaseConfig = field(default_factory=KeyframeDatabaseConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    keyframe_reuse: KeyframeReuseConfig = field(default_factory=KeyframeReuseConfig)
    submaps: SubmapConfig = field(default_factory=SubmapConfig)
    tracking_quality: TrackingQualityConfig = field(default_factory=TrackingQualityConfig)
    moving: MotionSegmentationConfig = field(default_factory=MotionSegmentationConfig)
    movable: DynamicClassConfig = field(default_factory=DynamicClassConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    shutter: ShutterConfig = field(default_factory=ShutterConfig)
    # Image motion, in image widths per frame, above which all initial guesses are tried. The
    # default is 2 pixels of the coarsest pyramid level.
    large_motion: float = 0.05

    def __post_init__(self) -> None:
        if not self.large_motion > 0:
            raise ConfigError(
                f"OdometryConfig.large_motion={self.large_motion:g} must be positive."
            )
