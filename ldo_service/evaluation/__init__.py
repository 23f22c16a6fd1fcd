"""How good a run is: trajectories, rendered views, pictures of both."""

from .pictures import contact_sheet, depth_picture, trajectory_picture
from .rendering import psnr
from .trajectory import ErrorStatistics, TrajectoryErrors, align, evaluate_trajectory

__all__ = [
    "ErrorStatistics",
    "TrajectoryErrors",
    "align",
    "contact_sheet",
    "depth_picture",
    "evaluate_trajectory",
    "psnr",
    "trajectory_picture",
]
