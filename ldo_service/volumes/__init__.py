"""Volumes for planners, computed from the map: a triangle mesh and an occupancy grid.

viewpoints      Renderings of the map at the poses of its keyframes.
tsdf            Truncated signed distance field, fused from rendered depth images.
marching_cubes  Triangle mesh of the zero level of a distance field, and its PLY file.
occupancy       Free, occupied and unknown voxels, and a floor plan for map_server of ROS.
"""

from .marching_cubes import Mesh, write_mesh
from .occupancy import (
    FloorPlan,
    OccupancyConfig,
    OccupancyGrid,
    floor_plan,
    occupancy,
    write_floor_plan,
)
from .tsdf import Tsdf, TsdfConfig, fuse
from .viewpoints import Viewpoint

__all__ = [
    "FloorPlan",
    "Mesh",
    "OccupancyConfig",
    "OccupancyGrid",
    "Tsdf",
    "TsdfConfig",
    "Viewpoint",
    "floor_plan",
    "fuse",
    "occupancy",
    "write_floor_plan",
    "write_mesh",
]
