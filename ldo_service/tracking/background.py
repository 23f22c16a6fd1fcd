"""Foreground of a new keyframe, in front of the background that older keyframes measured.

A person who stands still for a while looks static compared with the last frames. Older keyframes
that show the wall behind the person prove that the person is a moving object. Conventions:
`ldo_service.geometry`.
"""

from dataclasses import replace

import numpy as np

from ldo_service.geometry import se3

from .keyframe_database import KeyframeDatabase
from .motion import image_motions_rad
from .motion_segmentation import foreground_mask, grow_mask, shows_motion
from .odometry_config import OdometryConfig
from .pyramid import Pyramid
from .tracking_result import TrackedFrame

# Maximum number of older keyframes that the frame is compared with. They show the same view before
# the motion began.
MAX_RECORDS = 3
# Maximum image motion from an older keyframe to the frame. Within it, both images show mostly the
# same surface.
MAX_MOTION_RAD = 0.4


def with_foreground(
    tracked: TrackedFrame,
    view: Pyramid,
    database: KeyframeDatabase,
    config: OdometryConfig,
) -> TrackedFrame:
    """Add the pixels in front of the known background to the dynamic mask of a frame.

    If the frame shows no moving object, the mask stays as it is. Pixels in front of the background
    then show a new static object, which must be mapped.

    Args:
        tracked: The frame, which becomes a keyframe.
        view: Image pyramid of the frame.
        database: Records of earlier keyframes.
        config: Settings.
    """
    known, records = tracked.dynamic_mask, database.in_submap(tracked.submap)
    if known is None or not shows_motion(known) or not records:
        return tracked
    T_keyframe_odom = se3.inverse(np.array([record.T_odom_keyframe for record in records]))
    T_keyframe_camera = T_keyframe_odom @ tracked.T_odom_camera
    depths_m = np.array([record.median_depth_m for record in records])
    is_near = image_motions_rad(T_keyframe_camera, depths_m) < MAX_MOTION_RAD
    oldest_first = sorted(np.flatnonzero(is_near).tolist(), key=lambda i: records[i].id)
    noise, mask = config.align.residuals.noise, np.zeros_like(known)
    for i in oldest_first[:MAX_RECORDS]:
        older, T = records[i].keyframe(config.pyramid).view, T_keyframe_camera[i]
        scale = tracked.depth_noise_scale
        found = foreground_mask(view, older, T, scale, config.moving, noise, known)
        mask |= mask if found is None else found
    return replace(tracked, dynamic_mask=known | grow_mask(mask, view, config.moving))
