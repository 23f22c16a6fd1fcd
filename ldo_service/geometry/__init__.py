"""Conventions of the whole project, said once.

Transforms  `T_a_b` maps coordinates in b to coordinates in a: `p_a = T_a_b @ p_b`, so chains
            cancel by eye: `T_map_camera = T_map_keyframe @ T_keyframe_camera`. A 4x4 float64
            array in numerics; translation and quaternion wxyz on the wire.
Frames      `camera`: x right, y down, z forward (optical). `odom`: continuous, but after a loss.
            `map`: globally consistent, moves with corrections. `map` and `odom` start as the
            first camera frame. (REP-105)
Units       metres, radians, seconds; stamps are integer nanoseconds; depth is z, not range.
            0 depth means "not measured".
Pixels      centres are at integer coordinates: pixel (0, 0) covers [-0.5, 0.5]. Halving an image
            averages 2x2 blocks, and maps a coordinate c to (c + 0.5) / 2 - 0.5, for colour, depth
            and intrinsics alike.
Tangents    6-vectors and 6x6 matrices are ordered rotation (rad), then translation (m), the order
            of gtsam; perturbations multiply on the right: `T * exp(xi)`.
Shapes      batches lead. N Gaussians or points, K keyframes, H W image, C classes, M matches.
"""

from .camera import Camera
from .frames import RawFrame, Rectifier, RgbdFrame, rectify, undistortion_maps
from .stamps import associate
from .trajectory import Trajectory

__all__ = [
    "Camera",
    "RawFrame",
    "Rectifier",
    "RgbdFrame",
    "Trajectory",
    "associate",
    "rectify",
    "undistortion_maps",
]
