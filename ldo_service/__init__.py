"""LDO-SLAM: RGB-D SLAM as a service, with a map of 3D Gaussians.

    from ldo_service import Camera, Slam  # SLAM in this process.
    from ldo_service import connect  # Connection to a running service.

The public names are loaded when they are first used, so that `import ldo_service` stays fast and a
program that only connects to a service imports no numerical code.
"""

import platform
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .client import connect
    from .config import Config, load_config
    from .datasets import open_sequence
    from .geometry import Camera, Trajectory
    from .geometry import RgbdFrame as Frame
    from .library.maps import FoundObject, Map, MapArrays, MapView
    from .library.pose import Pose
    from .library.run import Run
    from .library.slam import Slam

LIBRARIES = (
    *("numpy", "scipy", "scikit-image", "gtsam", "small-gicp", "onnxruntime"),
    *("opencv-python-headless", "msgspec"),
)

try:
    __version__ = version("ldo-slam")
except PackageNotFoundError:  # A source tree that is not installed.
    __version__ = "0+unknown"

__all__ = [
    "Camera",
    "Config",
    "FoundObject",
    "Frame",
    "Map",
    "MapArrays",
    "MapView",
    "Pose",
    "Run",
    "Slam",
    "Trajectory",
    "__version__",
    "connect",
    "load_config",
    "open_sequence",
]

# Module and name of each public name that is loaded when it is first used.
LAZY = {
    "Camera": ("geometry", "Camera"),
    "Config": ("config", "Config"),
    "FoundObject": ("library.maps", "FoundObject"),
    "Frame": ("geometry", "RgbdFrame"),
    "Map": ("library.maps", "Map"),
    "MapArrays": ("library.maps", "MapArrays"),
    "MapView": ("library.maps", "MapView"),
    "Pose": ("library.pose", "Pose"),
    "Run": ("library.run", "Run"),
    "Slam": ("library.slam", "Slam"),
    "Trajectory": ("geometry", "Trajectory"),
    "connect": ("client", "connect"),
    "load_config": ("config", "load_config"),
    "open_sequence": ("datasets", "open_sequence"),
}


def __getattr__(name: str) -> object:
    """Load a public name."""
    if name not in LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = LAZY[name]
    value = getattr(import_module(f"{__name__}.{module}"), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted({*globals(), *__all__})


def versions() -> dict[str, str]:
    """Return the versions of all software that computes results.

    Every run and recording stores them.
    """
    return {
        "ldo-slam": __version__,
        "python": platform.python_version(),
        **{library: version(library) for library in LIBRARIES},
    }
