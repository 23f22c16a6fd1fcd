"""Quadtree over an image: small cells at edges, large cells on uniform areas.

Densification makes one Gaussian from each cell.
"""

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, slots=True)
class QuadtreeCells:
    """M square cells of pixels that do not overlap.

    A cell covers the rows [row, row + size) and the columns [column, column + size).

    Attributes:
        row: First row, [M] int64.
        column: First column, [M] int64.
        size: Edge in pixels, [M] int64.
    """

    row: np.ndarray
    column: np.ndarray
    size: np.ndarray

    def __len__(self) -> int:
        return len(self.size)

    @property
    def u(self) -> np.ndarray:
        """Horizontal pixel coordinates of the cell centers, [M]; they increase to the right."""
        return self.column + (self.size - 1) / 2

    @property
    def v(self) -> np.ndarray:
        """Vertical pixel coordinates of the cell centers, [M]; they increase downward."""
        return self.row + (self.size - 1) / 2

    def mean_of(self, image: np.ndarray) -> np.ndarray:
        """Return the mean of an image over each cell.

        Args:
            image: Image with one channel [H, W] or C channels [H, W, C].

        Returns:
            Means of the M cells, [M] or [M, C] float32.
        """
        out = np.empty((len(self), *image.shape[2:]), np.float32)
        for size in np.unique(self.size).tolist():
            blocks = _means(image.astype(np.float32, copy=False), size)
            these = np.flatnonzero(self.size == size)
            out[these] = blocks[self.row[these] // size, self.column[these] // size]
        return out


def quadtree(
    color: np.ndarray,
    depth_m: np.ndarray,
    wanted: np.ndarray,
    *,
    coarsest_px: int,
    max_contrast: float,
    max_depth_step: float,
) -> QuadtreeCells:
    """Divide an image into square cells; cells that are not uniform are split into four.

    A cell is uniform if three conditions hold. For a cell of one pixel, only the third one counts.

    - In the cell and a rim of one pixel, the values of each color channel differ by at most
      `max_contrast` times 255.
    - The depths in the cell differ by at most `max_depth_step` times the largest depth in it.
    - All pixels of the cell are in `wanted`.

    Args:
        color: Image, [H, W, 3] uint8.
        depth_m: Depth of the image, [H, W] float32, meters.
        wanted: Pixels to cover, [H, W] bool. Each of these pixels is in exactly one cell; all other
            pixels are in no cell.
        coarsest_px: Edge of the largest cells, a power of 2.
        max_contrast: Largest color difference in a uniform cell, as a fraction of 255.
        max_depth_step: Largest depth difference in a uniform cell, as a fraction of the largest
            depth in it.

    Returns:
        The cells, from the largest size to single pixels.
    """
    color, depth_m = _padded(color, coarsest_px), _padded(depth_m, coarsest_px)
    wanted = _padded(wanted.astype(np.uint8), coarsest_px)
    undecided = np.ones([n // coarsest_px for n in wanted.shape], bool)
    levels, size = [], coarsest_px
    while size >= 1:
        uniform = _least(wanted, size) > 0
        if size > 1:
            farthest, nearest = _greatest(depth_m, size), _least(depth_m, size)
            contrast = _greatest(color, size, rim=1) - _least(color, size, rim=1)
            uniform &= contrast.max(axis=-1) <= 255 * max_contrast
            uniform &= farthest - nearest <= max_depth_step * farthest
        row, column = np.nonzero(undecided & uniform)
        levels.append((row * size, column * size, np.full(len(row), size)))
        undecided = (undecided & ~uniform).repeat(2, 0).repeat(2, 1)
        size //= 2
    return QuadtreeCells(*(np.concatenate(field) for field in zip(*levels, strict=True)))


def _padded(image: np.ndarray, multiple: int) -> np.ndarray:
    """Pad with zeros at the right and bottom to a multiple of `multiple` pixels."""
    missing = [(0, -n % multiple) for n in image.shape[:2]]
    return np.pad(image, missing + [(0, 0)] * (image.ndim - 2))


def _means(image: np.ndarray, size: int) -> np.ndarray:
    """Return the mean of each whole block of size x size pixels, [H // size, W // size, ...]."""
    height, width = (n // size for n in image.shape[:2])
    image = image[: height * size, : width * size]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _greatest(image: np.ndarray, size: int, rim: int = 0) -> np.ndarray:
    """Return the maximum over each block of size x size pixels and its rim of `rim` pixels."""
    window = np.ones((size + 2 * rim,) * 2, np.uint8)
    return cv2.dilate(image, window, anchor=(rim, rim))[::size, ::size]


def _least(image: np.ndarray, size: int, rim: int = 0) -> np.ndarray:
    window = np.ones((size + 2 * rim,) * 2, np.uint8)
    return cv2.erode(image, window, anchor=(rim, rim))[::size, ::size]
