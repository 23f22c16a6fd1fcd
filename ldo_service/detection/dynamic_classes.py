"""Dynamic mask: the pixels of detected objects that may move by themselves, such as people.

Conventions: `ldo_service.geometry`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.errors import ConfigError

# Width and height of a box's core, its middle part, as a fraction of the box. The core mostly shows
# the object itself and not the background.
CORE = 0.5


@dataclass(frozen=True, slots=True)
class DynamicClassConfig:
    """Settings of the mask of objects that may move by themselves."""

    # Classes of COCO that move by themselves: living beings and vehicles. Carried objects are
    # omitted, because they move with a person.
    classes: tuple[str, ...] = (
        *("person", "bird", "cat", "dog", "horse", "sheep", "cow", "elephant", "bear", "zebra"),
        *("giraffe", "bicycle", "car", "motorcycle", "bus", "train", "truck", "boat", "airplane"),
    )
    # Maximum difference in depth between a masked pixel and the object, whose depth is the
    # median of the middle part of its box. 0.4 m covers a stride or an outstretched arm.
    reach_m: float = 0.4

    def __post_init__(self) -> None:
        if not self.reach_m > 0:
            raise ConfigError(f"DynamicClassConfig.reach_m={self.reach_m:g} must be positive.")


@dataclass(frozen=True, slots=True)
class Box:
    """Label and box of a detected object.

    The box has the pixels left <= u < right and top <= v < bottom.
    """

    label: str
    left: float
    top: float
    right: float
    bottom: float

    def in_smaller(self, times: float) -> "Box":
        """Return the box in pixels of an image that is `times` smaller in width and height."""
        edges = (self.left, self.top, self.right, self.bottom)
        return Box(self.label, *(edge / times for edge in edges))


def dynamic_class_mask(
    boxes: Sequence[Box], depth_m: np.ndarray, config: DynamicClassConfig
) -> np.ndarray:
    """Return the pixels of objects that may move by themselves, [H, W] bool.

    The core of a box is its middle part, half as wide and high. A pixel of the box is masked if two
    conditions hold: its depth is within `reach_m` of the core's median depth, and pixels with such
    depths connect it to the core. Gaps of a few pixels are masked too. If the core has no known
    depth, the whole box is masked.

    Args:
        boxes: Detections; labels that are not in `classes` are ignored.
        depth_m: Depth, [H, W], meters; 0 where unknown.
        config: Settings.
    """
    out = np.zeros(depth_m.shape, bool)
    for box in boxes:
        if box.label in config.classes:
            window = _window(box, depth_m.shape, 1.0)
            core = np.zeros(depth_m.shape, bool)
            core[_window(box, depth_m.shape, CORE)] = True
            out[window] |= _foreground(depth_m[window], core[window], config)
    return out


def _foreground(depth_m: np.ndarray, core: np.ndarray, config: DynamicClassConfig) -> np.ndarray:
    """Return the pixels of the object in the window of a box, [h, w] bool.

    Args:
        depth_m: Depth in the window, [h, w], meters; 0 where unknown.
        core: Pixels of the core of the box, [h, w] bool.
        config: Settings.
    """
    measured = depth_m[core & (depth_m > 0)]
    if not measured.size:
        return np.ones(depth_m.shape, bool)
    middle_m = float(np.median(measured))
    near = ((depth_m > 0) & (np.abs(depth_m - middle_m) < config.reach_m)).astype(np.uint8)
    closed = cv2.morphologyEx(near, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, pieces = cv2.connectedComponents(closed)
    touching = np.bincount(pieces[core], minlength=count) > 0
    touching[0] = False
    return touching[np.asarray(pieces, np.int32)]


def _window(box: Box, shape: tuple[int, ...], share: float) -> tuple[slice, slice]:
    """Return rows and columns of the middle part of a box, clipped to an image.

    The part has the fraction `share` of the box's width and height.
    """
    u, v = (box.left + box.right) / 2, (box.top + box.bottom) / 2
    half_u, half_v = share * (box.right - box.left) / 2, share * (box.bottom - box.top) / 2
    rows = np.clip([v - half_v, v + half_v], 0, shape[0]).round().astype(int)
    columns = np.clip([u - half_u, u + half_u], 0, shape[1]).round().astype(int)
    return slice(*rows), slice(*columns)
