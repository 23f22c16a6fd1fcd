"""Camera poses from RGB-D frames: direct alignment to keyframes, relocalisation by features."""

from .align import AlignConfig, Alignment, align
from .judgement import Status
from .odometry import Odometry, OdometryConfig
from .pyramid import Pyramid, PyramidConfig, pyramid_of
from .reference import Reference, build_reference
from .tracked import Tracked

__all__ = [
    "AlignConfig",
    "Alignment",
    "Odometry",
    "OdometryConfig",
    "Pyramid",
    "PyramidConfig",
    "Reference",
    "Status",
    "Tracked",
    "align",
    "build_reference",
    "pyramid_of",
]
