"""The map of 3D Gaussians: what it holds, how it is seen, how it grows and how it is optimised."""

from .adam import Adam, AdamConfig
from .densification import InsertionConfig, insert
from .exposure import Exposure, estimated_exposure, fitted_exposure
from .loss import ImageLoss, LossWeights, image_loss
from .model import GaussianMap
from .optimizer import Optimiser, OptimiserConfig
from .pruning import PruningConfig, superfluous
from .renderer import (
    Contributions,
    Rasteriser,
    Reached,
    Rendering,
    RenderMemory,
    RowGradients,
    render,
)
from .training_views import View

__all__ = [
    "Adam",
    "AdamConfig",
    "Contributions",
    "Exposure",
    "GaussianMap",
    "ImageLoss",
    "InsertionConfig",
    "LossWeights",
    "Optimiser",
    "OptimiserConfig",
    "PruningConfig",
    "Rasteriser",
    "Reached",
    "RenderMemory",
    "Rendering",
    "RowGradients",
    "View",
    "estimated_exposure",
    "fitted_exposure",
    "image_loss",
    "insert",
    "render",
    "superfluous",
]
