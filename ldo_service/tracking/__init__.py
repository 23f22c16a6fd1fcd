"""Camera poses from RGB-D frames: direct alignment to keyframes, relocalisation by features."""

from .align import AlignConfig, Alignment, align
from .judgement import Status
from .odometry import Odometry, OdometryConfig
from .prior import Prior, PriorConfig, Reading
from .pyramid import Pyramid, PyramidConfig, pyramid_of
from .reference import Reference, build_reference
from .tracked import Tracked

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
    "Tracked",
    "align",
    "build_reference",
    "pyramid_of",
]
