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
        if not len(self):
            return out
        # Rows above and below all cells are not read.
        largest = int(self.size.max())
        first = int(self.row.min()) // largest * largest
        image = image[first : int((self.row + self.size).max())].astype(np.float32, copy=False)
        for size in np.unique(self.size).tolist():
            these = np.flatnonzero(self.size == size)
            row, column = (self.row[these] - first) // size, self.column[these] // size
            out[these] = (_means(image, size) if size > 1 else image)[row, column]
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
            uniform &= _contrast(color, size) <= 255 * max_contrast
            uniform &= farthest - nearest <= max_depth_step * farthest
        places = np.flatnonzero(undecided & uniform)  # Faster than `np.nonzero` of two axes.
        row, column = np.divmod(places, undecided.shape[1])
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


def _contrast(color: np.ndarray, size: int) -> np.ndarray:
    """Return the largest range of a channel in each block of size x size pixels and its rim.

    The rim is one pixel wide.
    """
    window, anchor = np.ones((size + 2,) * 2, np.uint8), (1, 1)
    highest = cv2.dilate(color, window, anchor=anchor)
    lowest = cv2.erode(color, window, anchor=anchor)
    red, green, blue = cv2.split(cv2.subtract(highest, lowest))
    return cv2.max(cv2.max(red, green), blue)[::size, ::size]


def _greatest(image: np.ndarray, size: int) -> np.ndarray:
    """Return the maximum over each block of size x size pixels."""
    return cv2.dilate(image, np.ones((size, size), np.uint8), anchor=(0, 0))[::size, ::size]


def _least(image: np.ndarray, size: int) -> np.ndarray:
    return cv2.erode(image, np.ones((size, size), np.uint8), anchor=(0, 0))[::size, ::size]
