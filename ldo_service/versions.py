"""What computed a result: kept with every run and recording."""

import platform
from importlib.metadata import version

from ldo_service import __version__

LIBRARIES = ("numpy", "gtsam", "onnxruntime", "opencv-python-headless", "msgspec")


def versions() -> dict[str, str]:
    return {
        "ldo-slam": __version__,
        "python": platform.python_version(),
        **{library: version(library) for library in LIBRARIES},
    }
