"""Geometry of cameras and frames, and the conventions of the whole project.

Transforms  `T_a_b` maps coordinates in b to coordinates in a: `p_a = T_a_b @ p_b`. Adjacent names
            cancel in a chain: `T_map_camera = T_map_keyframe @ T_keyframe_camera`. Code uses 4x4
            float64 arrays; messages use a translation and a quaternion wxyz.
Frames      `camera`: x right, y down, z forward (optical). `odom`: the odometry's frame, in which
            poses are continuous until tracking is lost. `map`: globally consistent; its poses
            change when the pose graph is optimized. `map` and `odom` initially equal the first
            camera frame. The names follow REP-105.
Units       Meters, radians, seconds. Stamps are integer nanoseconds. Depth is z, not range;
            0 means "not measured".
Pixels      Centers are at integer coordinates: pixel (0, 0) covers [-0.5, 0.5]. Halving an image
            averages 2x2 blocks and maps a coordinate c to (c + 0.5) / 2 - 0.5. This applies to
            color, depth and intrinsics alike.
Tangents    6-vectors and 6x6 matrices are ordered rotation (rad), then translation (m), as in
            gtsam. Perturbations multiply on the right: `T * exp(xi)`.
Shapes      Batch dimensions come first. N: Gaussians or points, K: keyframes, H, W: image size,
            C: classes, M: matches.
"""

from .camera import Camera
from .frames import RawFrame, Rectifier, RgbdFrame, rectify, undistortion_maps, valid_pixels
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
    "valid_pixels",
]
