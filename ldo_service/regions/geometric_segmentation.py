"""Segments of a keyframe by geometry and color: possible objects and structural planes.

A segment has one of five kinds:

    apart      a connected surface without depth steps that is not on a structural plane (`planes`)
    standing   a part of a segment `apart` that stands on a flat surface: a cup on a table
    convex     a part of a segment `apart` between concave creases: a cabinet next to an oven
    flat       a part of a structural plane in another color than the plane: a picture, a rug
    room       a structural plane, which is no object but may appear in an object's box

Convex segments follow Stein et al., CVPR 2014: objects are convex, and creases between them are
concave. Segments overlap: a couch with its cushions is one segment `apart`, and each cushion on it
is a segment `standing`.
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
    dot,
    planes,
    shrink_factor,
    structural_planes,
)

Kind = Literal["apart", "standing", "convex", "flat", "room"]
_3X3 = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class GeometricSegmentationConfig:
    """Settings of the segmentation of a keyframe by geometry and color.

    Settings that end in `_px` are in pixels of the small image, which is the depth image scaled
    down (see `PlaneConfig`). The values were chosen on the sequence `synthetic:flat`.
    """

    planes: PlaneConfig = field(default_factory=PlaneConfig)
    min_px: int = 60  # Minimum number of pixels of a segment.
    max_gap: float = 0.06  # Maximum relative depth step within 3x3 pixels of one object.
    crease_px: int = 3  # Distance to either side of a crease at which normals are compared.
    # Minimum difference of the normals (rad) at a concave crease that divides a segment.
    crease: float = 0.35
    color_step: float = 1.5  # Minimum gradient (Lab per pixel) of a color edge.
    # Minimum color difference between a flat segment, such as a picture or a rug, and the main
    # color of the wall, floor or ceiling that it lies on (Lab, lightness weighted by half).
    color_gap: float = 4.5

    def __post_init__(self) -> None:
        if min(self.min_px, self.crease_px) < 1:
            raise ConfigError(
                named(self, "min_px", "crease_px") + ": min_px and crease_px must be at least 1."
            )
        if min(self.max_gap, self.crease, self.color_step, self.color_gap) <= 0:
            raise ConfigError(
                named(self, "max_gap", "crease", "color_step", "color_gap")
                + ": these settings must be positive."
            )


@dataclass(frozen=True, eq=False, slots=True)
class Segment:
    """Segment of a keyframe: the pixels of a possible object or of a structural plane."""

    kind: Kind  # One of the five kinds; the module describes them.
    part: Foreground  # Mask of the segment.


def segment_geometry(
    color: np.ndarray, depth_m: np.ndarray, camera: Camera, config: GeometricSegmentationConfig
) -> list[Segment]:
    """Segment a keyframe by geometry and color; the result is deterministic.

    Args:
        color: Color image, [H, W, 3] uint8 RGB.
        depth_m: Depth, [H, W], meters; 0 where unknown.
        camera: Intrinsics of both images.
        config: Settings.

    Returns:
        The segments, in pixels of the full image; the structural planes (`room`) come last.
    """
    # Features of the small depth image.
    seen = compute_depth_features(depth_m, camera, config.planes)
    found = planes(seen, config.planes)
    of_room = structural_planes(seen, found, config.planes)
    # Pixels outside of the structural planes.
    joined = _joined(seen, config)
    apart = (seen.inverse > 0) & (of_room == 0)
    apart = cv2.morphologyEx(apart.astype(np.uint8), cv2.MORPH_OPEN, _3X3) > 0
    apart &= joined | (seen.surfaces > 0)
    shown: list[tuple[Kind, np.ndarray]] = [
        ("apart", apart),
        ("standing", apart & joined & ~_on_planes(found, apart)),
    ]
    shown.extend(("convex", mask) for mask in _divided(apart, _concave(seen, config), config))
    shown.extend(("flat", mask) for mask in _colored(color, of_room, config, camera))
    # Enlarge the segments to the size of the image.
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


def components(mask: np.ndarray, min_px: int = 1) -> Iterator[Foreground]:
    """Yield each 4-connected component of a mask, [H, W] bool, of at least `min_px` pixels."""
    if not mask.any():
        return
    count, parts, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    for part in range(1, count):
        column, row, width, height, area = (int(value) for value in boxes[part])
        if area >= min_px:
            window = np.asarray(parts)[row : row + height, column : column + width]
            yield Foreground(row, column, window == part)


def _joined(seen: DepthFeatures, config: GeometricSegmentationConfig) -> np.ndarray:
    """Return the pixels with known depth and without a depth step to a neighbor, [h, w] bool."""
    low = cv2.erode(seen.inverse, _3X3)
    return (low > 0) & (cv2.dilate(seen.inverse, _3X3) < (1 + config.max_gap) * low)


def _on_planes(found: Planes, apart: np.ndarray) -> np.ndarray:
    """Return the pixels of `apart` on planes together with the pixels next to them, [h, w] bool.

    Args:
        found: All planes of the keyframe.
        apart: Pixels that are not on structural planes, [h, w] bool.
    """
    return cv2.dilate(((found.number > 0) & apart).astype(np.uint8), _3X3) > 0


def _concave(seen: DepthFeatures, config: GeometricSegmentationConfig) -> np.ndarray:
    """Return the pixels on concave creases, [h, w] bool.

    Let a and b be the pixels at the distance `config.crease_px` to the left and to the right of a
    pixel, or above and below. With their points p and unit normals n, the pixel is on a crease if
    (p_b - p_a) . (n_b - n_a) < 0 and |n_b - n_a| > `config.crease`. The first inequality defines a
    concave crease for normals towards the camera (Stein et al.); `DepthFeatures.normals` point away
    from the camera.
    """
    points = seen.rays / np.maximum(seen.smooth, np.float32(1e-3))[..., None]
    r, concave = config.crease_px, np.zeros(seen.inverse.shape, bool)
    for axis, inner in ((1, np.s_[:, r:-r]), (0, np.s_[r:-r])):
        turn, along = (_across(values, r, axis) for values in (seen.normals, points))
        is_sharp = np.sqrt(dot(turn, turn)) > config.crease
        concave[inner] |= is_sharp & (dot(turn, along) < 0)
    return concave


def _divided(
    apart: np.ndarray, concave: np.ndarray, config: GeometricSegmentationConfig
) -> Iterator[np.ndarray]:
    """Yield the convex pieces of each component of `apart`, [h, w] bool.

    The pixels on concave creases, `concave` [h, w] bool, divide a component into pieces. Each piece
    is grown over the creases around it. A piece with at least half of the component's pixels is not
    yielded, because it shows the same object as the component.
    """
    of_thing = np.asarray(cv2.connectedComponents(apart.astype(np.uint8), connectivity=4)[1])
    sizes = np.bincount(of_thing.ravel())
    for part in components(apart & ~concave, config.min_px):
        image = part.image(apart.shape)
        thing = int(of_thing[image][0])
        piece = (cv2.dilate(image.astype(np.uint8), disc(config.crease_px)) > 0) & apart
        if np.count_nonzero(piece) < 0.5 * sizes[thing]:
            yield piece


def _across(values: np.ndarray, r: int, axis: int) -> np.ndarray:
    """Return the difference of the values `r` pixels after and before each pixel along an axis.

    The result is shorter than `values` by 2 r along the axis.
    """
    swapped = np.swapaxes(values, 0, axis)
    return np.swapaxes(swapped[2 * r :] - swapped[: -2 * r], 0, axis)


def _colored(
    color: np.ndarray, of_room: np.ndarray, config: GeometricSegmentationConfig, camera: Camera
) -> Iterator[np.ndarray]:
    """Yield the pixels of each structural plane whose color differs from its main color.

    Args:
        color: Color image, [H, W, 3] uint8 RGB.
        of_room: Number of the structural plane of each pixel, [h, w] int32; 0 without one.
        config: Settings.
        camera: Intrinsics of the color image.

    Yields:
        The pixels, [h, w] bool.
    """
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
    """Return the magnitudes [h, w] of the color gradient of a Lab image [h, w, 3]."""
    smooth = cv2.GaussianBlur(lab, (0, 0), 1.0)
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    change = across * across + down * down
    return np.sqrt(change[..., 0] + change[..., 1] + change[..., 2])


def _of_plane(even: np.ndarray, lab: np.ndarray, config: GeometricSegmentationConfig) -> np.ndarray:
    """Return the pixels that have the main color of a plane, [h, w] bool.

    The main color is the median color of the largest component of `even`. The result has all
    components with a similar color, grown by two pixels over the color edges around them.

    Args:
        even: Pixels of the plane that are not on color edges, [h, w] bool.
        lab: Colors, [h, w, 3] float32, Lab.
        config: Settings.
    """
    count, parts = cv2.connectedComponents(even.astype(np.uint8), connectivity=4)
    parts = np.asarray(parts, np.int32)
    sizes = np.bincount(parts.ravel(), minlength=count)
    sizes[0] = 0
    large = np.flatnonzero(sizes >= config.min_px)
    if len(large) == 0:
        return even
    weight = np.array([0.5, 1, 1], np.float32)
    pixels = np.flatnonzero(parts)
    pixels = pixels[np.argsort(parts.ravel()[pixels], kind="stable")]  # Sorted by component.
    ends = np.cumsum(sizes)
    of_pixel = lab.reshape(-1, 3)
    colors = {
        int(k): np.median(of_pixel[pixels[ends[k] - sizes[k] : ends[k]]], axis=0) * weight
        for k in large
    }
    most = colors[int(sizes.argmax())]
    is_same = np.zeros(count, bool)
    is_same[[p for p, c in colors.items() if np.linalg.norm(c - most) < config.color_gap]] = True
    return cv2.dilate(is_same[parts].astype(np.uint8), _3X3, iterations=2) > 0


def _filled(part: Foreground) -> Foreground:
    """Return a mask with its holes filled, and grown by one pixel within its window.

    The growth adds the color edge around the segment, which is a part of the segment.
    """
    outline, _ = cv2.findContours(
        part.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    mask = cv2.drawContours(np.zeros(part.mask.shape, np.uint8), outline, -1, 1, cv2.FILLED)
    return Foreground(part.row, part.column, cv2.dilate(mask, _3X3) > 0)


def _enlarged(part: Foreground, k: int) -> Foreground:
    """Return a mask of the small image, enlarged by the factor k for the full image."""
    mask = np.repeat(np.repeat(part.mask, k, axis=0), k, axis=1)
    return Foreground(k * part.row, k * part.column, mask)
