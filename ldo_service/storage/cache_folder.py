"""Folder of files that can be made again: rendered frames and the result of a benchmark."""

import os
from pathlib import Path


def cache_root() -> Path:
    """Return the folder named by the environment variable LDO_CACHE.

    If LDO_CACHE is not set, the folder is `ldo-slam` in the user's cache folder.
    """
    if folder := os.environ.get("LDO_CACHE"):
        return Path(folder).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ldo-slam"
