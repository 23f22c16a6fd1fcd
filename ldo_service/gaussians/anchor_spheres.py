"""Where the Gaussians of each anchor are, roughly, and from where they may be seen."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf

import numpy as np

from ldo_service.geometry import Camera, se3

# What `render` draws of a Gaussian ends where alpha = 1/255: sqrt(2 ln 255) standard deviations.
# At the rim of the image its affine splats are up to 1.3 times as wide as the ellipsoid there,
# which is how far outside the image the Jacobian is still taken (kernels/projection.hpp).
REACH_SIGMA = 1.3 * 3.33
LOW_PASS_PX = 2.0  # 3.33 times the square root of the 0.3 px^2 that every splat is widened by
NEAR_M = 0.05  # the renderer draws nothing nearer
_MAX_LOG_SCALE = 50.0  # as good as infinite, and no overflow
_ROUNDING = 1.000_01  # of sums in float32


@dataclass(frozen=True, eq=False, slots=True)
class PlacedCamera:
    """A camera without distortion at T_map_camera [4, 4]."""

    camera: Camera
    T_map_camera: np.ndarray

    def distances_m(self, centers_map: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
        """To the nearest point of each sphere [K]; negative inside."""
        return np.linalg.norm(centers_map - self.T_map_camera[:3, 3], axis=1) - radii_m

    def may_see(
        self, centers_map: np.ndarray, radii_m: np.ndarray, reach_m: float = inf
    ) -> np.ndarray:
        """Which spheres [K] bool touch the view volume, up to `reach_m` away.

        centers_map [K, 3], radii_m [K]. True for some that are just outside; false for none that
        is inside, nor for any that holds NaN. What stands in front is not looked at.
        """
        centers = se3.transform(se3.inverse(self.T_map_camera), centers_map)
        beside = np.any(centers @ self._sides().T < -radii_m[:, None], axis=1)
        behind = centers[:, 2] + radii_m < NEAR_M
        beyond = self.distances_m(centers_map, radii_m) > reach_m
        return ~(beside | behind | beyond)

    def _sides(self) -> np.ndarray:
        """Inward normals [4, 3] of the planes through the camera and the rim of the image."""
        camera, rim = self.camera, 0.5 + LOW_PASS_PX
        left, right = -rim - camera.cx, camera.width - 1 + rim - camera.cx
        top, bottom = -rim - camera.cy, camera.height - 1 + rim - camera.cy
        normals = np.array(
            [
                [camera.fx, 0, -left],
                [-camera.fx, 0, right],
                [0, camera.fy, -top],
                [0, -camera.fy, bottom],
            ]
        )
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False, slots=True)
class AnchorSpheres:
    """A sphere around all that is drawn of each anchor's Gaussians.

    anchors  [K] ascending
    counts   [K] Gaussians
    centers  [K, 3] in the anchor's camera frame, so that they stay when the anchor moves
    radii_m  [K]
    """

    anchors: np.ndarray
    counts: np.ndarray
    centers: np.ndarray
    radii_m: np.ndarray

    @classmethod
    def around(
        cls, rows: np.ndarray, anchors: np.ndarray, T_map_anchor: Mapping[int, np.ndarray]
    ) -> "AnchorSpheres":
        """Of Gaussians rows [N, 16] in the map that hang on anchors [N], by anchor T_map_anchor
        [4, 4]. Raises KeyError for an anchor without a pose. Linear in N."""
        rows, anchors = _grouped(rows, anchors)
        starts = np.flatnonzero(np.diff(anchors, prepend=anchors[:1] - 1))
        found, counts = anchors[starts], np.diff(starts, append=len(anchors))
        spheres = [_sphere(rows[i : i + n]) for i, n in zip(starts, counts, strict=True)]
        centers_map = np.array([center for center, _ in spheres]).reshape(-1, 3)
        centers = _applied(se3.inverse(_stacked(found, T_map_anchor)), centers_map)
        return cls(found, counts, centers, np.array([radius for _, radius in spheres]))

    def __len__(self) -> int:
        return len(self.anchors)

    def centers_map(self, T_map_anchor: Mapping[int, np.ndarray]) -> np.ndarray:
        """[K, 3] with the anchors at these poses."""
        return _applied(_stacked(self.anchors, T_map_anchor), self.centers)


def _grouped(rows: np.ndarray, anchors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Anchors ascend: as they do in a map whose keyframes were inserted one after the other."""
    if np.all(anchors[1:] >= anchors[:-1]):
        return rows, anchors
    order = np.argsort(anchors, kind="stable")
    return rows[order], anchors[order]


def _sphere(rows: np.ndarray) -> tuple[np.ndarray, float]:
    """Center [3] in the map and radius in metres of what is drawn of rows [M, 16]."""
    columns = np.ascontiguousarray(rows[:, :6].T)
    means, log_scales = columns[:3], columns[3:].max(axis=0)
    center = (means.min(axis=1) + means.max(axis=1)) / 2
    distances_m = np.sqrt(np.square(means - center[:, None]).sum(axis=0))
    reach_m = REACH_SIGMA * np.exp(np.minimum(log_scales, _MAX_LOG_SCALE))
    return center, _ROUNDING * float(np.max(distances_m + reach_m))


def _stacked(anchors: np.ndarray, T_map_anchor: Mapping[int, np.ndarray]) -> np.ndarray:
    return np.array([T_map_anchor[int(k)] for k in anchors], float).reshape(-1, 4, 4)


def _applied(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return (T[:, :3, :3] @ points[:, :, None])[..., 0] + T[:, :3, 3]
