"""How good a run is: trajectories, rendered views, pictures of both."""

from .pictures import contact_sheet, depth_picture, trajectory_picture
from .trajectory import ErrorStatistics, TrajectoryErrors, align, evaluate_trajectory
from .views import depth_error, psnr, ssim

__all__ = [
    "ErrorStatistics",
    "TrajectoryErrors",
    "align",
    "contact_sheet",
    "depth_error",
    "depth_picture",
    "evaluate_trajectory",
    "psnr",
    "ssim",
    "trajectory_picture",
]
