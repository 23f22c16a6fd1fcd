"""LDO-SLAM: RGB-D SLAM as a service, with a map of 3D Gaussians."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("ldo-slam")
except PackageNotFoundError:  # read from a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
