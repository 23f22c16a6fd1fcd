"""Volumes for planners, computed from the map: a triangle mesh and an occupancy grid.

viewpoints      renderings of the map at the poses of its keyframes
tsdf            truncated signed distances, fused from depth images
marching_cubes  the surface of distances on a lattice, and its PLY file
occupancy       free, occupied and unknown voxels, and a floor plan for ROS' map_server
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
