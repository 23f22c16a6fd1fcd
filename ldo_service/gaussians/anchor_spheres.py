"""Where Gaussians are, roughly, and from where they may be seen."""

from dataclasses import dataclass
from math import inf

import numpy as np

from ldo_service.geometry import Camera, se3

from .horizon import LOW_PASS_PX, Horizon

# What `render` draws of a Gaussian ends where alpha = 1/255: sqrt(2 ln 255) standard deviations.
# At the rim of the image its affine splats are up to 1.3 times as wide as the ellipsoid there,
# which is how far outside the image the Jacobian is still taken (kernels/projection.hpp).
REACH_SIGMA = 1.3 * 3.33
NEAR_M = 0.05  # the renderer draws nothing nearer
_MAX_LOG_SCALE = 50.0  # as good as infinite, and no overflow
_ROUNDING = 1.000_01  # of what the renderer adds up in float32


@dataclass(frozen=True, eq=False, slots=True)
class PlacedCamera:
    """A camera without distortion at T_map_camera [4, 4], and how far it saw there; None: who
    knows."""

    camera: Camera
    T_map_camera: np.ndarray
    horizon: Horizon | None = None

    def distances_m(self, centers_map: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
        """To the nearest point of each sphere [K]; negative inside."""
        return np.linalg.norm(centers_map - self.T_map_camera[:3, 3], axis=1) - radii_m

    def may_see(
        self, centers_map: np.ndarray, radii_m: np.ndarray, reach_m: float = inf
    ) -> np.ndarray:
        """Which spheres [K] bool touch the view volume, up to `reach_m` away.

        centers_map [K, 3], radii_m [K]. True for some that are just outside; false for none that
        is inside and not hidden behind the horizon, nor for any that holds NaN.
        """
        centers = se3.transform(se3.inverse(self.T_map_camera), centers_map)
        beside = np.any(centers @ self._sides().T < -radii_m[:, None], axis=1)
        behind = centers[:, 2] + radii_m < NEAR_M
        beyond = self.distances_m(centers_map, radii_m) > reach_m
        seen = ~(beside | behind | beyond)
        if self.horizon is not None:
            seen[seen] = ~self.horizon.hides(self.camera, centers[seen], radii_m[seen])
        return seen

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
    """Spheres around all that is drawn of some Gaussians, each around Gaussians of one anchor.

    anchors  [K], of which one may have several
    counts   [K] Gaussians
    centers  [K, 3] in the map
    radii_m  [K]
    """

    anchors: np.ndarray
    counts: np.ndarray
    centers: np.ndarray
    radii_m: np.ndarray

    @classmethod
    def around(
        cls, rows: np.ndarray, anchors: np.ndarray, clumps: np.ndarray | None = None
    ) -> "AnchorSpheres":
        """Of Gaussians rows [N, 16] that hang on anchors [N], a sphere for each of the clumps [N],
        in the order of their numbers (see `clumps_of`); without, one for each anchor."""
        clumps = anchors if clumps is None else clumps
        order = np.argsort(clumps, kind="stable")
        rows, anchors, clumps = rows[order, :6], anchors[order], clumps[order]
        starts = np.flatnonzero(np.diff(clumps, prepend=clumps[:1] - 1))
        counts = np.diff(starts, append=len(clumps))
        return cls(anchors[starts], counts, *_spheres(rows, starts, counts))

    def __len__(self) -> int:
        return len(self.anchors)


def clumps_of(means: np.ndarray, anchors: np.ndarray, edge_m: float) -> np.ndarray:
    """Number [N] of the clump of each Gaussian: of those of one anchor in one cube of the map.

    means [N, 3]; numbers ascend with the anchors. Cubes 1024 edges apart count as one.
    """
    cubes = np.floor(np.nan_to_num(means.astype(float)) / edge_m).astype(np.int64) & 1023
    keys = ((anchors.astype(np.int64) << 10 | cubes[:, 0]) << 10 | cubes[:, 1]) << 10 | cubes[:, 2]
    return np.unique(keys, return_inverse=True)[1]


def _spheres(
    rows: np.ndarray, starts: np.ndarray, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centers [K, 3] in the map and radii [K] in metres of what is drawn of the first fields of
    rows [N, 6]: a sphere for `counts` rows from each of `starts`."""
    if len(starts) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    means = rows[:, :3].astype(float)
    lowest, highest = np.minimum.reduceat(means, starts), np.maximum.reduceat(means, starts)
    centers = (lowest + highest) / 2
    distances_m = np.linalg.norm(means - centers.repeat(counts, axis=0), axis=1)
    log_scales = np.minimum(rows[:, 3:].max(axis=1), _MAX_LOG_SCALE).astype(float)
    radii_m = np.maximum.reduceat(distances_m + REACH_SIGMA * np.exp(log_scales), starts)
    return centers, _ROUNDING * radii_m
