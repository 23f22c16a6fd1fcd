"""Foreground masks: the pixels of a detected box that show its object."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera
from ldo_service.kernels import _foreground

MAX_RATIO = 1e6  # Maximum value of a relative setting.


@dataclass(frozen=True, slots=True)
class ForegroundConfig:
    """Settings of the foreground masks.

    The values were chosen on 275 frames of a Replica apartment with two detectors. Halving or
    doubling any of them changes the mIoU of the objects by less than one percentage point.
    """

    max_step: float = 0.05  # Maximum relative depth step within 3x3 pixels of one surface.
    min_cosine: float = 0.9  # Minimum cosine of normals 4 px apart on one surface.
    # Minimum fraction of a surface inside the box. This limit excludes floors and walls, which
    # extend outside of the box.
    min_inside: float = 0.5
    max_gap: float = 0.15  # Maximum relative depth step within 3x3 pixels of one object.
    # Bin width, relative to the depth, of the histogram whose mode is the object's depth.
    depth_bin: float = 0.05
    # Maximum difference, relative to the mode, of depths that count as the object's depth.
    near_mode: float = 0.1
    grow_px: int = 2  # Growth of the mask over the noisy edges of the object.

    def __post_init__(self) -> None:
        shares = (self.max_step, self.min_cosine, self.min_inside, self.max_gap, self.near_mode)
        if not (min(shares) >= 0 and max(self.min_cosine, self.min_inside) <= 1):
            raise ConfigError(
                named(self, "max_step", "min_cosine", "min_inside", "max_gap", "near_mode")
                + ": these must be at least 0; min_cosine and min_inside must be at most 1."
            )
        if max(shares) > MAX_RATIO:
            raise ConfigError(
                named(self, "max_step", "min_cosine", "min_inside", "max_gap", "near_mode")
                + f": these settings must be at most {MAX_RATIO:g}."
            )
        if not (1e-4 <= self.depth_bin <= 1 and 0 <= self.grow_px <= 64):
            raise ConfigError(
                named(self, "depth_bin", "grow_px")
                + ": depth_bin must be in 1e-4..1, and grow_px must be in 0..64."
            )


@dataclass(frozen=True, eq=False, slots=True)
class SmoothSurfaces:
    """Smooth surfaces of a depth image, found by `surfaces`.

    Attributes:
        labels: Number of the surface of each pixel, [H, W] int32; 0 on edges and where depth is
            unknown.
        sizes: Number of pixels with each of the labels 0..S-1, [S] int64.
    """

    labels: np.ndarray
    sizes: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class Foreground:
    """Mask of an object, stored for a window of the image.

    Attributes:
        row: First row of the window in the image.
        column: First column of the window in the image.
        mask: Pixels of the object in the window, [h, w] bool.
    """

    row: int
    column: int
    mask: np.ndarray

    def image(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return the mask as a whole image of the given shape, [H, W] bool."""
        out = np.zeros(shape, bool)
        height, width = self.mask.shape
        out[self.row : self.row + height, self.column : self.column + width] = self.mask
        return out

    @property
    def box_px(self) -> np.ndarray:
        """Box around the window of the mask, [4], x0 y0 x1 y1, with pixel centers at integers.

        >>> Foreground(2, 1, np.ones((3, 4), bool)).box_px.tolist()
        [0.5, 1.5, 4.5, 4.5]
        """
        height, width = self.mask.shape
        corners = self.column, self.row, self.column + width, self.row + height
        return np.array(corners) - 0.5

    def pack(self) -> tuple[tuple[int, ...], np.ndarray]:
        """Return (row, column, h, w) and the mask as packed bits, for a checkpoint."""
        return (self.row, self.column, *self.mask.shape), np.packbits(self.mask)

    @staticmethod
    def unpack(place: Sequence[int], bits: np.ndarray) -> "Foreground":
        """Restore a foreground from `pack`."""
        row, column, height, width = place
        mask = np.unpackbits(bits, count=height * width).reshape(height, width).astype(bool)
        return Foreground(row, column, mask)


def surfaces(depth_m: np.ndarray, camera: Camera, config: ForegroundConfig) -> SmoothSurfaces:
    """Find the smooth surfaces of a depth image, which end at depth steps and creases.

    One call per keyframe is enough for all boxes of the detector. A call takes 0.8 ms for 640x480
    pixels. A pixel belongs to a surface if two conditions hold:

    - All depths in the 3x3 pixels around it are known, and no two of these depths differ by more
      than the fraction max_step.
    - Two cosines are above min_cosine: between the normals 2 px to its left and 2 px to its right,
      and between the normals 2 px above and 2 px below it. The normals are computed from blurred
      depth.

    Two such pixels that share a side belong to the same surface. Surfaces are numbered from 1 in
    the order of their first pixels, row by row. If a cosine is exactly at its threshold, the result
    may differ between instruction sets.

    Args:
        depth_m: Depth, [H, W], meters; NaN or not above 0 where unknown.
        camera: Intrinsics of the depth, without distortion.
        config: Settings.

    Raises:
        ValueError: If depth_m does not have the size of the camera's images.
    """
    if depth_m.shape != (camera.height, camera.width):
        raise ValueError(
            f"depth_m has shape {depth_m.shape}, but the camera's images have shape "
            f"{camera.height, camera.width}. Give the camera of the depth image."
        )
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
    """Return the mask of the object in the middle of a box.

    The depth of the object is the mode of the depths in the middle half of the box. A pixel may
    belong to the object if two conditions hold:

    - The pixel lies on an edge, or on a surface that lies mostly inside the box.
    - Its depth differs from the object's depth by less than the longer side of the box in meters,
      or by less than the fraction near_mode of the object's depth.

    Such pixels form connected parts without depth steps above max_gap. The mask consists of the
    parts that contain at least a tenth of the pixels at the object's depth in the middle half.

    Args:
        box: The box, [4], x0 y0 x1 y1, pixels.
        depth_m: Depth, [H, W], meters; not above 0 where unknown.
        found: Surfaces of the depth image.
        camera: Intrinsics of the depth.
        config: Settings.

    Returns:
        The mask of the object. The mask has no pixels if the depth is unknown, or if the box shows
        only a wall.

    Raises:
        ValueError: If the surfaces have another size than the depth image.
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
    """Return the rows and columns of an image of this shape whose pixel centers lie in a box."""

    def within(low: float, high: float, size: int) -> slice:
        start = min(max(0, int(np.ceil(low))), size)
        return slice(start, max(start, min(size, int(np.floor(high)) + 1)))

    x0, y0, x1, y1 = box
    return within(y0, y1, shape[0]), within(x0, x1, shape[1])


@dataclass(frozen=True, slots=True)
class NestingConfig:
    """Settings of nested regions: an object in front of a larger one, such as a cup on a table.

    The smaller region gets the pixels that both regions contain, even if its score is lower. If the
    higher score decided, a table with a score of 0.9 would get the pixels of a cup with a score of
    0.5.
    """

    inside: float = 0.8  # Minimum fraction of the smaller region that lies in the larger region.
    # Minimum size of the larger region divided by the size of the smaller one; below this ratio,
    # both regions show the same object.
    times: float = 2.0
    # Minimum score of the smaller region; many boxes with lower scores are wrong.
    min_score: float = 0.5

    def __post_init__(self) -> None:
        if not (0 < self.inside <= 1 and self.times > 1 and self.min_score >= 0):
            raise ConfigError(
                named(self, "inside", "times", "min_score")
                + ": inside must be in (0, 1], times above 1, and min_score at least 0."
            )


def without_nested(
    parts: Sequence[Foreground], scores: np.ndarray, config: NestingConfig
) -> list[Foreground]:
    """Remove from each of M masks the pixels of smaller masks that are nested in it.

    Args:
        parts: The masks, M.
        scores: Scores of the masks, [M]. The pixels of a mask with a score below `min_score` stay
            in the larger masks.
        config: Settings.

    Returns:
        The masks without the pixels of nested masks, M.

    >>> table = Foreground(0, 0, np.ones((4, 8), bool))
    >>> cup = Foreground(1, 2, np.ones((2, 2), bool))
    >>> left, whole = without_nested([table, cup], np.array([0.9, 0.5]), NestingConfig())
    >>> int(left.mask.sum()), int(whole.mask.sum())
    (28, 4)
    """
    sizes = [np.count_nonzero(part.mask) for part in parts]
    left = [part.mask for part in parts]
    for i in np.flatnonzero(np.asarray(scores) >= config.min_score).tolist():
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
    """Return the common window of two masks, as rows and columns of mask a and of mask b.

    The result is None if the windows of the masks do not intersect.
    """
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
    """Boxes of a keyframe with labels by the detector and by the labeller.

    Attributes:
        boxes: Boxes, [M, 4], x0 y0 x1 y1, pixels, with pixel centers at integers.
        labels: Label ids by the detector, [M]; unused where the detector's confidence is 0.
        confidences: Confidences of the detector, [M], 0..1; 0 without a detection.
        open_labels: Label ids by the open-vocabulary labeller, [M]; unused where the labeller's
            confidence is 0.
        open_confidences: Confidences of the labeller, [M], 0..1; 0 without a label by the labeller.
        parts: Mask of the object in each box. If a mask is None, the foreground of the box is
            computed later. An empty tuple means None for all boxes.
        replaces_labels: True if the earlier labels of the Gaussians in the regions must be deleted,
            because those labels describe another object.
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
        """Return detections with labels by the detector alone.

        Args:
            boxes: Boxes, [M, 4], x0 y0 x1 y1, pixels.
            labels: Labels, [M].
            confidences: Confidences of the labels, [M], 0..1.
        """
        return cls(boxes, labels, confidences, labels, np.zeros(len(boxes), np.float32))

    @classmethod
    def none(cls) -> "RegionDetections":
        """Return detections without any box."""
        return cls.of_detector(np.zeros((0, 4), np.float32), *np.zeros((2, 0), np.float32))

    def where(self, mask: np.ndarray) -> "RegionDetections":
        """Return the detections of the boxes for which `mask`, [M] bool, is true."""
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
        """Return the score of each box, [M]: the larger confidence of detector and labeller.

        Scores decide which of several overlapping regions a Gaussian is assigned to.
        """
        return np.maximum(self.confidences, self.open_confidences)

    def classes(self) -> np.ndarray:
        """Return the labels by the detector and by the labeller, [M, 2] int; -1 if missing."""
        sources = (self.labels, self.confidences), (self.open_labels, self.open_confidences)
        return np.stack([np.where(sure > 0, one.astype(int), -1) for one, sure in sources], axis=1)

    def pack(self) -> list[np.ndarray]:
        """Return the boxes, labels and confidences for a checkpoint; the masks are omitted."""
        labels = self.labels, self.confidences, self.open_labels, self.open_confidences
        return [self.boxes, *labels]


def share_a_class(classes: np.ndarray) -> np.ndarray:
    """Return which pairs of M regions may show objects of one class, [M, M] bool.

    Two regions share a class if any label of one equals any label of the other.

    Args:
        classes: Labels by the detector and by the labeller, [M, 2]; -1 if missing. See
            `RegionDetections.classes`.

    >>> share_a_class(np.array([[3, -1], [-1, 3], [-1, -1]])).astype(int)
    array([[1, 1, 0],
           [1, 1, 0],
           [0, 0, 0]])
    """
    is_same = (classes[:, None, :, None] == classes[:, None]) & (classes >= 0)[:, None]
    return np.any(is_same, axis=(2, 3))
