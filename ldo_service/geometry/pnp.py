"""Camera pose from 3D points and their pixels, by PnP. Conventions: `ldo_service.geometry`."""

import cv2
import numpy as np

from . import se3
from .camera import Camera

REFERENCE_WIDTH, MIN_WIDTH = 640.0, 160  # Pixels; the inlier threshold scales with the image width.


def solve_pnp(
    points: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    *,
    reprojection_px: float,
    iterations: int,
    min_inliers: int,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Estimate the pose of a camera from 3D points and the pixels that show them.

    RANSAC starts from a fixed seed, so that equal input gives an equal result.

    Args:
        points: Points in the reference frame, [N, 3] meters.
        pixels: Pixels of these points in the camera, [N, 2].
        camera: Intrinsics of the camera, without distortion.
        reprojection_px: Inlier threshold in pixels, for an image 640 pixels wide. The threshold is
            scaled with the image width, which counts as at least 160 pixels.
        iterations: Maximum number of RANSAC iterations.
        min_inliers: Minimum number of inliers.

    Returns:
        T_camera_reference [4, 4] and the indices of the inliers [M]; None if PnP fails or finds
        fewer than `min_inliers`.
    """
    if len(points) < min_inliers:
        return None
    cv2.setRNGSeed(0)
    found, rotation_vector, translation, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        camera.matrix,
        None,
        iterationsCount=iterations,
        reprojectionError=reprojection_px * max(camera.width, MIN_WIDTH) / REFERENCE_WIDTH,
        flags=cv2.SOLVEPNP_ITERATIVE,
    )
    if not found or inliers is None or len(inliers) < min_inliers:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation_vector)[0], translation[:, 0]
    if not np.isfinite(T).all():
        return None
    return se3.orthonormalize(T), np.asarray(inliers[:, 0], np.int64)
