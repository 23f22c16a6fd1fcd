"""Foreground masks of detected boxes, and masks that lie within others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera
from ldo_service.kernels import _foreground

MOST = 1e6  # of a share


@dataclass(frozen=True, slots=True)
class ForegroundConfig:
    """Chosen on 275 frames of a Replica apartment, where figures from half to twice of each change
    the mIoU of what two detectors found by less than one point."""

    max_step: float = 0.05  # of depth within 3x3 pixels of one surface, share
    min_cosine: float = 0.9  # of normals 4 px apart on one surface
    min_inside: float = 0.5  # of a surface, to belong to the box: floors and walls go on outside
    max_gap: float = 0.15  # of depth within 3x3 pixels of one object, share
    depth_bin: float = 0.05  # of the mode of depths, share
    near_mode: float = 0.1  # share: where the object begins to grow
    grow_px: int = 2  # over its noisy edges

    def __post_init__(self) -> None:
        shares = (self.max_step, self.min_cosine, self.min_inside, self.max_gap, self.near_mode)
        if not (min(shares) >= 0 and max(self.min_cosine, self.min_inside) <= 1):
            raise ConfigError(
                named(self, "max_step", "min_cosine", "min_inside", "max_gap", "near_mode")
                + ": shares must not be negative, cosine and inside at most 1."
            )
        if max(shares) > MOST:
            raise ConfigError(
                named(self, "max_step", "min_cosine", "min_inside", "max_gap", "near_mode")
                + f": shares may be {MOST:g} at most, which leaves nothing out."
            )
        if not (1e-4 <= self.depth_bin <= 1 and 0 <= self.grow_px <= 64):
            raise ConfigError(
                named(self, "depth_bin", "grow_px")
                + ": depth_bin must be within 1e-4..1, grow_px within 0..64."
            )


@dataclass(frozen=True, eq=False, slots=True)
class SmoothSurfaces:
    """Smooth pieces of a depth image, as `surfaces` finds them.

    labels [H, W] int32, 0 on edges and where depth is missing; sizes [S] int64, px, of each label
    """

    labels: np.ndarray
    sizes: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class Foreground:
    """Part of a box: `mask` [h, w] bool, whose first pixel lies at (row, column) of the image."""

    row: int
    column: int
    mask: np.ndarray

    def image(self, shape: tuple[int, ...]) -> np.ndarray:
        """[H, W] bool."""
        out = np.zeros(shape, bool)
        height, width = self.mask.shape
        out[self.row : self.row + height, self.column : self.column + width] = self.mask
        return out

    @property
    def box_px(self) -> np.ndarray:
        """[4], x0 y0 x1 y1 around the whole mask, pixel centres at integers.

        >>> Foreground(2, 1, np.ones((3, 4), bool)).box_px.tolist()
        [0.5, 1.5, 4.5, 4.5]
        """
        height, width = self.mask.shape
        corners = self.column, self.row, self.column + width, self.row + height
        return np.array(corners) - 0.5

    def pack(self) -> tuple[tuple[int, ...], np.ndarray]:
        """Row, column and shape, and the mask as bits: for a state."""
        return (self.row, self.column, *self.mask.shape), np.packbits(self.mask)

    @staticmethod
    def unpack(place: Sequence[int], bits: np.ndarray) -> "Foreground":
        row, column, height, width = place
        mask = np.unpackbits(bits, count=height * width).reshape(height, width).astype(bool)
        return Foreground(row, column, mask)


def surfaces(depth_m: np.ndarray, camera: Camera, config: ForegroundConfig) -> SmoothSurfaces:
    """Pieces of depth without steps and creases, connected by their sides. Once per keyframe, for
    all boxes: 0.8 ms for 640x480.

    A pixel belongs to one where within 3x3 pixels no depth is missing and none is max_step times
    more than another, and where the normals of blurred depth two pixels left and right of it, and
    those above and below, have cosines above min_cosine.

    depth_m [H, W], m, NaN or not above 0 where it is missing, of `camera` without distortion.
    Pieces are numbered from 1 on, in the order of their first pixels, row by row. Where a cosine
    is at its threshold the outcome may differ between instruction sets. Raises ValueError for an
    image that is not of the camera's size.
    """
    if depth_m.shape != (camera.height, camera.width):
        raise ValueError(f"depth_m has shape {depth_m.shape}, which is not that of {camera}.")
    labels = np.empty(depth_m.shape, np.int32)
    sizes = _foreground.surfaces(
        np.ascontiguousarray(depth_m, np.float32),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        config.max_step,
        config.min_cosine,
        labels,
    )
    return SmoothSurfaces(labels, sizes)


def foreground(
    box: np.ndarray,
    depth_m: np.ndarray,
    found: SmoothSurfaces,
    camera: Camera,
    config: ForegroundConfig,
) -> Foreground:
    """The object that fills the middle of a box x0 y0 x1 y1 (px) of a depth image [H, W] (m), of
    which `found` are the surfaces.

    Its surfaces lie mostly inside the box, and no further from the mode of the depths about its
    centre than it is wide; it is what of them hangs together, edges included, with what is at that
    depth in the middle half. Empty where depth is missing, or where only a wall is there. Raises
    ValueError for surfaces of another image.
    """
    rows, columns = pixels_of(box, depth_m.shape)
    mask = np.zeros((rows.stop - rows.start, columns.stop - columns.start), bool)
    if mask.size:
        _foreground.foreground(
            np.ascontiguousarray(depth_m, np.float32),
            min(camera.fx, camera.fy),
            found.labels,
            found.sizes,
            rows.start,
            columns.start,
            config.min_inside,
            config.max_gap,
            config.depth_bin,
            config.near_mode,
            config.grow_px,
            mask.view(np.uint8),
        )
    return Foreground(rows.start, columns.start, mask)


def pixels_of(box: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of the pixels whose centres lie in a box, within the image."""

    def within(low: float, high: float, size: int) -> slice:
        start = min(max(0, int(np.ceil(low))), size)
        return slice(start, max(start, min(size, int(np.floor(high)) + 1)))

    x0, y0, x1, y1 = box
    return within(y0, y1, shape[0]), within(x0, x1, shape[1])


@dataclass(frozen=True, slots=True)
class NestingConfig:
    """Two regions of which one lies in the other are no rivals: both may be there. As rivals, by
    score, a table of 0.9 would win the pixels of a cup of 0.5."""

    inside: float = 0.8  # share of the smaller one, to lie in the larger
    times: float = 2.0  # as large: less, and they are of one thing
    least_score: float = 0.5  # of the smaller: many boxes below are wrong

    def __post_init__(self) -> None:
        if not (0 < self.inside <= 1 and self.times > 1 and self.least_score >= 0):
            raise ConfigError(
                named(self, "inside", "times", "least_score")
                + ": inside within 0..1, times over 1, least_score not negative."
            )


def without_nested(
    parts: Sequence[Foreground], scores: np.ndarray, config: NestingConfig
) -> list[Foreground]:
    """Each of M parts but for the pixels of those that lie in it; scores [M].

    >>> table = Foreground(0, 0, np.ones((4, 8), bool))
    >>> cup = Foreground(1, 2, np.ones((2, 2), bool))
    >>> left, whole = without_nested([table, cup], np.array([0.9, 0.5]), NestingConfig())
    >>> int(left.mask.sum()), int(whole.mask.sum())
    (28, 4)
    """
    sizes = [np.count_nonzero(part.mask) for part in parts]
    left = [part.mask for part in parts]
    for i in np.flatnonzero(np.asarray(scores) >= config.least_score).tolist():
        for k in range(len(parts)):
            if 0 < config.times * sizes[i] <= sizes[k] and (both := _shared(parts[i], parts[k])):
                of_small, of_large = both
                shared = parts[i].mask[of_small] & parts[k].mask[of_large]
                if np.count_nonzero(shared) >= config.inside * sizes[i]:
                    left[k] = left[k].copy()
                    left[k][of_large] &= ~shared
    return [Foreground(p.row, p.column, mask) for p, mask in zip(parts, left, strict=True)]


Window = tuple[slice, slice]


def _shared(a: Foreground, b: Foreground) -> tuple[Window, Window] | None:
    """The window that the masks of both have, in each; None where they have none."""
    top, left = max(a.row, b.row), max(a.column, b.column)
    bottom = min(a.row + a.mask.shape[0], b.row + b.mask.shape[0])
    right = min(a.column + a.mask.shape[1], b.column + b.mask.shape[1])
    if top >= bottom or left >= right:
        return None
    of_a, of_b = (
        (slice(top - p.row, bottom - p.row), slice(left - p.column, right - p.column))
        for p in (a, b)
    )
    return of_a, of_b


@dataclass(frozen=True, eq=False, slots=True)
class RegionDetections:
    """What is said to be in M boxes of a keyframe.

    boxes                  [M, 4], x0 y0 x1 y1, px, pixel centres at integers
    labels, confidences    [M] of the detector; confidence 0: it says nothing
    open_labels, open_confidences [M] of the open-vocabulary labeller; 0: it was not invoked
    parts                  what of each box it is; None, or none at all: what is found in it
    anew                   what their Gaussians were taken for before was said of another thing
    """

    boxes: np.ndarray
    labels: np.ndarray
    confidences: np.ndarray
    open_labels: np.ndarray
    open_confidences: np.ndarray
    parts: tuple[Foreground | None, ...] = ()
    replaces_labels: bool = False

    @classmethod
    def of_detector(
        cls, boxes: np.ndarray, labels: np.ndarray, confidences: np.ndarray
    ) -> "RegionDetections":
        return cls(boxes, labels, confidences, labels, np.zeros(len(boxes), np.float32))

    @classmethod
    def none(cls) -> "RegionDetections":
        return cls.of_detector(np.zeros((0, 4), np.float32), *np.zeros((2, 0), np.float32))

    def where(self, mask: np.ndarray) -> "RegionDetections":
        """Those of a mask [M]."""
        parts = tuple(part for part, is_in in zip(self.parts, mask, strict=False) if is_in)
        return RegionDetections(
            self.boxes[mask],
            self.labels[mask],
            self.confidences[mask],
            self.open_labels[mask],
            self.open_confidences[mask],
            parts,
            self.replaces_labels,
        )

    def scores(self) -> np.ndarray:
        """[M], by which regions compete where they overlap."""
        return np.maximum(self.confidences, self.open_confidences)

    def classes(self) -> np.ndarray:
        """[M, 2] labels of detector and labeller, -1 where they say nothing."""
        said = (self.labels, self.confidences), (self.open_labels, self.open_confidences)
        return np.stack([np.where(sure > 0, one.astype(int), -1) for one, sure in said], axis=1)
