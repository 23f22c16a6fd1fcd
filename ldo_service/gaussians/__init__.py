"""The map of 3D Gaussians: model, rendering, densification and optimization."""

from .adam import Adam, AdamConfig
from .densification import DensificationConfig, densify
from .exposure import Exposure, estimate_exposure, fit_exposure
from .loss import ImageLoss, LossWeights, image_loss
from .model import GaussianMap
from .optimizer import GaussianOptimizer, GaussianOptimizerConfig
from .pruning import PruningConfig, prunable_mask
from .renderer import (
    Contributions,
    Rasterizer,
    Rendering,
    RenderMemory,
    RowGradients,
    VisibleGaussians,
    render,
)
from .training_views import TrainingView

__all__ = [
    "Adam",
    "AdamConfig",
    "Contributions",
    "DensificationConfig",
    "Exposure",
    "GaussianMap",
    "GaussianOptimizer",
    "GaussianOptimizerConfig",
    "ImageLoss",
    "LossWeights",
    "PruningConfig",
    "Rasterizer",
    "RenderMemory",
    "Rendering",
    "RowGradients",
    "TrainingView",
    "VisibleGaussians",
    "densify",
    "estimate_exposure",
    "fit_exposure",
    "image_loss",
    "prunable_mask",
    "render",
]
