"""What geometry and colour set apart in a keyframe: regions worth a name, and the room around them.

    apart      hangs together in depth, and is no structure (see `planes`)
    standing   what of that stands on a flat piece: a cup on a table, a cushion on a couch
    convex     what of that no concave crease divides: a cabinet beside an oven (Stein et al., CVPR
               2014: things are convex, and creases between them concave)
    flat       lies on structure, and is of another colour: a picture, a window, a rug
    room       a plane of structure itself: no thing, but what the box of one may show beside it

They overlap: a couch with its cushions is apart, the cushions stand on it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera

from .foreground import Foreground
from .planes import (
    DepthFeatures,
    PlaneConfig,
    Planes,
    compute_depth_features,
    disc,
    planes,
    shrink_factor,
    structural_planes,
)

Kind = Literal["apart", "standing", "convex", "flat", "room"]
_3X3 = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class GeometricSegmentationConfig:
    """Chosen as those of `PlaneConfig`; pixels are those of its small image."""

    planes: PlaneConfig = field(default_factory=PlaneConfig)
    min_px: int = 60  # of a segment
    max_gap: float = 0.06  # of depth within 3x3 pixels of one thing, share
    crease_px: int = 3  # to either side of a crease, where normals are compared
    crease: float = 0.35  # rad: a sharper concave one divides
    color_step: float = 1.5  # Lab, per pixel: more is an edge of colour
    color_gap: float = 4.5  # Lab, lightness counted half: what is nearer to a wall's colour is wall

    def __post_init__(self) -> None:
        if min(self.min_px, self.crease_px) < 1:
            raise ConfigError(
                named(self, "min_px", "crease_px") + ": min_px and crease_px must be at least 1."
            )
        if min(self.max_gap, self.crease, self.color_step, self.color_gap) <= 0:
            raise ConfigError(
                named(self, "max_gap", "crease", "color_step", "color_gap")
                + ": gaps and steps must be positive."
            )


@dataclass(frozen=True, eq=False, slots=True)
class Segment:
    kind: Kind
    part: Foreground


def segment_geometry(
    color: np.ndarray, depth_m: np.ndarray, camera: Camera, config: GeometricSegmentationConfig
) -> list[Segment]:
    """Of a keyframe: color [H, W, 3] uint8 RGB, depth [H, W] m, 0 where it is missing.

    The same images give the same segments.
    """
    # what is measured, made small
    seen = compute_depth_features(depth_m, camera, config.planes)
    found = planes(seen, config.planes)
    of_room = structural_planes(seen, found, config.planes)
    # what is no part of the room
    joined = _joined(seen, config)
    apart = (seen.inverse > 0) & (of_room == 0)
    apart = cv2.morphologyEx(apart.astype(np.uint8), cv2.MORPH_OPEN, _3X3) > 0
    apart &= joined | (seen.surfaces > 0)
    shown: list[tuple[Kind, np.ndarray]] = [
        ("apart", apart),
        ("standing", apart & joined & ~_on_planes(found, apart)),
    ]
    for mask in _divided(apart, _concave(seen, config), config):
        shown.append(("convex", mask))
    for mask in _colored(color, of_room, config, camera):
        shown.append(("flat", mask))
    # at the size of the image
    k = shrink_factor(camera.width, config.planes)
    things = [
        Segment(kind, _enlarged(_filled(part) if kind == "flat" else part, k))
        for kind, mask in shown
        for part in components(mask, config.min_px)
    ]
    numbers = np.unique(of_room[of_room > 0])
    return things + [
        Segment("room", _enlarged(Foreground(0, 0, of_room == number), k)) for number in numbers
    ]


def components(mask: np.ndarray, least_px: int = 1) -> Iterator[Foreground]:
    """What hangs together by its sides in mask [H, W] bool."""
    count, parts, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    for part in range(1, count):
        column, row, width, height, area = (int(value) for value in boxes[part])
        if area >= least_px:
            window = np.asarray(parts)[row : row + height, column : column + width]
            yield Foreground(row, column, window == part)


def _joined(seen: DepthFeatures, config: GeometricSegmentationConfig) -> np.ndarray:
    """Measured, and without a step of depth to a neighbour."""
    low = cv2.erode(seen.inverse, _3X3)
    return (low > 0) & (cv2.dilate(seen.inverse, _3X3) < (1 + config.max_gap) * low)


def _on_planes(found: Planes, apart: np.ndarray) -> np.ndarray:
    """Flat pieces of things, with their edges."""
    return cv2.dilate(((found.number > 0) & apart).astype(np.uint8), _3X3) > 0


def _concave(seen: DepthFeatures, config: GeometricSegmentationConfig) -> np.ndarray:
    """Where normals of neighbours turn towards each other: (p_b - p_a) . (n_b - n_a) < 0, for
    normals towards the camera, and by more than noise."""
    points = seen.rays / np.maximum(seen.smooth, np.float32(1e-3))[..., None]
    r, concave = config.crease_px, np.zeros(seen.inverse.shape, bool)
    for axis, inner in ((1, np.s_[:, r:-r]), (0, np.s_[r:-r])):
        turn, along = (_across(values, r, axis) for values in (seen.normals, points))
        is_sharp = np.linalg.norm(turn, axis=-1) > config.crease
        concave[inner] |= is_sharp & ((turn * along).sum(axis=-1) < 0)
    return concave


def _divided(
    apart: np.ndarray, concave: np.ndarray, config: GeometricSegmentationConfig
) -> Iterator[np.ndarray]:
    """[h, w] bool: the pieces of each thing between its creases, with what of these is theirs. What
    has most of a thing is the thing, and no piece."""
    of_thing = np.asarray(cv2.connectedComponents(apart.astype(np.uint8), connectivity=4)[1])
    sizes = np.bincount(of_thing.ravel())
    for part in components(apart & ~concave, config.min_px):
        image = part.image(apart.shape)
        thing = int(of_thing[image][0])
        piece = (cv2.dilate(image.astype(np.uint8), disc(config.crease_px)) > 0) & apart
        if np.count_nonzero(piece) < 0.5 * sizes[thing]:
            yield piece


def _across(values: np.ndarray, r: int, axis: int) -> np.ndarray:
    """Differences of what is r pixels to either side."""
    swapped = np.swapaxes(values, 0, axis)
    return np.swapaxes(swapped[2 * r :] - swapped[: -2 * r], 0, axis)


def _colored(
    color: np.ndarray, of_room: np.ndarray, config: GeometricSegmentationConfig, camera: Camera
) -> Iterator[np.ndarray]:
    """[h, w] bool for each plane of the room: what on it is of another colour than most of it."""
    k, (height, width) = shrink_factor(camera.width, config.planes), of_room.shape
    small = cv2.resize(
        color[: height * k, : width * k], (width, height), interpolation=cv2.INTER_AREA
    )
    lab = cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    is_even = _steps(lab) < config.color_step
    for number in np.unique(of_room[of_room > 0]):
        plane = cv2.morphologyEx((of_room == number).astype(np.uint8), cv2.MORPH_CLOSE, disc(2)) > 0
        other = plane & ~_of_plane(plane & is_even, lab, config)
        yield cv2.morphologyEx(other.astype(np.uint8), cv2.MORPH_OPEN, disc(1)) > 0


def _steps(lab: np.ndarray) -> np.ndarray:
    """[h, w] Lab per pixel."""
    smooth = cv2.GaussianBlur(lab, (0, 0), 1.0)
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    return np.sqrt((across * across + down * down).sum(axis=-1))


def _of_plane(even: np.ndarray, lab: np.ndarray, config: GeometricSegmentationConfig) -> np.ndarray:
    """Of the even pieces of a plane [h, w] bool: the largest, and those of its colour; grown over
    their edges."""
    count, parts = cv2.connectedComponents(even.astype(np.uint8), connectivity=4)
    parts = np.asarray(parts, np.int32)
    sizes = np.bincount(parts.ravel(), minlength=count)
    sizes[0] = 0
    large = np.flatnonzero(sizes >= config.min_px)
    if len(large) == 0:
        return even
    weight = np.array([0.5, 1, 1], np.float32)
    colors = {int(k): np.median(lab[parts == k], axis=0) * weight for k in large}
    most = colors[int(sizes.argmax())]
    is_same = np.zeros(count, bool)
    is_same[[p for p, c in colors.items() if np.linalg.norm(c - most) < config.color_gap]] = True
    return cv2.dilate(is_same[parts].astype(np.uint8), _3X3, iterations=2) > 0


def _filled(part: Foreground) -> Foreground:
    """With what it goes around, and a pixel more: what its colour begins in is an edge."""
    outline, _ = cv2.findContours(
        part.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    mask = cv2.drawContours(np.zeros(part.mask.shape, np.uint8), outline, -1, 1, cv2.FILLED)
    return Foreground(part.row, part.column, cv2.dilate(mask, _3X3) > 0)


def _enlarged(part: Foreground, k: int) -> Foreground:
    mask = np.repeat(np.repeat(part.mask, k, axis=0), k, axis=1)
    return Foreground(k * part.row, k * part.column, mask)
