"""Evaluation of a run against ground truth: trajectories, rendered images, labels and loops."""

from .pictures import contact_sheet, depth_picture, trajectory_picture
from .trajectory import ErrorStatistics, TrajectoryErrors, evaluate_trajectory, fit_rigid_transform
from .views import depth_error, psnr, ssim

__all__ = [
    "ErrorStatistics",
    "TrajectoryErrors",
    "contact_sheet",
    "depth_error",
    "depth_picture",
    "evaluate_trajectory",
    "fit_rigid_transform",
    "psnr",
    "ssim",
    "trajectory_picture",
]
