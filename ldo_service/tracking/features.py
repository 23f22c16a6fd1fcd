"""Pose from sparse features: ORB and PnP RANSAC, for large motions and relocalisation."""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3

from .pyramid import Pyramid


@dataclass(frozen=True, slots=True)
class FeatureConfig:
    count: int = 1000  # as ORB-SLAM3 at 640x480
    fast_threshold: int = 7  # grey levels; ORB-SLAM3's lower one: blurred images have no more
    ratio: float = 0.8  # of the best to the second distance (Lowe 2004, 7.1, at 0.8)
    max_distance: int = 64  # bits of 256 (ORB-SLAM3's loose threshold is 100, its tight one 50)
    reprojection_px: float = 3.0  # at 640 pixels wide; scaled with the image
    ransac_iterations: int = 200
    min_inliers: int = 15  # ORB-SLAM3 relocalises from 15 RANSAC inliers

    def __post_init__(self) -> None:
        if min(self.count, self.fast_threshold, self.ransac_iterations) < 1 or self.min_inliers < 6:
            raise ConfigError(
                "count, fast_threshold, ransac_iterations must be positive, min_inliers at least 6."
            )
        if not (0 < self.ratio <= 1 and self.reprojection_px > 0):
            raise ConfigError("ratio must be within 0..1 and reprojection_px positive.")


@dataclass(frozen=True, slots=True)
class Features:
    """pixels [N, 2]; points_camera [N, 3] m, z = 0 where unmeasured; descriptors [N, 32]."""

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
    pixels = np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2)
    column, row = np.rint(pixels).astype(int).T
    depth_m = view.depth_m[row, column].astype(np.float64)
    camera = view.camera
    rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = np.column_stack([rays, np.ones(len(rays))]) * depth_m[:, None]
    return Features(pixels, points, descriptors)


def match(reference: Features, frame: Features, config: FeatureConfig) -> np.ndarray:
    """Index pairs [M, 2] (reference, frame) that pass the ratio test, each feature used once."""
    if min(len(reference.pixels), len(frame.pixels)) < 2:
        return np.zeros((0, 2), int)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    closest: dict[int, tuple[float, int]] = {}  # of each frame feature: distance, reference
    for best, second in matcher.knnMatch(reference.descriptors, frame.descriptors, k=2):
        if best.distance < min(config.ratio * second.distance, config.max_distance):
            known = closest.get(best.trainIdx, (np.inf, -1))
            closest[best.trainIdx] = min(known, (best.distance, best.queryIdx))
    pairs = [(there, here) for here, (_, there) in sorted(closest.items())]
    return np.array(pairs, int).reshape(-1, 2)


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
    return FeaturePose(se3.orthonormalised(T), len(inliers)) if np.isfinite(T).all() else None
