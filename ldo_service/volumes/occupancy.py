"""Occupancy grid with free, occupied and unknown voxels, and a floor plan made from it.

The floor plan is a PGM image and a YAML file in the format of map_server of ROS.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import se3

from .marching_cubes import pack
from .viewpoints import Viewpoint, surface_depth_m

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
SLAB = 1 << 18  # Voxels processed at a time.

# Key: map axis that is up. Value: the map axes that become x (right) and y (ahead) of the plan
# seen from above, the vertical map axis, and the sign of up along it.
UP = {
    "x": (1, 2, 0, 1),
    "y": (2, 0, 1, 1),
    "z": (0, 1, 2, 1),
    "-x": (2, 1, 0, -1),
    "-y": (0, 2, 1, -1),
    "-z": (1, 0, 2, -1),
}
GRAY = {UNKNOWN: 205, FREE: 254, OCCUPIED: 0}  # Gray values that map_saver of ROS writes.


@dataclass(frozen=True, slots=True)
class OccupancyConfig:
    """Settings of the occupancy grid."""

    voxel_m: float = 0.1
    min_opacity: float = 0.5  # Minimum opacity of a Gaussian that occupies voxels.
    # Minimum area of the Gaussians in an occupied voxel, as a fraction of the area of a voxel face.
    # A wall through the middle of a voxel has 1, a single stray Gaussian less than 0.01.
    min_cover: float = 0.1
    max_sigma_voxels: float = 10.0  # Larger Gaussians are background and occupy no voxel.
    max_voxels: int = 200_000_000  # Maximum number of voxels of the grid, one byte each.

    def __post_init__(self) -> None:
        if not 0.005 <= self.voxel_m <= 10:
            raise ConfigError(f"voxel_m={self.voxel_m} must lie between 0.005 and 10 m.")
        for name in ("min_opacity", "min_cover"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"{name}={getattr(self, name)} must be above 0 and at most 1.")


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """Occupancy grid with the axes of the map.

    Attributes:
        origin_m: Corner of voxel (0, 0, 0) with the smallest coordinates in the map, [3], meters.
        voxel_m: Side length of a voxel, meters.
        states: State of each voxel, [X, Y, Z] uint8: 0 unknown, 1 free, 2 occupied.
    """

    origin_m: np.ndarray
    voxel_m: float
    states: np.ndarray

    def save(self, path: Path) -> None:
        """Write a compressed .npz with `origin_m`, `voxel_m` and `states`."""
        with path.open("wb") as file:  # Given a path, savez would add a suffix.
            np.savez_compressed(
                file, origin_m=self.origin_m, voxel_m=self.voxel_m, states=self.states
            )


def occupancy(
    rows: np.ndarray,
    viewpoints: Sequence[Viewpoint],
    config: OccupancyConfig | None = None,
    *,
    threads: int = 1,
    advance: Callable[[int], None] = lambda _done: None,
) -> OccupancyGrid:
    """Compute the occupancy grid of Gaussians.

    A voxel is occupied if opaque Gaussians cover it, even if a camera sees a surface behind it. Any
    other voxel is free if a camera sees a surface behind it, and unknown otherwise. The grid
    contains all occupied voxels and all cameras.

    Args:
        rows: Gaussians, [N, 16].
        viewpoints: Cameras from which the map is rendered to find free voxels.
        config: Settings.
        threads: Threads of the renderer.
        advance: Called with the number of finished viewpoints, to show progress.

    Raises:
        DataError: No voxel is occupied.
        ConfigError: The grid would be too large.
    """
    config = config or OccupancyConfig()
    occupied = occupied_voxels(rows, config)
    if not len(occupied):
        raise DataError(
            "no voxel is occupied, because the map contains no opaque surface. Check the map in "
            "`ldo view`."
        )
    stood = [np.floor(v.T_map_camera[:3, 3] / config.voxel_m).astype(int) for v in viewpoints]
    lowest, states = _grid(np.concatenate([occupied, np.reshape(stood, (-1, 3))]), config)
    for done, viewpoint in enumerate(viewpoints, 1):
        depth_m = surface_depth_m(viewpoint.render(rows, threads), config.voxel_m)
        _carve(states, lowest, depth_m, viewpoint, config.voxel_m)
        advance(done)
    states[tuple((occupied - lowest).T)] = OCCUPIED
    return OccupancyGrid(lowest * config.voxel_m, config.voxel_m, states)


def occupied_voxels(rows: np.ndarray, config: OccupancyConfig) -> np.ndarray:
    """Return the integer coordinates of the voxels that opaque Gaussians cover, [V, 3].

    A position in meters, divided by the voxel size and rounded down, gives the coordinates of its
    voxel. A Gaussian covers the area 2 pi s1 s2 times its opacity, with the standard deviations s1
    and s2 of its two longer axes. The area of a large Gaussian is distributed over several voxels.
    """
    sigmas_m, opacities = np.exp(rows[:, 3:6]), 1 / (1 + np.exp(-rows[:, 10]))
    matter = (opacities >= config.min_opacity) & (
        sigmas_m.max(axis=1, initial=0) <= config.max_sigma_voxels * config.voxel_m
    )
    rows, sigmas_m, opacities = rows[matter], sigmas_m[matter], opacities[matter]
    longer = np.sort(sigmas_m, axis=1)[:, 1:]
    cover_m2 = opacities * 2 * np.pi * longer.prod(axis=1)
    axes = se3.rotation(rows[:, 6:10]).swapaxes(1, 2) * sigmas_m[:, :, None]  # [N, axis, 3]
    means, cover_m2 = _split(rows[:, 0:3], axes, cover_m2, config.voxel_m / 4)
    voxels = np.floor(means / config.voxel_m).astype(np.int64)
    _, first, which = np.unique(pack(voxels), return_index=True, return_inverse=True)
    covered = np.bincount(which, cover_m2, len(first)) >= config.min_cover * config.voxel_m**2
    return voxels[first[covered]]


def _split(
    means: np.ndarray, axes: np.ndarray, cover: np.ndarray, max_sigma_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Split Gaussians into parts until no axis is longer than `max_sigma_m`.

    A Gaussian is split along its longest axis, with standard deviation s, into two Gaussians with
    s / 2 along this axis. Their means lie at +- sqrt(3)/2 s on the axis, so that both together have
    the original variance. The parts of a large Gaussian are evenly spaced, at most
    2 sqrt(3) `max_sigma_m` apart.

    Args:
        means: [N, 3].
        axes: Axes scaled by their standard deviations, [N, axis, 3].
        cover: Covered areas, [N], m^2.
        max_sigma_m: Maximum standard deviation along any axis, meters.

    Returns:
        Means and covered areas of the parts.
    """
    done = []
    while len(means):
        lengths = np.linalg.norm(axes, axis=2)
        large = lengths.max(axis=1) > max_sigma_m
        done.append((means[~large], cover[~large]))
        means, axes, cover = means[large], axes[large].copy(), cover[large]
        piece, longest = np.arange(len(means)), lengths[large].argmax(axis=1)
        offset = axes[piece, longest] * np.sqrt(3) / 2
        axes[piece, longest] /= 2
        means = np.concatenate([means - offset, means + offset])
        axes, cover = np.concatenate([axes, axes]), np.concatenate([cover, cover]) / 2
    pieces, covers = zip(*done, strict=True) if done else ([means], [cover])
    return np.concatenate(pieces), np.concatenate(covers)


def _grid(voxels: np.ndarray, config: OccupancyConfig) -> tuple[np.ndarray, np.ndarray]:
    """Make a grid that contains the voxels [V, 3].

    Returns:
        Coordinates [3] of the lowest voxel of the grid, and states [X, Y, Z], all unknown.
    """
    lowest = voxels.min(axis=0) - 1
    size = voxels.max(axis=0) + 2 - lowest
    if size.astype(float).prod() > config.max_voxels:
        extent = " x ".join(f"{side * config.voxel_m:.0f}" for side in size)
        raise ConfigError(
            f"a grid of {extent} m has more than {config.max_voxels:,} voxels of "
            f"{config.voxel_m} m. Choose larger voxels (--voxel)."
        )
    return lowest, np.full(size, UNKNOWN, np.uint8)


def _carve(
    states: np.ndarray,
    lowest: np.ndarray,
    depth_m: np.ndarray,
    viewpoint: Viewpoint,
    voxel_m: float,
) -> None:
    """Mark the voxels between a camera and the surface that it sees as free.

    The function marks the voxel that contains the camera, and all visible voxels whose center lies
    at least one voxel size in front of the rendered surface.

    Args:
        states: States of the grid, [X, Y, Z]; changed in place.
        lowest: Coordinates of voxel (0, 0, 0) of the grid, [3].
        depth_m: Rendered depth, [H, W], meters; 0 where unknown.
        viewpoint: Camera and pose.
        voxel_m: Side of a voxel, meters.
    """
    stood = np.floor(viewpoint.T_map_camera[:3, 3] / voxel_m).astype(int)
    states[tuple(stood - lowest)] = FREE
    T_camera_map = se3.inverse(viewpoint.T_map_camera)
    for voxels in _slabs(states.shape, _frustum_m(depth_m, viewpoint) / voxel_m - lowest):
        middles_m = (voxels + lowest + 0.5) * voxel_m
        at = viewpoint.look_up(se3.transform(T_camera_map, middles_m), depth_m)
        in_front = (at.seen_m > 0) & (at.z_m <= at.seen_m - voxel_m)
        states[tuple(voxels[in_front].T)] = FREE


def _frustum_m(depth_m: np.ndarray, viewpoint: Viewpoint) -> np.ndarray:
    """Return the corners [5, 3] of a view frustum in the map.

    They are the camera position and the four image corners at the largest depth.
    """
    ends = viewpoint.camera.rays()[[0, 0, -1, -1], [0, -1, 0, -1]] * depth_m.max(initial=0)
    return se3.transform(viewpoint.T_map_camera, np.vstack([np.zeros(3), ends]))


def _slabs(shape: tuple[int, ...], corners: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the indices of all voxels in the bounding box of some points, in several arrays.

    Args:
        shape: Shape of the grid.
        corners: The points, [P, 3], in voxels.

    Yields:
        Indices [V, 3] of the voxels of some layers: at most `SLAB` voxels or a single layer.
    """
    start = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
    stop = np.minimum(np.ceil(corners.max(axis=0)).astype(int), shape)
    x, y, z = zip(start, stop, strict=True)
    layers = max(1, SLAB // max(1, (y[1] - y[0]) * (z[1] - z[0])))
    for first in range(*x, layers):
        axes = np.arange(first, min(first + layers, x[1])), np.arange(*y), np.arange(*z)
        yield np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Floor plan: the voxels of an occupancy grid in a range of heights, seen from above.

    Attributes:
        states: State of each cell, [X, Y] uint8: 0 unknown, 1 free, 2 occupied.
        origin_m: Smallest coordinates in cell (0, 0) along the map axes `x` and `y`, meters.
        cell_m: Side length of a cell, meters.
        x: Axis of the map along the first dimension.
        y: Axis of the map along the second dimension.
        up: Axis of the map that points up, with its sign, such as "-y".
        heights_m: Range of heights along `up` that the plan covers, meters from the map origin.
    """

    states: np.ndarray
    origin_m: tuple[float, float]
    cell_m: float
    x: str
    y: str
    up: str
    heights_m: tuple[float, float]


def floor_plan(
    grid: OccupancyGrid, up: str = "-y", heights_m: tuple[float, float] = (-0.5, 0.5)
) -> FloorPlan:
    """Make a floor plan of the voxels whose center lies in a range of heights.

    A cell of the plan stands for a vertical column of these voxels. The cell is occupied if at
    least one of them is occupied. Otherwise it is free if at least one of them is free, else
    unknown.

    Args:
        grid: The occupancy grid.
        up: Axis of the map that points up, a key of `UP`. The map has the axes of the camera at
            the first frame. If the camera was level there, "-y" points up.
        heights_m: Lowest and highest height along `up`, meters from the origin of the map. The
            origin is the position of the camera at the first frame.

    Raises:
        ConfigError: `up` is not an axis, or the range contains no voxel.
    """
    if up not in UP:
        raise ConfigError(f"up={up!r} must be one of {', '.join(UP)}.")
    x, y, vertical, sign = UP[up]
    states = grid.states.transpose(x, y, vertical)
    centers_m = grid.origin_m[vertical] + grid.voxel_m * (0.5 + np.arange(states.shape[2]))
    lowest_m, highest_m = heights_m
    band = (sign * centers_m >= lowest_m) & (sign * centers_m <= highest_m)
    if not band.any():
        found = sorted(sign * centers_m[[0, -1]])
        raise ConfigError(
            f"no voxel lies between {lowest_m} and {highest_m} m above the first camera: the map "
            f"reaches from {found[0]:.2f} to {found[1]:.2f} m along {up}. Choose other heights."
        )
    return FloorPlan(
        states[:, :, band].max(axis=2),  # The codes ascend: unknown, free, occupied.
        (float(grid.origin_m[x]), float(grid.origin_m[y])),
        grid.voxel_m,
        "xyz"[x],
        "xyz"[y],
        up,
        heights_m,
    )


def write_floor_plan(path: Path, plan: FloorPlan) -> None:
    """Write a YAML file to `path` and the .pgm image next to it; y points up in the image."""
    gray = np.array([GRAY[state] for state in (UNKNOWN, FREE, OCCUPIED)], np.uint8)
    picture = np.ascontiguousarray(gray[plan.states].T[::-1])
    path.with_suffix(".pgm").write_bytes(cv2.imencode(".pgm", picture)[1].tobytes())
    facts = {
        "image": path.with_suffix(".pgm").name,
        "resolution": plan.cell_m,
        "origin": [*plan.origin_m, 0.0],  # Position of the lower left pixel, and yaw.
        "negate": 0,
        "occupied_thresh": 0.65,
        # Cells below this occupancy are free. The gray value 205, an occupancy of 0.1961, is not.
        "free_thresh": 0.196,
    }
    low_m, high_m = plan.heights_m
    axes = f"# x is the map's {plan.x}, y its {plan.y}; {low_m} to {high_m} m along {plan.up}\n"
    path.write_text(axes + yaml.safe_dump(facts, sort_keys=False))
