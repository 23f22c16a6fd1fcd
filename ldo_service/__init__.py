"""LDO-SLAM: RGB-D SLAM as a service, with a map of 3D Gaussians."""

import platform
from importlib.metadata import PackageNotFoundError, version

LIBRARIES = ("numpy", "gtsam", "onnxruntime", "opencv-python-headless", "msgspec")

try:
    __version__ = version("ldo-slam")
except PackageNotFoundError:  # read from a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]


def versions() -> dict[str, str]:
    """Return the versions of what computes results; every run and recording keeps them."""
    return {
        "ldo-slam": __version__,
        "python": platform.python_version(),
        **{library: version(library) for library in LIBRARIES},
    }
