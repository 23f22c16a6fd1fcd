"""Visibility of Gaussians in cameras, and the choice of Gaussians to offload to disk.

The visibility test compares bounding spheres with a coarse depth grid. It is conservative: it never
reports a visible Gaussian as hidden, but may report a hidden Gaussian as visible.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3

from .densification import with_small_holes_filled

BLOCKS = 12, 16  # Blocks of an image, vertically and horizontally; a grid takes 0.8 kB.
# A point counts as visible if it lies behind the surface by less than this fraction of the depth,
# because depth is noisy.
BEHIND = 0.1
# Margin for the 0.3 px^2 that the renderer adds to the variance of a splat: 3.33 sqrt(0.3) = 1.8.
LOW_PASS_PX = 2.0
_HOLE_PX = 4  # Equals the hole_px of densification; holes near an object show the background.

# `render` draws a Gaussian out to alpha = 1/255: sqrt(2 ln 255) = 3.33 standard deviations. The
# affine approximation makes splats near the edge of the image up to 1.3 times as wide as the
# projected ellipsoid. The Jacobian is evaluated over an area 1.3 times as wide as the image
# (kernels/projection.hpp).
REACH_SIGMA = 1.3 * 3.33
NEAR_M = 0.05  # Near plane of the renderer.
_MAX_LOG_SCALE = 50.0  # Effectively infinite, but without overflow.
_ROUNDING = 1.000_01  # Margin for the float32 sums of the renderer.


@dataclass(frozen=True, eq=False, slots=True)
class MaxDepthGrid:
    """Farthest depth in each of 12 x 16 blocks of an image.

    Attributes:
        farthest_m: [12, 16] float32, meters; infinite if a block has pixels without depth.
    """

    farthest_m: np.ndarray

    @classmethod
    def of(cls, depth_m: np.ndarray) -> "MaxDepthGrid":
        """Return the grid of a depth image in meters, [H, W] float32; 0 means "not measured"."""
        filled_m = with_small_holes_filled(depth_m, _HOLE_PX)
        known_m = np.where(filled_m > 0, filled_m, np.float32(inf))
        for axis, edges in enumerate(_edges(depth_m.shape)):
            known_m = np.maximum.reduceat(known_m, edges[:-1], axis=axis)
        return cls(known_m)

    def occludes(
        self, camera: Camera, centers_camera: np.ndarray, radii_m: np.ndarray
    ) -> np.ndarray:
        """Return which spheres lie completely behind the measured surface.

        A sphere counts as hidden if it lies behind the farthest depth of every image block that the
        sphere may touch. The test is conservative: visible spheres never count as hidden, but some
        hidden spheres count as visible. Spheres with NaN count as visible.

        Args:
            camera: Intrinsics.
            centers_camera: Centers in the camera frame, [K, 3] meters.
            radii_m: Radii, [K].

        Returns:
            [K] bool; True for hidden spheres.
        """
        downward, rightward = _edges((camera.height, camera.width))
        rows = _between(centers_camera[:, 1:], radii_m, downward, camera.fy, camera.cy)
        columns = _between(centers_camera[:, ::2], radii_m, rightward, camera.fx, camera.cx)
        nearest_m = centers_camera[:, 2] - radii_m
        reaches_before = ~(nearest_m[:, None, None] > (1 + BEHIND) * self.farthest_m)
        return ~np.any(reaches_before & rows[:, :, None] & columns[:, None, :], axis=(1, 2))


def _edges(shape: tuple[int, ...]) -> list[np.ndarray]:
    """Return the block boundaries in pixels: vertical positions, then horizontal positions.

    Each array has the first pixel of every block, then the number of pixels.
    """
    return [
        np.linspace(0, pixels, blocks + 1).astype(int)
        for pixels, blocks in zip(shape, BLOCKS, strict=True)
    ]


def _between(
    centers: np.ndarray, radii_m: np.ndarray, edges: np.ndarray, focal_px: float, center_px: float
) -> np.ndarray:
    """Return whether each sphere may touch each of the B rows (or columns) of blocks.

    The camera sees a row of blocks through a wedge between two planes, one through each boundary
    of the row. The spheres are tested against these wedges.

    Args:
        centers: Coordinates (y, z) of the centers for rows, (x, z) for columns, [K, 2].
        radii_m: Radii, [K].
        edges: Block boundaries from `_edges`, in pixels, [B + 1].
        focal_px: Focal length fy for rows, fx for columns.
        center_px: Principal point cy for rows, cx for columns.

    Returns:
        Mask [K, B] bool.
    """
    low = edges[:-1] - 0.5 - LOW_PASS_PX - center_px
    high = edges[1:] - 0.5 + LOW_PASS_PX - center_px
    beyond_low, before_high = (
        (centers[:, :1] * focal_px - centers[:, 1:] * edge) / np.hypot(focal_px, edge)
        for edge in (low, high)
    )
    return ~((beyond_low < -radii_m[:, None]) | (before_high > radii_m[:, None]))


@dataclass(frozen=True, eq=False, slots=True)
class PlacedCamera:
    """A camera with its pose and the farthest depths that it measured.

    Attributes:
        camera: Intrinsics without distortion.
        T_map_camera: Pose, [4, 4].
        horizon: Farthest depth in each block of the image; None if unknown.
    """

    camera: Camera
    T_map_camera: np.ndarray
    horizon: MaxDepthGrid | None = None

    def distances_m(self, centers_map: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
        """Return the distances [K] in meters from the camera to the surfaces of spheres.

        A distance is negative if the camera is inside the sphere.
        """
        return np.linalg.norm(centers_map - self.T_map_camera[:3, 3], axis=1) - radii_m

    def may_see(
        self, centers_map: np.ndarray, radii_m: np.ndarray, reach_m: float = inf
    ) -> np.ndarray:
        """Return which spheres the camera may see.

        A sphere counts as visible if it touches the view frustum and is not hidden by the surface
        that the camera measured. The test is conservative: visible spheres never count as
        invisible, but some invisible spheres count as visible. Spheres with NaN count as visible.

        Args:
            centers_map: Centers in the map frame, [K, 3] meters.
            radii_m: Radii, [K].
            reach_m: Distance in meters beyond which spheres count as invisible.

        Returns:
            [K] bool; True for visible spheres.
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
        """Return the inward normals [4, 3] of the four side planes of the view frustum."""
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
    """Bounding spheres of K chunks of Gaussians.

    The Gaussians of a chunk move with the same keyframe, called their anchor keyframe. The sphere
    of a chunk contains the rendered extent of each of its Gaussians.

    Attributes:
        anchors: Id of the anchor keyframe of each chunk, [K]. Several chunks may share one
            anchor keyframe.
        counts: Number of Gaussians in each chunk, [K].
        centers: Centers in the map frame, [K, 3].
        radii_m: Radii, [K].
    """

    anchors: np.ndarray
    counts: np.ndarray
    centers: np.ndarray
    radii_m: np.ndarray

    @classmethod
    def around(
        cls, rows: np.ndarray, anchors: np.ndarray, chunks: np.ndarray | None = None
    ) -> "BoundingSpheres":
        """Return a sphere for each chunk of Gaussians, in the order of the chunk numbers.

        Args:
            rows: Parameters of the Gaussians, [N, 16].
            anchors: Id of the anchor keyframe of each Gaussian, [N].
            chunks: Chunk number of each Gaussian, [N], from `chunk_numbers`. If it is None, the
                Gaussians of each anchor keyframe form one chunk.
        """
        chunks = anchors if chunks is None else chunks
        order = np.argsort(chunks, kind="stable")
        rows, anchors, chunks = rows[order, :6], anchors[order], chunks[order]
        starts = np.flatnonzero(np.diff(chunks, prepend=chunks[:1] - 1))
        counts = np.diff(starts, append=len(chunks))
        return cls(anchors[starts], counts, *_spheres(rows, starts, counts))

    def __len__(self) -> int:
        return len(self.anchors)


def chunk_numbers(means: np.ndarray, anchors: np.ndarray, edge_m: float) -> np.ndarray:
    """Return the chunk number of each Gaussian, [N].

    A chunk contains the Gaussians of one anchor keyframe in one cube of the map. Chunk numbers
    ascend with the ids of the anchor keyframes. Positions of cubes are taken modulo 1024 cubes on
    each axis, so cubes 1024 apart count as one.

    Args:
        means: Centers of the Gaussians in the map frame, [N, 3], meters.
        anchors: Ids of the anchor keyframes, [N].
        edge_m: Edge of the cubes, meters.
    """
    cubes = np.floor(np.nan_to_num(means.astype(float)) / edge_m).astype(np.int64) & 1023
    keys = ((anchors.astype(np.int64) << 10 | cubes[:, 0]) << 10 | cubes[:, 1]) << 10 | cubes[:, 2]
    return np.unique(keys, return_inverse=True)[1]


def _spheres(
    rows: np.ndarray, starts: np.ndarray, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounding spheres of groups of consecutive rows, at their rendered extent.

    Args:
        rows: Means and log scales, [N, 6].
        starts: First row of each sphere, [K].
        counts: Number of rows of each sphere, [K].

    Returns:
        Centers [K, 3] in the map frame and radii [K] in meters.
    """
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
    """Settings of offloading, which moves Gaussians from memory to disk."""

    # Largest number of Gaussians in memory; with the moments of Adam, they take 300 MB. The
    # limit is checked every mapper.publish.update_interval_keyframes keyframes. Until then, new
    # and loaded Gaussians may exceed it.
    max_active: int = 1_500_000
    # Fraction of max_active that remains in memory after offloading. One offloading takes about
    # 0.1 s.
    low_water: float = 0.9
    # Largest distance at which Gaussians count as visible. Depth cameras do not measure this
    # far, so densification does not add surface whose Gaussians are offloaded. Within this
    # distance, the measured surface hides the Gaussians behind it.
    reach_m: float = 20.0
    # Edge of the cubes of space; the Gaussians of one keyframe in one cube form a chunk. In an
    # apartment of two rooms, the chunks that the last 8 keyframes may see hold 36 % of the map
    # (28 % with 0.5 m, 54 % with 2.0 m). With one chunk per keyframe and without occlusion, they
    # would hold 67 %.
    chunk_edge_m: float = 1.0

    def __post_init__(self) -> None:
        if not (self.max_active >= 1 and 0 < self.low_water <= 1):
            raise ConfigError(
                named(self, "max_active", "low_water")
                + ": max_active must be at least 1, low_water must lie in (0, 1]."
            )
        if not (self.reach_m > 0 and self.chunk_edge_m > 0):
            raise ConfigError(named(self, "reach_m", "chunk_edge_m") + " must be positive.")


@dataclass(frozen=True, slots=True)
class OffloadPlan:
    """Choice of the chunks of Gaussians to offload from memory to disk.

    Attributes:
        chunks: Numbers of the chunks to offload, the farthest from the current camera first.
        excess: Number of Gaussians in memory beyond `max_active` after offloading. They stay
            because recent cameras may see them.
    """

    chunks: list[int]
    excess: int


def plan_offload(
    resident: BoundingSpheres,
    recent: Sequence[PlacedCamera],
    config: OffloadConfig,
) -> OffloadPlan:
    """Choose the chunks to offload to disk if more than `max_active` Gaussians are in memory.

    Chunks are chosen until at most `low_water * max_active` Gaussians stay in memory. Only chunks
    that no recent camera may see are chosen, the farthest from the current camera first. At the
    same distance, chunks of older anchor keyframes are chosen first. Chunks of the newest anchor
    keyframe always stay. The choice is deterministic.

    Args:
        resident: Bounding spheres of all Gaussians in memory, by chunk.
        recent: Cameras of the last keyframes, at least one; the last one is the current camera.
        config: Settings, which include `max_active` and `low_water`.
    """
    active = int(resident.counts.sum())
    if active <= config.max_active:
        return OffloadPlan([], 0)
    is_visible = resident.anchors == resident.anchors[-1]
    for camera in recent:
        is_visible |= camera.may_see(resident.centers, resident.radii_m, config.reach_m)
    hidden = np.flatnonzero(~is_visible)
    distances_m = recent[-1].distances_m(resident.centers[hidden], resident.radii_m[hidden])
    chosen: list[int] = []
    for k in hidden[np.argsort(-distances_m, kind="stable")]:
        if active <= config.low_water * config.max_active:
            break
        chosen.append(int(k))
        active -= int(resident.counts[k])
    return OffloadPlan(chosen, max(0, active - config.max_active))
