"""A slice of an occupancy grid as ROS' map_server reads it: a PGM picture and a YAML file."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from ldo_service.errors import ConfigError

from .occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

# Axis of the map that is up: those that become x and y of the plan, to the right and ahead of who
# looks down on it, and the sign of up.
UP = {
    "x": (1, 2, 0, 1),
    "y": (2, 0, 1, 1),
    "z": (0, 1, 2, 1),
    "-x": (2, 1, 0, -1),
    "-y": (0, 2, 1, -1),
    "-z": (1, 0, 2, -1),
}
GREY = {UNKNOWN: 205, FREE: 254, OCCUPIED: 0}  # as map_saver has them


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """states [X, Y] uint8 (0 unknown, 1 free, 2 occupied) over the axes `x` and `y` of the map;
    origin_m [2] is the lower corner of cell (0, 0); `heights_m` along `up` are what it sums up."""

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
    """The voxels whose centre is at a height within `heights_m`, seen from above.

    A cell is occupied where one of its voxels is, else free where one is free, else unknown.
    Heights count from the origin of the map, where the first camera was, along `up`. The map has
    the axes of the first camera, and -y is up when that was held level. Raises ConfigError when up
    is no axis, or no voxel is in the band.
    """
    if up not in UP:
        raise ConfigError(f"up={up!r} is not one of {', '.join(UP)}.")
    x, y, vertical, sign = UP[up]
    states = grid.states.transpose(x, y, vertical)
    centers_m = grid.origin_m[vertical] + grid.voxel_m * (0.5 + np.arange(states.shape[2]))
    lowest_m, highest_m = heights_m
    band = (sign * centers_m >= lowest_m) & (sign * centers_m <= highest_m)
    if not band.any():
        found = sorted(sign * centers_m[[0, -1]])
        raise ConfigError(
            f"no voxel is between {lowest_m} and {highest_m} m above the first camera: the map "
            f"reaches from {found[0]:.2f} to {found[1]:.2f} m along {up}. Choose other heights."
        )
    return FloorPlan(
        states[:, :, band].max(axis=2),  # the codes ascend: unknown, free, occupied
        (float(grid.origin_m[x]), float(grid.origin_m[y])),
        grid.voxel_m,
        "xyz"[x],
        "xyz"[y],
        up,
        heights_m,
    )


def write_floor_plan(path: Path, plan: FloorPlan) -> None:
    """Write `path` (.yaml) and the picture beside it (.pgm), y upwards."""
    grey = np.array([GREY[state] for state in (UNKNOWN, FREE, OCCUPIED)], np.uint8)
    picture = np.ascontiguousarray(grey[plan.states].T[::-1])
    path.with_suffix(".pgm").write_bytes(cv2.imencode(".pgm", picture)[1].tobytes())
    facts = {
        "image": path.with_suffix(".pgm").name,
        "resolution": plan.cell_m,
        "origin": [*plan.origin_m, 0.0],  # of the lower left pixel; yaw
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,  # 205 is 0.196 occupied, and unknown
    }
    low_m, high_m = plan.heights_m
    axes = f"# x is the map's {plan.x}, y its {plan.y}; {low_m} to {high_m} m along {plan.up}\n"
    path.write_text(axes + yaml.safe_dump(facts, sort_keys=False))
