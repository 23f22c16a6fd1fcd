"""LDO-SLAM: RGB-D SLAM as a service, with a map of 3D Gaussians."""

import platform
from importlib.metadata import PackageNotFoundError, version

LIBRARIES = (
    *("numpy", "scipy", "scikit-image", "gtsam", "small-gicp", "onnxruntime"),
    *("opencv-python-headless", "msgspec"),
)

try:
    __version__ = version("ldo-slam")
except PackageNotFoundError:  # A source tree that is not installed.
    __version__ = "0+unknown"

__all__ = ["__version__"]


def versions() -> dict[str, str]:
    """Return the versions of all software that computes results.

    Every run and recording stores them.
    """
    return {
        "ldo-slam": __version__,
        "python": platform.python_version(),
        **{library: version(library) for library in LIBRARIES},
    }
