"""Frames whose files carry a number and no stamp."""

import logging
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError

log = logging.getLogger(__name__)

FRAME_RATE_HZ = 30  # without stamps, frame k is said to be taken at k / 30 s


@dataclass(frozen=True, slots=True)
class NumberedFrames:
    """The frames that have both colour and depth, in order of their numbers.

    numbers  [N] int64, ascending; gaps where files are missing
    """

    numbers: np.ndarray
    color: list[Path]
    depth: list[Path]

    @property
    def stamps_ns(self) -> np.ndarray:
        """[N] int64; a gap in the numbers is a gap in time."""
        return self.numbers * 10**9 // FRAME_RATE_HZ


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of a folder whose whole name matches; the pattern's group is the number."""
    matches = ((re.fullmatch(pattern, path.name), path) for path in sorted(folder.glob("*")))
    return {int(match[1]): path for match, path in matches if match}


def paired(color: dict[int, Path], depth: dict[int, Path], folder: Path) -> NumberedFrames:
    """Frames of equal numbers. Raises DataError, which names `folder`, when there are none."""
    numbers = sorted(color.keys() & depth.keys())
    if not numbers:
        raise DataError(
            f"{folder} has {len(color)} images of colour and {len(depth)} of depth, and no number "
            "that has both. Check the names of the files."
        )
    alone = len(color) + len(depth) - 2 * len(numbers)
    if alone:
        log.info("%s: %d images have no partner of their number and are left out", folder, alone)
    return NumberedFrames(
        np.array(numbers, np.int64), [color[k] for k in numbers], [depth[k] for k in numbers]
    )
