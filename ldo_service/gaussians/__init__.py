"""The map of 3D Gaussians: what it holds, how it is seen, how it grows and how it is optimised."""

from .adam import Adam, AdamConfig
from .exposure import Exposure, estimated_exposure, fitted_exposure
from .insertion import InsertionConfig, insert
from .loss import ImageLoss, LossWeights, image_loss
from .model import GaussianMap
from .optimise import Optimiser, OptimiserConfig
from .pruning import PruningConfig, superfluous
from .rasteriser import Rasteriser, Reached, RowGradients
from .render import Contributions, Rendering, RenderMemory, render
from .views import View

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
