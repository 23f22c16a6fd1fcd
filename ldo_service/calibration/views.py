"""Calibration views, from which vignetting and depth bias are estimated, and pairs of views."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import cv2
import numpy as np

from ldo_service.geometry import Camera, RgbdFrame
from ldo_service.geometry.pnp import solve_pnp

VIEW_WIDTH = 160  # Pixels; the smooth errors need no finer images.
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
# A corner is tracked into the next image and back. It is dropped if it ends farther from its start.
MAX_RETURN_PX = 0.5
# Standard deviation of the local mean that is subtracted from the image, fraction of the width.
LOCAL_MEAN_RATIO = 8 / 640
RANSAC_ITERATIONS, RANSAC_PX = 100, 2.0


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """Frame of a camera, reduced to what the self-calibration compares."""

    number: int  # Running number of the view.
    camera: Camera  # Camera of the full image.
    block: int  # Side of a block, pixels. One pixel of the images below averages one block.
    depth_m: np.ndarray  # [h, w] float32; 0 where unknown or not on one surface.
    color: np.ndarray  # [h, w, 3] float32, blurred.
    is_exposed: np.ndarray  # [h, w] bool: no pixel nearby is clipped.
    tracks: np.ndarray  # [N] int64: numbers of the corners, ascending; the same in all views.
    corners: np.ndarray  # [N, 2] pixels of the full image.
    corner_depth_m: np.ndarray  # [N]; 0 where unknown.

    def pack(self) -> dict[str, Any]:
        """Return the view as arrays and plain values."""
        kept = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**kept, "camera": asdict(self.camera)}

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "CalibrationView":
        """Return the view from its packed form."""
        return CalibrationView(**{**kept, "camera": Camera.of(kept["camera"])})

    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Return u [1, w] and v [h, 1] of the block centers, in pixels of the full image."""
        height, width = self.depth_m.shape
        offset = (self.block - 1) / 2.0
        u = self.block * np.arange(width)[None, :] + offset
        return u, self.block * np.arange(height)[:, None] + offset


class ViewMaker:
    """Maker of calibration views, which tracks corners from each view to the next."""

    def __init__(self) -> None:
        self._flat: np.ndarray | None = None  # Last image without its local mean.
        self._tracks, self._corners = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        self._next_track = self._count = 0

    def pack(self) -> dict[str, Any]:
        """Return the state as arrays and plain values."""
        return {
            "flat": self._flat,
            "tracks": self._tracks,
            "corners": self._corners,
            "next_track": self._next_track,
            "count": self._count,
        }

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "ViewMaker":
        """Return the maker from its packed form."""
        maker = ViewMaker()
        maker._flat, maker._tracks, maker._corners = kept["flat"], kept["tracks"], kept["corners"]
        maker._next_track, maker._count = int(kept["next_track"]), int(kept["count"])
        return maker

    def make(self, frame: RgbdFrame) -> CalibrationView:
        """Reduce an uncorrected frame to a calibration view."""
        camera = frame.camera
        block = max(1, camera.width // VIEW_WIDTH)
        height, width = camera.height // block, camera.width // block
        color = frame.color[: height * block, : width * block]
        small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
        is_clipped = (color.max(axis=2) > MAX_GRAY) | (color.min(axis=2) < MIN_GRAY)
        is_clipped = np.asarray(_blocks(is_clipped, block).any(axis=(1, 3)), np.uint8)
        side = 2 * CLIPPED_BLOCKS + 1
        is_near_clipped = cv2.dilate(is_clipped, np.ones((side, side), np.uint8))
        self._track(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), camera.width)
        column, row = np.rint(self._corners).astype(int).T
        view = CalibrationView(
            self._count,
            camera,
            block,
            _surface_depth(frame.depth_m[: height * block, : width * block], block),
            cv2.GaussianBlur(small.astype(np.float32), (0, 0), BLUR_BLOCKS),
            is_near_clipped == 0,
            self._tracks,
            self._corners.astype(np.float64),
            frame.depth_m[row, column].astype(np.float64),
        )
        self._count += 1
        return view

    def _track(self, gray: np.ndarray, width: int) -> None:
        """Track the corners into this image, and add new corners where there are none.

        The local mean is subtracted first, because vignetting and exposure change the brightness of
        a corner from view to view.
        """
        mean = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), LOCAL_MEAN_RATIO * width)
        flat = np.clip(gray - mean + 128.0, 0, 255).astype(np.uint8)
        if self._flat is not None and self._flat.shape == flat.shape and len(self._corners):
            is_kept, corners = _follow(self._flat, flat, self._corners)
            self._tracks, self._corners = self._tracks[is_kept], corners[is_kept]
        else:
            self._tracks, self._corners = self._tracks[:0], self._corners[:0]
        distance = max(3.0, CORNER_DISTANCE_RATIO * width)
        free = np.full(gray.shape, 255, np.uint8)
        for u, v in np.rint(self._corners).astype(int).tolist():
            cv2.circle(free, (u, v), int(distance), 0, -1)
        missing = CORNERS - len(self._corners)
        if missing > 0:
            new = cv2.goodFeaturesToTrack(flat, missing, CORNER_QUALITY, distance, mask=free)
            new = np.zeros((0, 2), np.float32) if new is None else new.reshape(-1, 2)
            numbers = self._next_track + np.arange(len(new))
            self._next_track += len(new)
            self._tracks = np.r_[self._tracks, numbers]
            self._corners = np.r_[self._corners, new]
        self._flat = flat


def _follow(
    before: np.ndarray, now: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Track corners by pyramidal optical flow, there and back (Lucas and Kanade; Bouguet, 2000).

    Returns:
        Mask of the corners that were tracked, [N] bool, and the new pixels of all corners,
        [N, 2] float32.
    """
    options = {"winSize": (FLOW_WINDOW_PX, FLOW_WINDOW_PX), "maxLevel": FLOW_LEVELS}
    place = np.empty_like(corners)
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, place, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(now, before, there, place.copy(), **options)
    height, width = now.shape
    u, v = np.rint(there).T
    is_kept = (found[:, 0] > 0) & (returned[:, 0] > 0)
    is_kept &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
    is_kept &= np.linalg.norm(back - corners, axis=1) < MAX_RETURN_PX
    return is_kept, there


@dataclass(frozen=True, slots=True)
class ViewPair:
    """Two views that show the same surface, with the corners that both show."""

    first: int  # Number of the view whose depth is used.
    second: int
    T_second_first: np.ndarray  # [4, 4]
    pixels_first: np.ndarray  # [M, 2]
    depth_first_m: np.ndarray  # [M]
    pixels_second: np.ndarray  # [M, 2]

    def at(self, T_second_first: np.ndarray) -> "ViewPair":
        """Return the pair with another relative pose."""
        return replace(self, T_second_first=T_second_first)


def pair_of(first: CalibrationView, second: CalibrationView) -> ViewPair | None:
    """Estimate the relative pose of two views by PnP RANSAC from the corners that both show.

    Returns:
        The pair. None if the views have too few corners in common, if the corners hardly moved, or
        if PnP finds too few inliers.
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
    found = solve_pnp(
        first.camera.points_at(there[:, 0], there[:, 1], z),
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


def _blocks(image: np.ndarray, block: int) -> np.ndarray:
    """Return an image [h block, w block] as [h, block, w, block]."""
    height, width = image.shape
    return image.reshape(height // block, block, width // block, block)


def _surface_depth(depth_m: np.ndarray, block: int) -> np.ndarray:
    """Return the mean depth of each block that is completely on one surface; 0 elsewhere."""
    blocks = _blocks(depth_m, block)
    mean, lowest, highest = (f(blocks, axis=(1, 3)) for f in (np.mean, np.min, np.max))
    is_surface = (lowest > 0) & (highest < MAX_DEPTH_M)
    is_surface &= highest - lowest < SURFACE_STEP_RATIO * mean + SURFACE_STEP_M
    return np.where(is_surface, mean, 0.0).astype(np.float32)
