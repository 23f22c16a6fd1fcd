"""The map of 3D Gaussians: what it holds, how it is seen, and how it grows."""

from .insertion import InsertionConfig, insert
from .model import GaussianMap
from .render import Rendering, render

__all__ = ["GaussianMap", "InsertionConfig", "Rendering", "insert", "render"]
