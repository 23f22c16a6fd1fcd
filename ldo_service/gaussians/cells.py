"""A quadtree over an image: small cells on edges, large ones on flats. Each becomes a Gaussian."""

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, slots=True)
class QuadtreeCells:
    """M squares of pixels that do not overlap: rows [row, row + size), columns likewise; int64."""

    row: np.ndarray
    column: np.ndarray
    size: np.ndarray

    def __len__(self) -> int:
        return len(self.size)

    @property
    def u(self) -> np.ndarray:
        """Pixel coordinate of the centres [M], to the right."""
        return self.column + (self.size - 1) / 2

    @property
    def v(self) -> np.ndarray:
        """Pixel coordinate of the centres [M], down."""
        return self.row + (self.size - 1) / 2

    def mean_of(self, image: np.ndarray) -> np.ndarray:
        """Mean of an image [H, W] or [H, W, C] over each cell, [M] or [M, C] float32."""
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
    """Split cells of `coarsest_px`, a power of 2, in four until each is uniform.

    A cell is uniform where the image gradient over it and a rim of one pixel amounts to no more
    than `max_contrast` in any channel (0..1), the depth in it varies by no more than the share
    `max_depth_step`, and all its pixels are wanted. A pixel that is not wanted belongs to no
    cell; every other to exactly one.

    color [H, W, 3] uint8, depth_m [H, W] float32, wanted [H, W] bool
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
    """With zeros at the right and bottom, so that blocks of `multiple` pixels fit."""
    missing = [(0, -n % multiple) for n in image.shape[:2]]
    return np.pad(image, missing + [(0, 0)] * (image.ndim - 2))


def _means(image: np.ndarray, size: int) -> np.ndarray:
    """Means of the blocks of size x size pixels that fit, [H // size, W // size, ...]."""
    height, width = (n // size for n in image.shape[:2])
    image = image[: height * size, : width * size]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _greatest(image: np.ndarray, size: int, rim: int = 0) -> np.ndarray:
    """Maxima of the blocks of size x size pixels and `rim` pixels around them."""
    window = np.ones((size + 2 * rim,) * 2, np.uint8)
    return cv2.dilate(image, window, anchor=(rim, rim))[::size, ::size]


def _least(image: np.ndarray, size: int, rim: int = 0) -> np.ndarray:
    window = np.ones((size + 2 * rim,) * 2, np.uint8)
    return cv2.erode(image, window, anchor=(rim, rim))[::size, ::size]
