"""Bounds on where Gaussians can be seen from, and the choice of those that leave memory."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3

from .densification import with_small_holes_filled

BLOCKS = 12, 16  # of an image, down and to the right: 0.8 kB
BEHIND = 0.1  # share of the depth: nearer to the surface than that is seen, as depth is noisy
LOW_PASS_PX = 2.0  # 3.33 times the square root of the 0.3 px^2 that every splat is widened by
_HOLE_PX = 4  # as insertion fills holes: shadows beside an object lie on what is behind it

# What `render` draws of a Gaussian ends where alpha = 1/255: sqrt(2 ln 255) standard deviations.
# At the rim of the image its affine splats are up to 1.3 times as wide as the ellipsoid there,
# which is how far outside the image the Jacobian is still taken (kernels/projection.hpp).
REACH_SIGMA = 1.3 * 3.33
NEAR_M = 0.05  # the renderer draws nothing nearer
_MAX_LOG_SCALE = 50.0  # as good as infinite, and no overflow
_ROUNDING = 1.000_01  # of what the renderer adds up in float32


@dataclass(frozen=True, eq=False, slots=True)
class MaxDepthGrid:
    """farthest_m [12, 16] float32: the farthest depth in each block of an image; infinite where
    not all of the block was measured."""

    farthest_m: np.ndarray

    @classmethod
    def of(cls, depth_m: np.ndarray) -> "MaxDepthGrid":
        """depth_m [H, W] float32, 0 where not measured."""
        filled_m = with_small_holes_filled(depth_m, _HOLE_PX)
        known_m = np.where(filled_m > 0, filled_m, np.float32(inf))
        for axis, edges in enumerate(_edges(depth_m.shape)):
            known_m = np.maximum.reduceat(known_m, edges[:-1], axis=axis)
        return cls(known_m)

    def occludes(
        self, camera: Camera, centers_camera: np.ndarray, radii_m: np.ndarray
    ) -> np.ndarray:
        """Which spheres [K] bool lie wholly behind what `camera` saw in every block that they may
        show in.

        centers_camera [K, 3], radii_m [K]. False for some that are hidden; true for none that is
        not, nor for any that holds NaN.
        """
        downward, rightward = _edges((camera.height, camera.width))
        rows = _between(centers_camera[:, 1:], radii_m, downward, camera.fy, camera.cy)
        columns = _between(centers_camera[:, ::2], radii_m, rightward, camera.fx, camera.cx)
        nearest_m = centers_camera[:, 2] - radii_m
        in_sight = ~(nearest_m[:, None, None] > (1 + BEHIND) * self.farthest_m)
        return ~np.any(in_sight & rows[:, :, None] & columns[:, None, :], axis=(1, 2))


def _edges(shape: tuple[int, ...]) -> list[np.ndarray]:
    """First pixel of each block, and one past the last, down and to the right."""
    return [
        np.linspace(0, pixels, blocks + 1).astype(int)
        for pixels, blocks in zip(shape, BLOCKS, strict=True)
    ]


def _between(
    centers: np.ndarray, radii_m: np.ndarray, edges: np.ndarray, focal_px: float, center_px: float
) -> np.ndarray:
    """Whether each sphere [K] touches each wedge [B] between two neighbouring edges; centers
    [K, 2] are across the edges and z."""
    low = edges[:-1] - 0.5 - LOW_PASS_PX - center_px
    high = edges[1:] - 0.5 + LOW_PASS_PX - center_px
    beyond_low, before_high = (
        (centers[:, :1] * focal_px - centers[:, 1:] * edge) / np.hypot(focal_px, edge)
        for edge in (low, high)
    )
    return ~((beyond_low < -radii_m[:, None]) | (before_high > radii_m[:, None]))


@dataclass(frozen=True, eq=False, slots=True)
class PlacedCamera:
    """A camera without distortion at T_map_camera [4, 4], and how far it saw there; None: who
    knows."""

    camera: Camera
    T_map_camera: np.ndarray
    horizon: MaxDepthGrid | None = None

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
            seen[seen] = ~self.horizon.occludes(self.camera, centers[seen], radii_m[seen])
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
class BoundingSpheres:
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
    ) -> "BoundingSpheres":
        """Of Gaussians rows [N, 16] that hang on anchors [N], a sphere for each of the clumps [N],
        in the order of their numbers (see `chunk_numbers`); without, one for each anchor."""
        clumps = anchors if clumps is None else clumps
        order = np.argsort(clumps, kind="stable")
        rows, anchors, clumps = rows[order, :6], anchors[order], clumps[order]
        starts = np.flatnonzero(np.diff(clumps, prepend=clumps[:1] - 1))
        counts = np.diff(starts, append=len(clumps))
        return cls(anchors[starts], counts, *_spheres(rows, starts, counts))

    def __len__(self) -> int:
        return len(self.anchors)


def chunk_numbers(means: np.ndarray, anchors: np.ndarray, edge_m: float) -> np.ndarray:
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


@dataclass(frozen=True, slots=True)
class OffloadConfig:
    max_active: int = 1_500_000  # Gaussians in memory (ALGORITHMS, The map): 300 MB with moments.
    # Between two looks at it, every mapper.publish.update_interval_keyframes, new and woken ones
    # come on top
    low_water: float = 0.9  # share of max_active that stays: a batch of 0.1 s now and then
    reach_m: float = 20.0  # beyond, nothing counts as seen: depth cameras measure less far, so
    # nothing is inserted a second time where Gaussians sleep. Nearer, what they measured hides
    # what is behind
    clump_m: float = 1.0  # edge of the cubes whose Gaussians of one keyframe sleep and wake
    # together. In a flat of two rooms 36 % of the map may be seen by the last 8 keyframes, with 0.5
    # 28 %, with 2.0 54 %; 67 % with whole keyframes and without a look at what hides them

    def __post_init__(self) -> None:
        if not (self.max_active >= 1 and 0 < self.low_water <= 1):
            raise ConfigError(
                named(self, "max_active", "low_water")
                + ": max_active must be at least 1, low_water in (0, 1]."
            )
        if not (self.reach_m > 0 and self.clump_m > 0):
            raise ConfigError(
                named(self, "reach_m", "clump_m") + ": reach_m and clump_m must be positive."
            )


@dataclass(frozen=True, slots=True)
class OffloadPlan:
    """clumps   numbers of the spheres whose Gaussians go to sleep, the farthest first
    excess   Gaussians over max_active that stay, because they may be looked at
    """

    clumps: list[int]
    excess: int


def plan_offload(
    awake: BoundingSpheres,
    recent: Sequence[PlacedCamera],
    config: OffloadConfig,
) -> OffloadPlan:
    """Nobody up to `max_active` Gaussians; over it, clumps until `low_water` of that is left.

    awake   of all Gaussians in memory, by clump
    recent  cameras of the last keyframes, at least the current one, which is last

    Those that no recent camera may see go, the farthest from the current camera first, older ones
    before newer ones at the same distance. Those of the newest anchor never go. Deterministic.
    """
    active = int(awake.counts.sum())
    if active <= config.max_active:
        return OffloadPlan([], 0)
    looked_at = awake.anchors == awake.anchors[-1]
    for camera in recent:
        looked_at |= camera.may_see(awake.centers, awake.radii_m, config.reach_m)
    idle = np.flatnonzero(~looked_at)
    distances_m = recent[-1].distances_m(awake.centers[idle], awake.radii_m[idle])
    chosen: list[int] = []
    for k in idle[np.argsort(-distances_m, kind="stable")]:
        if active <= config.low_water * config.max_active:
            break
        chosen.append(int(k))
        active -= int(awake.counts[k])
    return OffloadPlan(chosen, max(0, active - config.max_active))
