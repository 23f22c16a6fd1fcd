"""What planners need of the map: a surface of triangles, and where there is room.

viewpoints      what the map looks like from where it was seen
tsdf            depth images, fused into distances to the surface
marching_cubes  the surface, out of distances on a lattice
mesh            triangles, and the PLY file for them
occupancy       voxels that are free, occupied or unknown
floor_plan      a slice of them, as ROS' map_server reads it
"""

from .floor_plan import FloorPlan, floor_plan, write_floor_plan
from .mesh import Mesh, write_mesh
from .occupancy import OccupancyConfig, OccupancyGrid, occupancy
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
