"""RGB-D odometry: direct alignment to keyframes and relocalization by features.

Masks and stored keyframes have the working resolution: that of the finest pyramid level, about
320 pixels wide (`PyramidConfig.working_width_px`).
"""

from .alignment import AlignConfig, Alignment, align
from .odometry import Odometry
from .odometry_config import OdometryConfig
from .odometry_prior import OdometryPriorBuffer, PriorConfig, PriorPose
from .pyramid import Pyramid, PyramidConfig, ReferencePoints, build_reference, pyramid_of
from .tracking_quality import TrackingStatus
from .tracking_result import TrackingResult

__all__ = [
    "AlignConfig",
    "Alignment",
    "Odometry",
    "OdometryConfig",
    "OdometryPriorBuffer",
    "PriorConfig",
    "PriorPose",
    "Pyramid",
    "PyramidConfig",
    "ReferencePoints",
    "TrackingResult",
    "TrackingStatus",
    "align",
    "build_reference",
    "pyramid_of",
]
