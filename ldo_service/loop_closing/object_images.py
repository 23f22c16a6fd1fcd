"""Comparison of the images of an object in two keyframes.

A clock on a wall has the same depth as the wall, so only the image can show that the clock is
missing. The comparison needs the relative pose of the keyframes. Conventions:
`ldo_service.geometry`.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.geometry import Camera, se3

# Radius of an object in standard deviations of its Gaussians. A uniform distribution ends at 1.73.
RADIUS = 2.0
MIN_SIGMA_M = 0.01  # Added to the extent of an object, which may be flat.
NEAREST_M = 0.05  # Minimum depth of the points of a ray; the renderer has the same limit.
# A surface at another depth is at least this far away: 2 cm for the errors of poses and Gaussians,
# and three standard deviations of the depth.
MARGIN_M = 0.02
DEPTH_SIGMAS = 3.0
GRID = 20  # Maximum rows and columns of the compared pixels.
# Minimum number of different pixels in either image. If the errors of 60 pixels are independent,
# the correlation of unrelated images is 0 +- 0.13. Neighboring pixels are not independent.
MIN_PIXELS = 60
MIN_SIZE_PX = 6.0  # Minimum width and height of the object in the first image.
SMOOTH_PX = 3  # Width of the smoothed block of pixels: poses have an error of about a pixel.


def depth_sigma_m(depth_m: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the depth of a structured-light camera, meters.

    The formula is the axial noise model of Nguyen, Izadi and Lovell (3DIMPVT 2012).
    """
    return 0.0012 + 0.0019 * (depth_m - 0.4) ** 2


@dataclass(frozen=True, eq=False, slots=True)
class PosedImage:
    """Image and depth of a keyframe with its pose.

    Attributes:
        gray: Smoothed gray image, [H, W] float32; NaN near ignored pixels.
        depth_m: Depth, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the image and of the depth.
        T_map_camera: Pose, [4, 4].
    """

    gray: np.ndarray
    depth_m: np.ndarray
    camera: Camera
    T_map_camera: np.ndarray


def smoothed(gray: np.ndarray) -> np.ndarray:
    """Smooth a gray image [H, W]: each pixel becomes the mean of the block around it, float32.

    A block is `SMOOTH_PX` pixels wide and high. The mean is NaN if the block contains an ignored
    pixel. Ignored pixels, such as overexposed ones, have the gray level 0.
    """
    block = np.ones((SMOOTH_PX, SMOOTH_PX), np.uint8)
    means = cv2.blur(gray.astype(np.float32), block.shape)
    return np.where(cv2.erode(gray, block) > 0, means, np.nan).astype(np.float32)


@dataclass(frozen=True, slots=True)
class ImageComparison:
    """Comparison of two images of an object."""

    correlation: float  # Normalized correlation, -1..1.
    contrast: float  # Standard deviation of the first image, gray levels.


def compare_images(
    p_map: np.ndarray, covariance: np.ndarray, first: PosedImage, second: PosedImage
) -> ImageComparison | None:
    """Compare the images of an object in two keyframes.

    The compared pixels form a grid on the object in the first image. The depth of each pixel gives
    a surface point, which the keyframe poses transform to the second camera. A point is left out if
    its depth in this camera differs from the measured depth. The result contains the correlation
    of the gray levels of the remaining points. Exposure and brightness do not change this
    normalized correlation.

    Args:
        p_map: Centroid of the object, [3], meters.
        covariance: Covariance of the positions of the object's Gaussians, [3, 3], m^2.
        first: Keyframe that shows the object.
        second: Keyframe to compare.

    Returns:
        The comparison. None if fewer than `MIN_PIXELS` pixels of either image can be compared, for
        example because the object is far away from one camera.
    """
    u, v, p = _surface(p_map, covariance, first)
    if len(u) < MIN_PIXELS:
        return None
    p = se3.transform(se3.inverse(second.T_map_camera) @ first.T_map_camera, p)
    ahead = np.flatnonzero(p[:, 2] > NEAREST_M)
    pixels = np.rint(second.camera.project(p[ahead])).astype(np.int64)
    inside = np.all((pixels >= 0) & (pixels < [second.camera.width, second.camera.height]), axis=1)
    ahead, (u_there, v_there) = ahead[inside], pixels[inside].T
    there_m = second.depth_m[v_there, u_there]
    gate_m = MARGIN_M + DEPTH_SIGMAS * depth_sigma_m(there_m)
    same = (there_m > 0) & (np.abs(there_m - p[ahead, 2]) < gate_m)
    at = ahead[same]
    a, b = first.gray[v[at], u[at]], second.gray[v_there[same], u_there[same]]
    both = np.isfinite(a) & np.isfinite(b)
    pixels_there = (v_there * second.camera.width + u_there)[same][both]
    if len(np.unique(pixels_there)) < MIN_PIXELS:
        return None
    a, b = a[both] - a[both].mean(), b[both] - b[both].mean()
    correlation = float((a * b).mean() / max(a.std() * b.std(), 1e-6))
    return ImageComparison(correlation, float(a.std()))


def _surface(
    p_map: np.ndarray, covariance: np.ndarray, image: PosedImage
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels u, v [N] on an object, and their points in camera coordinates [N, 3]."""
    nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
    camera, T = image.camera, se3.inverse(image.T_map_camera)
    R, c = T[:3, :3], se3.transform(T, p_map)
    spread = R @ (covariance + MIN_SIGMA_M**2 * np.eye(3)) @ R.T
    if c[2] <= NEAREST_M:
        return nothing
    # First-order projection of the covariance to the image.
    jacobian = np.array(
        [
            [camera.fx / c[2], 0, -camera.fx * c[0] / c[2] ** 2],
            [0, camera.fy / c[2], -camera.fy * c[1] / c[2] ** 2],
        ]
    )
    half = RADIUS * np.sqrt(np.diag(jacobian @ spread @ jacobian.T))
    center = camera.project(c[None])[0]
    low = np.maximum(center - half, 0)
    high = np.minimum(center + half, [camera.width - 1, camera.height - 1])
    if np.any(high - low < MIN_SIZE_PX):
        return nothing
    sides = [np.unique(np.rint(np.linspace(low[k], high[k], GRID))).astype(int) for k in (0, 1)]
    u, v = (side.ravel() for side in np.meshgrid(*sides))
    z = image.depth_m[v, u]
    u, v, z = u[z > 0], v[z > 0], z[z > 0]
    p = camera.points_at(u.astype(float), v.astype(float), z.astype(float))
    d = p - c
    on = np.einsum("ni,ij,nj->n", d, np.linalg.inv(spread), d) <= RADIUS**2
    return u[on], v[on], p[on]
