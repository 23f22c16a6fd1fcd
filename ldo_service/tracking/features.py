"""Poses from sparse features with PnP RANSAC, and from point clouds with GICP.

Neither method needs an accurate initial guess. Tracking uses both after large motions, and
relocalization uses features alone. ORB is fast and sufficient from frame to frame. SIFT takes ten
times as long and also matches a surface that is half or twice as far away.

GICP (`small_gicp`) estimates the pose of scenes without texture from their shape. GICP pairs each
point with the nearest point of the other cloud, whereas the module `alignment` pairs points along
the viewing ray. GICP converges from larger initial errors than `alignment` and is less accurate.
Conventions: `ldo_service.geometry`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import small_gicp

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3
from ldo_service.geometry.pnp import solve_pnp
from ldo_service.kernels import _matching

from .pyramid import Level, Pyramid, ReferencePoints

SIFT_SIZE = 128  # Length of a SIFT descriptor.

NEIGHBORS = 10  # Points from which a point's covariance is estimated; default of small_gicp.


@dataclass(frozen=True, slots=True)
class FeatureConfig:
    """Settings of feature detection, matching and PnP RANSAC."""

    count: int = 1000  # Maximum number of ORB features, as in ORB-SLAM3 at 640x480.
    # FAST threshold, gray levels: the lower one of ORB-SLAM3, which finds corners in blurred
    # images.
    fast_threshold: int = 7
    # Maximum ratio of the distances to the nearest and to the second nearest descriptor (Lowe 2004,
    # 7.1, uses 0.8).
    ratio: float = 0.8
    # Maximum Hamming distance of ORB matches, bits of 256 (ORB-SLAM3: 100 loose, 50 tight).
    max_distance: int = 64
    # Maximum number of SIFT features of a frame; the strongest ones are kept. A keyframe record
    # has at most half as many.
    count_across_scales: int = 1000
    # SIFT contrast threshold as a fraction of the gray range. OpenCV's default of 0.04 finds few
    # features indoors.
    contrast: float = 0.01
    # Maximum reprojection error of an inlier, pixels at an image width of 640; scales with the
    # width.
    reprojection_px: float = 3.0
    ransac_iterations: int = 200
    min_inliers: int = 15  # ORB-SLAM3 relocalizes from 15 RANSAC inliers.

    def __post_init__(self) -> None:
        if min(self.count, self.count_across_scales, self.fast_threshold) < 1:
            raise ConfigError(
                named(self, "count", "count_across_scales", "fast_threshold")
                + " must be at least 1."
            )
        if self.ransac_iterations < 1 or self.min_inliers < 6:
            raise ConfigError(
                named(self, "ransac_iterations", "min_inliers")
                + ": ransac_iterations must be at least 1, and min_inliers must be at least 6."
            )
        if not (0 < self.ratio <= 1 and min(self.reprojection_px, self.contrast) > 0):
            raise ConfigError(
                named(self, "ratio", "reprojection_px", "contrast")
                + ": ratio must be within 0..1; reprojection_px and contrast must be positive."
            )


@dataclass(frozen=True, slots=True)
class Features:
    """Image features with their measured 3D points."""

    pixels: np.ndarray  # [N, 2] u and v in pixels.
    points_camera: np.ndarray  # [N, 3] meters in the camera; z = 0 where unmeasured.
    descriptors: np.ndarray  # [N, 32] uint8 bits of ORB, or [N, 128] uint8 gradients of SIFT.


@dataclass(frozen=True, slots=True)
class FeaturePose:
    """Pose of a frame from feature matches, with the number of RANSAC inliers."""

    T_camera_reference: np.ndarray  # [4, 4]
    inliers: int


def detect(view: Pyramid, config: FeatureConfig) -> Features:
    """Detect ORB features in the full-resolution image, and read the measured depth of each.

    The view keeps its features. A second call with the same settings returns them again.
    """
    if config not in view.features:
        view.features[config] = _detected(view, config)
    return view.features[config]


def _detected(view: Pyramid, config: FeatureConfig) -> Features:
    orb = cv2.ORB.create(nfeatures=config.count, fastThreshold=config.fast_threshold)
    keypoints, descriptors = orb.detectAndCompute(view.gray, None)
    if descriptors is None:
        keypoints, descriptors = (), np.zeros((0, 32), np.uint8)
    return _measured(keypoints, descriptors, view.depth_m, view.camera)


def detect_sift(
    gray: np.ndarray, depth_m: np.ndarray, camera: Camera, count: int, config: FeatureConfig
) -> Features:
    """Detect the strongest SIFT features (Lowe 2004), and read the measured depth of each.

    Args:
        gray: Image, [H, W] uint8.
        depth_m: Depth of the image, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the image.
        count: Maximum number of features.
        config: Settings.
    """
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=config.contrast)
    keypoints, descriptors = sift.detectAndCompute(gray, None)
    if descriptors is None:
        keypoints, descriptors = (), np.zeros((0, SIFT_SIZE))
    # SIFT descriptors are integers of 0..255 stored as float32.
    return _measured(keypoints, descriptors.astype(np.uint8), depth_m, camera)


def _measured(
    keypoints: Sequence[cv2.KeyPoint], descriptors: np.ndarray, depth_m: np.ndarray, camera: Camera
) -> Features:
    pixels = np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2)
    column, row = np.rint(pixels).astype(int).T
    measured_m = depth_m[row, column].astype(np.float64)
    u, v = pixels.T
    return Features(pixels, camera.points_at(u, v, measured_m), descriptors)


def match(reference: Features, frame: Features, config: FeatureConfig) -> np.ndarray:
    """Match features by descriptor, with Lowe's ratio test.

    Each feature occurs in at most one match.

    Returns:
        Index pairs, [M, 2]: a feature of the reference, then a feature of the frame.
    """
    if min(len(reference.pixels), len(frame.pixels)) < 2:
        return np.zeros((0, 2), int)
    is_sift = frame.descriptors.shape[1] == SIFT_SIZE
    nearest = _nearest_gradients if is_sift else _nearest_bits
    there, distance, second = nearest(reference.descriptors, frame.descriptors)
    farthest = np.inf if is_sift else config.max_distance
    here = np.flatnonzero(distance < np.minimum(config.ratio * second, farthest))
    order = here[np.lexsort((here, distance[here], there[here]))]
    # Keep the pair with the smallest distance for each frame feature.
    _, first = np.unique(there[order], return_index=True)
    return np.column_stack([order[first], there[order[first]]])


def _nearest_bits(
    reference: np.ndarray, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the nearest frame descriptor of each reference descriptor, by Hamming distance.

    Returns:
        Index of the nearest frame descriptor, its distance, and the distance of the second
        nearest one; [N] each.
    """
    count = len(reference)
    index, least, second = np.empty(count, np.int64), *np.empty((2, count), np.int32)
    _matching.nearest(reference, frame, index, least, second)
    return index, least, second


def _nearest_gradients(
    reference: np.ndarray, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the nearest frame descriptor of each reference descriptor, by Euclidean distance.

    The squared distances are integers below 2^24, which float32 represents exactly. The result
    therefore does not depend on the order of summation.

    Returns:
        The same arrays as `_nearest_bits`.
    """
    a, b = reference.astype(np.float32), frame.astype(np.float32)
    squares = np.sum(a * a, axis=1)[:, None] + np.sum(b * b, axis=1) - 2.0 * (a @ b.T)
    rows, nearest = np.arange(len(a)), squares.argmin(axis=1)
    best = squares[rows, nearest]
    squares[rows, nearest] = np.inf
    return nearest, np.sqrt(best), np.sqrt(squares.min(axis=1))


def estimate_pose(
    reference: Features, frame: Features, camera: Camera, config: FeatureConfig
) -> FeaturePose | None:
    """Estimate the pose of a frame by PnP RANSAC from the 3D points of the reference features.

    RANSAC starts from a fixed seed, so that equal input gives an equal result.

    Args:
        reference: Features of the reference keyframe; those without a measured depth are not used.
        frame: Features of the frame.
        camera: Intrinsics of the frame.
        config: Settings.

    Returns:
        The pose, or None if there are fewer inliers than `config.min_inliers`.
    """
    pairs = match(reference, frame, config)
    pairs = pairs[reference.points_camera[pairs[:, 0], 2] > 0]
    found = solve_pnp(
        reference.points_camera[pairs[:, 0]],
        frame.pixels[pairs[:, 1]],
        camera,
        reprojection_px=config.reprojection_px,
        iterations=config.ransac_iterations,
        min_inliers=config.min_inliers,
    )
    return None if found is None else FeaturePose(found[0], len(found[1]))


@dataclass(frozen=True, slots=True)
class GicpConfig:
    """Settings of GICP registration."""

    level: int = 2  # Pyramid level of the points: 80 pixels wide.
    spacing: float = 0.03  # Voxel size of the downsampled points, in median depths.
    # Maximum distance between corresponding points, in median depths; covers a large step of a
    # robot.
    reach: float = 0.25
    iterations: int = 30  # Maximum number of GICP iterations.
    min_partners: float = 0.6  # Minimum fraction of the frame's points with a correspondence.

    def __post_init__(self) -> None:
        if self.level < 0 or self.iterations < 1:
            raise ConfigError(
                named(self, "level", "iterations")
                + ": level must be at least 0, and iterations must be at least 1."
            )
        if not (0 < self.spacing < self.reach and 0 < self.min_partners <= 1):
            raise ConfigError(
                named(self, "spacing", "reach", "min_partners")
                + ": spacing must be positive and below reach; min_partners must be within 0..1."
            )


def register_gicp(
    reference: ReferencePoints, view: Pyramid, T_reference_camera: np.ndarray, config: GicpConfig
) -> np.ndarray | None:
    """Register the points of a frame to those of a reference by GICP (Koide 2024).

    GICP runs on one thread, so that equal input gives an equal result.

    Args:
        reference: Surface points of the reference keyframe.
        view: Pyramid of the frame.
        T_reference_camera: Initial guess, [4, 4].
        config: Settings.

    Returns:
        T_reference_camera [4, 4], or None if GICP does not converge or too few points correspond.
    """
    scale_m = reference.median_depth_m
    level = min(config.level, len(view.levels) - 1, len(reference.points) - 1)
    clouds = reference.points[level][:3].T, _points(view.levels[level])
    if min(map(len, clouds)) < NEIGHBORS:
        return None
    (there, tree), (here, _) = (_cloud(points, config.spacing * scale_m) for points in clouds)
    if min(there.size(), here.size()) < NEIGHBORS:
        return None
    found = small_gicp.align(
        there,
        here,
        tree,
        T_reference_camera,
        max_correspondence_distance=config.reach * scale_m,
        max_iterations=config.iterations,
    )
    if not found.converged or found.num_inliers < config.min_partners * here.size():
        return None
    return se3.orthonormalize(found.T_target_source)


def _cloud(points: np.ndarray, spacing_m: float) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
    return small_gicp.preprocess_points(points.astype(np.float64), spacing_m, NEIGHBORS)


def _points(level: Level) -> np.ndarray:
    """Return the 3D points [N, 3] of all pixels with depth, in meters in the camera frame."""
    points = level.camera.rays() * level.depth_m[..., None]
    return points[level.depth_m > 0]
