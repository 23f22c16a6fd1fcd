"""Pose from sparse features and PnP RANSAC, for large motions and relocalisation.

ORB is fast and enough from frame to frame. SIFT costs ten times as much and knows again what is
seen from twice as near or far.

Where nothing has a texture, the pose comes from shape alone: `small_gicp` pairs each point of a
cloud with its nearest neighbors, so it reaches farther than `alignment`, which pairs along the ray,
and is less accurate. Conventions: `ldo_service.geometry`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import small_gicp

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3

from .pyramid import Level, Pyramid, ReferencePoints

SIFT_SIZE = 128

NEIGHBORS = 10  # that the covariance of a point is taken from, small_gicp's default


@dataclass(frozen=True, slots=True)
class FeatureConfig:
    count: int = 1000  # as ORB-SLAM3 at 640x480
    fast_threshold: int = 7  # grey levels; ORB-SLAM3's lower one: blurred images have no more
    ratio: float = 0.8  # of the best to the second distance (Lowe 2004, 7.1, at 0.8)
    max_distance: int = 64  # bits of 256 (ORB-SLAM3's loose threshold is 100, its tight one 50)
    count_across_scales: int = 1000  # SIFT's of a frame, the strongest; half as many of a place
    contrast: float = 0.01  # SIFT's least, of the grey range; OpenCV's 0.04 finds little indoors
    reprojection_px: float = 3.0  # at 640 pixels wide; scaled with the image
    ransac_iterations: int = 200
    min_inliers: int = 15  # ORB-SLAM3 relocalises from 15 RANSAC inliers

    def __post_init__(self) -> None:
        if min(self.count, self.count_across_scales, self.fast_threshold) < 1:
            raise ConfigError("count, count_across_scales and fast_threshold must be positive.")
        if self.ransac_iterations < 1 or self.min_inliers < 6:
            raise ConfigError("ransac_iterations must be positive, min_inliers at least 6.")
        if not (0 < self.ratio <= 1 and min(self.reprojection_px, self.contrast) > 0):
            raise ConfigError("ratio must be within 0..1, reprojection_px and contrast positive.")


@dataclass(frozen=True, slots=True)
class Features:
    """pixels [N, 2]; points_camera [N, 3] m, z = 0 where unmeasured.

    descriptors [N, 32] uint8 are bits of ORB, [N, 128] uint8 are gradients of SIFT.
    """

    pixels: np.ndarray
    points_camera: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True, slots=True)
class FeaturePose:
    T_camera_reference: np.ndarray
    inliers: int


def detect(view: Pyramid, config: FeatureConfig) -> Features:
    """ORB features of the full-resolution image, with the depth under each."""
    orb = cv2.ORB.create(nfeatures=config.count, fastThreshold=config.fast_threshold)
    keypoints, descriptors = orb.detectAndCompute(view.gray, None)
    if descriptors is None:
        keypoints, descriptors = (), np.zeros((0, 32), np.uint8)
    return _measured(keypoints, descriptors, view.depth_m, view.camera)


def detect_sift(
    gray: np.ndarray, depth_m: np.ndarray, camera: Camera, count: int, config: FeatureConfig
) -> Features:
    """The strongest SIFT features (Lowe 2004) of a grey image [H, W] uint8, as `detect` has ORB."""
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=config.contrast)
    keypoints, descriptors = sift.detectAndCompute(gray, None)
    if descriptors is None:
        keypoints, descriptors = (), np.zeros((0, SIFT_SIZE))
    return _measured(keypoints, descriptors.astype(np.uint8), depth_m, camera)  # whole numbers


def _measured(
    keypoints: Sequence[cv2.KeyPoint], descriptors: np.ndarray, depth_m: np.ndarray, camera: Camera
) -> Features:
    pixels = np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2)
    column, row = np.rint(pixels).astype(int).T
    measured_m = depth_m[row, column].astype(np.float64)
    u, v = pixels.T
    return Features(pixels, camera.points_at(u, v, measured_m), descriptors)


def match(reference: Features, frame: Features, config: FeatureConfig) -> np.ndarray:
    """Index pairs [M, 2] (reference, frame) that pass the ratio test, each feature used once."""
    if min(len(reference.pixels), len(frame.pixels)) < 2:
        return np.zeros((0, 2), int)
    is_sift = frame.descriptors.shape[1] == SIFT_SIZE
    nearest = _nearest_gradients if is_sift else _nearest_bits
    there, distance, second = nearest(reference.descriptors, frame.descriptors)
    farthest = np.inf if is_sift else config.max_distance
    here = np.flatnonzero(distance < np.minimum(config.ratio * second, farthest))
    order = here[np.lexsort((here, distance[here], there[here]))]
    _, first = np.unique(there[order], return_index=True)  # the nearest of each frame feature
    return np.column_stack([order[first], there[order[first]]])


def _nearest_bits(
    reference: np.ndarray, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each reference descriptor: the nearest in the frame, its distance, and the second's."""
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(reference, frame, k=2)
    distances = np.array([(best.distance, second.distance) for best, second in pairs])
    return np.array([best.trainIdx for best, _ in pairs]), *distances.T


def _nearest_gradients(
    reference: np.ndarray, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Likewise; squares of whole numbers below 2^24 are exact in float32, in any order."""
    a, b = reference.astype(np.float32), frame.astype(np.float32)
    squares = np.sum(a * a, axis=1)[:, None] + np.sum(b * b, axis=1) - 2.0 * (a @ b.T)
    rows, nearest = np.arange(len(a)), squares.argmin(axis=1)
    best = squares[rows, nearest]
    squares[rows, nearest] = np.inf
    return nearest, np.sqrt(best), np.sqrt(squares.min(axis=1))


def estimate_pose(
    reference: Features, frame: Features, camera: Camera, config: FeatureConfig
) -> FeaturePose | None:
    """Pose of the frame's camera from the reference's 3D points; None without enough inliers.

    Deterministic: RANSAC's random numbers are seeded here.
    """
    pairs = match(reference, frame, config)
    pairs = pairs[reference.points_camera[pairs[:, 0], 2] > 0]
    if len(pairs) < config.min_inliers:
        return None
    cv2.setRNGSeed(0)
    found, rotation_vector, translation, inliers = cv2.solvePnPRansac(
        reference.points_camera[pairs[:, 0]],
        frame.pixels[pairs[:, 1]],
        camera.matrix,
        None,
        iterationsCount=config.ransac_iterations,
        reprojectionError=config.reprojection_px * max(camera.width, 160) / 640.0,
        flags=cv2.SOLVEPNP_ITERATIVE,
    )
    if not found or inliers is None or len(inliers) < config.min_inliers:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation_vector)[0], translation[:, 0]
    return FeaturePose(se3.orthonormalize(T), len(inliers)) if np.isfinite(T).all() else None


@dataclass(frozen=True, slots=True)
class GicpConfig:
    level: int = 2  # of the pyramid: 80 pixels wide
    spacing: float = 0.03  # of the points, in median depths
    reach: float = 0.25  # between partners, in median depths: a large step of a robot
    iterations: int = 30  # at most
    min_partners: float = 0.6  # share of the frame's points that find one

    def __post_init__(self) -> None:
        if self.level < 0 or self.iterations < 1:
            raise ConfigError(
                named(self, "level", "iterations")
                + ": level must not be negative, iterations at least 1."
            )
        if not (0 < self.spacing < self.reach and 0 < self.min_partners <= 1):
            raise ConfigError(
                named(self, "spacing", "reach", "min_partners")
                + ": 0 < spacing < reach and 0 < min_partners <= 1 are needed."
            )


def register_gicp(
    reference: ReferencePoints, view: Pyramid, T_reference_camera: np.ndarray, config: GicpConfig
) -> np.ndarray | None:
    """T_reference_camera [4, 4] by GICP (Koide 2024), from a guess; None where that finds nothing.

    Deterministic: one thread.
    """
    scale_m = reference.median_depth_m
    level = min(config.level, len(view.levels) - 1, len(reference.points) - 1)
    clouds = reference.points[level][:3].T, _points(view.levels[level])
    if min(map(len, clouds)) < NEIGHBORS:
        return None
    (there, tree), (here, _) = (_cloud(points, config.spacing * scale_m) for points in clouds)
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
    """[N, 3] of the pixels with depth."""
    points = level.camera.rays() * level.depth_m[..., None]
    return points[level.depth_m > 0]
