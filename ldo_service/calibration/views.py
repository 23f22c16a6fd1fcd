"""Calibration views and their pairs, from which vignetting and depth bias are estimated."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import reduce
from math import inf
from typing import Any

import cv2
import numpy as np

from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.geometry.pnp import solve_pnp
from ldo_service.kernels import _surfaces

from .outlines import COLUMNS, outline_points

VIEW_WIDTH = 160  # Pixels; the smooth errors need no finer images.
DEPTH_STRIDE = 8  # The median depth uses every eighth pixel along each axis.
MAX_DEPTH_M = 6.0  # Structured light and time of flight measure mostly noise beyond this depth.
# The pixels of a block, and neighboring blocks, belong to one surface if their depths differ by
# less than this fraction of the depth plus this length.
SURFACE_STEP_RATIO, SURFACE_STEP_M = 0.03, 0.01
# Standard deviation of the blur of colors, in blocks; it hides errors of the pixel positions.
BLUR_BLOCKS = 0.75
# Pixels with a channel outside MIN_GRAY..MAX_GRAY may be clipped. Their blocks are not compared,
# nor are the blocks up to CLIPPED_BLOCKS away.
MIN_GRAY, MAX_GRAY, CLIPPED_BLOCKS = 12, 248, 2
MIN_POINTS = 40  # Minimum number of PnP inliers of a pair.
MIN_MOTION_RATIO = 15 / 640  # Minimum median motion of a pair's corners, fraction of the width.
# Maximum number of tracked corners, minimum quality (`cv2.goodFeaturesToTrack`) and minimum
# distance of new corners, the distance as a fraction of the image width.
CORNERS, CORNER_QUALITY, CORNER_DISTANCE_RATIO = 300, 0.005, 15 / 640
FLOW_WINDOW_PX, FLOW_LEVELS = 13, 3
# Maximum number of iterations per corner and level, and the step that ends them, pixels.
# Corners that are lost use up all iterations.
FLOW_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.02)
# A corner is tracked into the next image and back. It is dropped if it ends farther from its start.
MAX_RETURN_PX = 0.5
# Standard deviation of the local mean that is subtracted from the image, fraction of the width.
LOCAL_MEAN_RATIO = 8 / 640
MEAN_STEP = 4  # The local mean is computed at a fourth of the resolution.
RANSAC_ITERATIONS, RANSAC_PX = 40, 2.0
# Steps that refine the pose of the tracker, and the minimum fraction of inliers that confirms it.
REFINEMENTS, MIN_INLIER_RATIO = 5, 0.5


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """Reduced frame with the depth, colors, corners and outlines that self-calibration compares."""

    number: int  # Running number of the view.
    camera: Camera  # Camera of the full image.
    # Side of a block of pixels of the full image. The images below have one pixel per block.
    block: int
    depth_m: np.ndarray  # [h, w] float32, mean depth; 0 where unknown or not on one surface.
    color: np.ndarray  # [h, w, 3] float32, 0..255, blurred.
    is_exposed: np.ndarray  # [h, w] bool: no pixel nearby is clipped.
    # Numbers of the N tracked corners, [N] int64, ascending. A corner has the same number in all
    # views.
    tracks: np.ndarray
    corners: np.ndarray  # [N, 2] pixels of the full image.
    corner_depth_m: np.ndarray  # [N]; 0 where unknown.
    T_odom_camera: np.ndarray | None = None  # Pose by the tracker, [4, 4]; None if LOST.
    # Velocity of the camera, [6] rotation in rad/s, then translation in m/s, in the camera frame; 0
    # if unknown.
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(6))
    # Points on outlines of near surfaces, [M, COLUMNS]; see `outlines`.
    outlines: np.ndarray = field(default_factory=lambda: np.zeros((0, COLUMNS), np.float32))

    def pack(self) -> dict[str, Any]:
        """Return the view as arrays and plain values."""
        kept = {each.name: getattr(self, each.name) for each in fields(self)}
        return {**kept, "camera": asdict(self.camera)}

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "CalibrationView":
        """Return the view from its packed form."""
        return CalibrationView(**{**kept, "camera": Camera.of(kept["camera"])})


def block_centers(camera: Camera, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the block centers of a view as u [1, w] and v [h, 1], in pixels of the full image.

    Args:
        camera: Camera of the full image.
        block: Side of a block, pixels.
    """
    u, v = (block * np.arange(n // block) + (block - 1) / 2 for n in (camera.width, camera.height))
    return u[None, :], v[:, None]


class ViewMaker:
    """Maker of calibration views, which tracks corners from each view to the next."""

    def __init__(self) -> None:
        self._flat: np.ndarray | None = None  # Last image without its local mean.
        self._tracks, self._corners = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        self._corner_depth_m = np.zeros(0)
        self._T_odom_last: np.ndarray | None = None  # Pose of the last view.
        self._next_track = self._count = 0

    def pack(self) -> dict[str, Any]:
        """Return the state as arrays and plain values."""
        return {
            "flat": self._flat,
            "tracks": self._tracks,
            "corners": self._corners,
            "corner_depth_m": self._corner_depth_m,
            "T_odom_last": self._T_odom_last,
            "next_track": self._next_track,
            "count": self._count,
        }

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "ViewMaker":
        """Return the maker from its packed form."""
        maker = ViewMaker()
        maker._flat, maker._tracks, maker._corners = kept["flat"], kept["tracks"], kept["corners"]
        # A state of an earlier version has no depth of the corners and no pose.
        maker._corner_depth_m = kept.get("corner_depth_m", np.zeros(len(maker._corners)))
        maker._T_odom_last = kept.get("T_odom_last")
        maker._next_track, maker._count = int(kept["next_track"]), int(kept["count"])
        return maker

    def make(
        self,
        frame: RgbdFrame,
        T_odom_camera: np.ndarray | None = None,
        velocity: np.ndarray | None = None,
    ) -> CalibrationView:
        """Reduce an uncorrected frame to a calibration view.

        Args:
            frame: The frame.
            T_odom_camera: Pose of the frame, [4, 4], which predicts the new pixels of the corners
                that were tracked in the last view; None while tracking is LOST.
            velocity: Velocity of the camera, see `CalibrationView.velocity`; None if unknown.
        """
        camera = frame.camera
        block = max(1, camera.width // VIEW_WIDTH)
        height, width = camera.height // block, camera.width // block
        color = frame.color[: height * block, : width * block]
        depth_m = frame.depth_m[: height * block, : width * block]
        small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
        is_exposed, _ = _extremes(cv2.inRange(color, (MIN_GRAY,) * 3, (MAX_GRAY,) * 3), block)
        side = 2 * CLIPPED_BLOCKS + 1
        is_exposed = cv2.erode(is_exposed, np.ones((side, side), np.uint8))
        T_now_last = None
        if T_odom_camera is not None and self._T_odom_last is not None:
            T_now_last = se3.inverse(T_odom_camera) @ self._T_odom_last
        expected = _expected(self._corners, self._corner_depth_m, camera, T_now_last)
        self._track(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), expected, camera.width)
        column, row = np.rint(self._corners).astype(int).T
        self._corner_depth_m = frame.depth_m[row, column].astype(np.float64)
        view = CalibrationView(
            self._count,
            camera,
            block,
            _surface_depth(depth_m, block),
            cv2.GaussianBlur(small.astype(np.float32), (0, 0), BLUR_BLOCKS),
            is_exposed > 0,
            self._tracks,
            self._corners.astype(np.float64),
            self._corner_depth_m,
            T_odom_camera,
            np.zeros(6) if velocity is None else velocity,
            outline_points(frame.color, frame.depth_m, camera),
        )
        self._T_odom_last = T_odom_camera
        self._count += 1
        return view

    def _track(self, gray: np.ndarray, expected: np.ndarray, width: int) -> None:
        """Track the corners into this image, and add new corners where there are none.

        The search begins at the expected corners [N, 2].

        The local mean is subtracted first, because vignetting and exposure change the brightness of
        a corner from view to view.
        """
        flat = _flattened(gray, LOCAL_MEAN_RATIO * width)
        if self._flat is not None and self._flat.shape == flat.shape and len(self._corners):
            is_kept, corners = _follow(self._flat, flat, self._corners, expected)
            self._tracks, self._corners = self._tracks[is_kept], corners[is_kept]
        else:
            self._tracks, self._corners = self._tracks[:0], self._corners[:0]
        missing = CORNERS - len(self._corners)
        if missing > 0:  # New corners are searched at half the resolution.
            distance = max(2.0, CORNER_DISTANCE_RATIO * width / 2)
            small = cv2.resize(flat, (flat.shape[1] // 2, flat.shape[0] // 2))
            free = np.full(small.shape, 255, np.uint8)
            for u, v in np.rint((self._corners - 0.5) / 2).astype(int).tolist():
                cv2.circle(free, (u, v), int(distance), 0, -1)
            new = cv2.goodFeaturesToTrack(small, missing, CORNER_QUALITY, distance, mask=free)
            new = np.zeros((0, 2), np.float32) if new is None else 2 * new.reshape(-1, 2) + 0.5
            numbers = self._next_track + np.arange(len(new))
            self._next_track += len(new)
            self._tracks = np.r_[self._tracks, numbers]
            self._corners = np.r_[self._corners, new]
        self._flat = flat


def _flattened(gray: np.ndarray, sigma_px: float) -> np.ndarray:
    """Subtract the local mean of an image [H, W] uint8, which becomes 128."""
    height, width = gray.shape
    small = cv2.resize(
        gray, (width // MEAN_STEP, height // MEAN_STEP), interpolation=cv2.INTER_AREA
    )
    mean = cv2.GaussianBlur(small, (0, 0), sigma_px / MEAN_STEP)
    return np.asarray(cv2.addWeighted(gray, 1.0, cv2.resize(mean, (width, height)), -1.0, 128.0))


def _expected(
    corners: np.ndarray, depth_m: np.ndarray, camera: Camera, T_now_last: np.ndarray | None
) -> np.ndarray:
    """Return where the corners [N, 2] of the last view are after a motion, [N, 2] float32.

    A corner without depth moves like a corner at the median depth. If the motion is unknown, the
    corners stay where they are.
    """
    is_known = depth_m > 0
    if T_now_last is None or not is_known.any():
        return corners
    z = np.where(is_known, depth_m, np.median(depth_m[is_known]))
    u, v = corners.T.astype(np.float64)
    points = camera.points_at(u, v, z)
    points = points @ T_now_last[:3, :3].T + T_now_last[:3, 3]
    is_ahead = points[:, 2] > 0.1
    moved = camera.project(np.where(is_ahead[:, None], points, [0.0, 0.0, 1.0]))
    return np.where(is_ahead[:, None], moved, corners).astype(np.float32)


def _follow(
    before: np.ndarray, now: np.ndarray, corners: np.ndarray, expected: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Track corners by pyramidal optical flow, forward and back (Lucas and Kanade; Bouguet, 2000).

    Returns:
        Mask of the corners that were tracked, [N] bool, and the new pixels of all corners,
        [N, 2] float32.
    """
    options = {
        "winSize": (FLOW_WINDOW_PX, FLOW_WINDOW_PX),
        "maxLevel": FLOW_LEVELS,
        "criteria": FLOW_STEPS,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, expected.copy(), **options)
    start = there - (expected - corners)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(now, before, there, start, **options)
    height, width = now.shape
    u, v = np.rint(there).T
    is_kept = (found[:, 0] > 0) & (returned[:, 0] > 0)
    is_kept &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
    is_kept &= np.linalg.norm(back - corners, axis=1) < MAX_RETURN_PX
    return is_kept, there


@dataclass(frozen=True, slots=True)
class ViewPair:
    """Two views of the same surface, with their common corners."""

    first: int  # Number of the view whose depth is used.
    second: int  # Number of the other view.
    T_second_first: np.ndarray  # [4, 4]
    # The M common corners: pixels of the full images, and depth in the first view.
    pixels_first: np.ndarray  # [M, 2]
    depth_first_m: np.ndarray  # [M]
    pixels_second: np.ndarray  # [M, 2]

    def at(self, T_second_first: np.ndarray) -> "ViewPair":
        """Return the pair with another relative pose."""
        return replace(self, T_second_first=T_second_first)


def pair_of(first: CalibrationView, second: CalibrationView) -> ViewPair | None:
    """Estimate the relative pose of two views from the corners that both show.

    The relative pose by the tracker is refined. If the tracker has no such pose, or if too few
    corners agree with the refined pose, PnP RANSAC estimates the pose.

    Returns:
        The pair. None if the views have too few corners in common, if the corners hardly moved, or
        if too few corners agree on a pose.
    """
    _, i, j = np.intersect1d(first.tracks, second.tracks, assume_unique=True, return_indices=True)
    has_depth = first.corner_depth_m[i] > 0
    i, j = i[has_depth], j[has_depth]
    if len(i) < MIN_POINTS:
        return None
    there, here, z = first.corners[i], second.corners[j], first.corner_depth_m[i]
    moved_px = float(np.median(np.linalg.norm(there - here, axis=1)))
    if moved_px < MIN_MOTION_RATIO * first.camera.width:
        return None
    points = first.camera.points_at(there[:, 0], there[:, 1], z)
    found = None
    if first.T_odom_camera is not None and second.T_odom_camera is not None:
        T_second_first = se3.inverse(second.T_odom_camera) @ first.T_odom_camera
        found = _refined(points, here, first.camera, T_second_first)
    if found is None:
        found = solve_pnp(
            points,
            here,
            first.camera,
            reprojection_px=RANSAC_PX,
            iterations=RANSAC_ITERATIONS,
            min_inliers=MIN_POINTS,
        )
    if found is None:
        return None
    T_second_first, k = found
    return ViewPair(first.number, second.number, T_second_first, there[k], z[k], here[k])


def _refined(
    points: np.ndarray, pixels: np.ndarray, camera: Camera, T: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Refine a pose by Gauss-Newton steps with robust weights.

    Args:
        points: Points in the first camera, [N, 3] meters.
        pixels: Their pixels in the second camera, [N, 2].
        camera: Intrinsics of both views.
        T: Initial transform from the first camera to the second one, [4, 4].

    Returns:
        The refined pose and the indices of the inliers, [M]; None if fewer than half of the corners
        are inliers.
    """
    limit_px = RANSAC_PX * camera.width / 640.0
    for _ in range(REFINEMENTS):
        errors, by_point, _ = reprojection(camera, T, points, pixels)
        size_px = np.sqrt(np.sum(errors**2, axis=1))
        scale_px = max(_median(size_px), 0.5 * limit_px)
        weight = 1.0 / (1.0 + (size_px / scale_px) ** 2)
        J, r = by_point.reshape(-1, 6), errors.reshape(-1)
        weighted = J * np.repeat(weight, 2)[:, None]
        step = np.linalg.solve(weighted.T @ J + 1e-9 * np.eye(6), weighted.T @ r)
        T = se3.exp(-step) @ T
    errors, _, _ = reprojection(camera, T, points, pixels)
    inliers = np.flatnonzero(np.sum(errors**2, axis=1) < limit_px**2)
    is_enough = len(inliers) >= max(MIN_POINTS, MIN_INLIER_RATIO * len(points))
    return (se3.orthonormalize(T), inliers) if is_enough else None


def _median(values: np.ndarray) -> float:
    """Return the median of values [N], N > 0; `np.median` takes longer for its checks."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    return float(np.partition(values, (half - 1, half))[half - 1 : half + 1].mean())


def reprojection(
    camera: Camera, T: np.ndarray, points: np.ndarray, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return reprojection errors, their derivatives, and the points in the camera frame.

    Args:
        camera: Intrinsics.
        T: Transform of the points into the camera, [4, 4].
        points: Points, [N, 3] meters.
        pixels: Measured pixels, [N, 2].

    Returns:
        Errors [N, 2] in pixels; their derivatives [N, 2, 6] with respect to the increment x of
        the transform exp(x) T, rotation first; and the points in the camera frame, [N, 3] meters.
    """
    count = len(points)
    errors, moved = np.empty((count, 2)), np.empty((count, 3))
    by_transform = np.empty((count, 2, 6))
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    _surfaces.reproject(points, pixels, T, intrinsics, errors, by_transform, moved)
    return errors, by_transform, moved


def _extremes(image: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum and maximum of each block of an image [h block, w block, ...]."""
    pixels = [image[row::block, column::block] for row, column in np.ndindex(block, block)]
    return reduce(np.minimum, pixels), reduce(np.maximum, pixels)


def _surface_depth(depth_m: np.ndarray, block: int) -> np.ndarray:
    """Return the mean depth of each block that is completely on one surface; 0 elsewhere."""
    lowest, highest = _extremes(depth_m, block)
    mean = cv2.resize(depth_m, lowest.shape[::-1], interpolation=cv2.INTER_AREA)
    is_surface = (lowest > 0) & (highest < MAX_DEPTH_M)
    is_surface &= highest - lowest < SURFACE_STEP_RATIO * mean + SURFACE_STEP_M
    return np.where(is_surface, mean, np.float32(0.0))


def median_depth_m(frame: RgbdFrame) -> float:
    """Return the median depth of a frame in meters; infinity if it has no depth."""
    measured_m = frame.depth_m[::DEPTH_STRIDE, ::DEPTH_STRIDE]
    measured_m = measured_m[measured_m > 0]
    return float(np.median(measured_m)) if measured_m.size else inf
