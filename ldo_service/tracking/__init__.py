"""Camera poses from RGB-D frames: direct alignment to keyframes, relocalisation by features."""

from .alignment import AlignConfig, Alignment, align
from .odometry import Odometry, OdometryConfig
from .odometry_prior import Prior, PriorConfig, Reading
from .pyramid import Pyramid, PyramidConfig, Reference, build_reference, pyramid_of
from .tracking_quality import Status
from .tracking_result import TrackingResult

__all__ = [
    "AlignConfig",
    "Alignment",
    "Odometry",
    "OdometryConfig",
    "Prior",
    "PriorConfig",
    "Pyramid",
    "PyramidConfig",
    "Reading",
    "Reference",
    "Status",
    "TrackingResult",
    "align",
    "build_reference",
    "pyramid_of",
]
