"""Forecast for a state folder, from the sizes and times of its files."""

import os
import shutil
from contextlib import suppress
from itertools import accumulate
from pathlib import Path

from ldo_service.config import load_config
from ldo_service.errors import DataError

from .forecast import (
    DISK_FULL,
    IMAGES_DELETED,
    KEYFRAME_IMAGES,
    MIN_VALUES,
    STORED_KEYFRAMES,
    Bound,
    Forecast,
    Trend,
    duration,
)

# The newest images of this time give the present rate, seconds: several laps through a room.
WINDOW_S = 600.0


def forecast_of_state(folder: Path) -> Forecast:
    """Extrapolate the growth of a state folder, whether a service uses it or not.

    The times of the keyframe images give the rate of keyframes. The size of the folder per keyframe
    is the average over the whole map. The folder does not tell how much memory a keyframe takes.

    Args:
        folder: State folder of a service.

    Raises:
        DataError: The folder does not exist or has no keyframe images.
        ConfigError: The folder has settings of an earlier version.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder. Give the folder of `ldo serve --state`.")
    images = sorted((at_s, size_mb) for at_s, size_mb in _files(folder / "map" / "images"))
    if not images:
        raise DataError(
            f"{folder} has no keyframe images in map/images. Give the folder of `ldo serve "
            "--state`, after its first keyframes."
        )
    if len(images) < MIN_VALUES:
        missing = f"a trend needs {MIN_VALUES}"
        return Forecast(f"{len(images)} keyframe images in {folder}", missing=missing)
    settings = folder / "config.yaml"
    limits = load_config(settings if settings.exists() else None).mapper.keyframe_images
    recent = [at_s for at_s, _ in images if at_s >= images[-1][0] - WINDOW_S]
    first = len(images) - len(recent)
    counts = Trend.of(recent, range(first + 1, len(images) + 1))
    sizes_mb = list(accumulate(size_mb for _, size_mb in images))
    used_mb = sum(size_mb for _, size_mb in _files(folder))
    disk_mb_per_s = counts.per_s * used_mb / len(images)
    free_mb = shutil.disk_usage(folder).free / 1e6
    return Forecast(
        basis=(
            f"the newest {len(recent)} keyframe images in {folder}, written within "
            f"{duration(recent[-1] - recent[0])}, and its size per keyframe"
        ),
        keyframes_per_s=counts.per_s,
        disk_mb_per_s=disk_mb_per_s,
        bounds=(
            Bound("disk", DISK_FULL, f"{free_mb:,.0f} MB free", free_mb, disk_mb_per_s),
            Bound.of(
                *(KEYFRAME_IMAGES, IMAGES_DELETED),
                *(Trend.of(recent, sizes_mb[first:]), limits.disk_mb, " MB"),
            ),
            Bound.of(STORED_KEYFRAMES, IMAGES_DELETED, counts, limits.max_keyframes),
        ),
    )


def _files(folder: Path) -> list[tuple[float, float]]:
    """Return time of the last change, in seconds, and size in MB of all files below a folder."""
    found: list[tuple[float, float]] = []
    # A running service removes and renames files and folders meanwhile; these are left out.
    for parent, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                about = os.stat(os.path.join(parent, name))
                found.append((about.st_mtime, about.st_size / 1e6))
    return found
