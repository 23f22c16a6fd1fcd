"""What planners need of the map: a surface of triangles, and where there is room.

viewpoints      what the map looks like from where it was seen
tsdf            depth images, fused into distances to the surface
marching_cubes  the surface, out of distances on a lattice, and the PLY file for it
occupancy       voxels that are free, occupied or unknown; a slice of them for ROS' map_server
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
