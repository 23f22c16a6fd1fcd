"""Crops as the image encoder takes them."""

from collections.abc import Callable

import cv2
import numpy as np

INPUT_PX = 64
MEAN = np.array([0.48145466, 0.4578275, 0.40821073], np.float32)  # Radford et al., ICML 2021
DEVIATION = np.array([0.26862954, 0.26130258, 0.27577711], np.float32)
MARGIN = 0.1  # of a box's sides, that a crop has around it


def crop(
    image: np.ndarray, box_px: np.ndarray, changed: Callable[[np.ndarray], np.ndarray] = np.asarray
) -> np.ndarray:
    """A box of an image [H, W, 3], changed, in the middle of a square of CLIP's mean."""
    last_px = np.array(image.shape[1::-1]) - 1
    x0, y0 = np.floor(np.clip(box_px[:2], 0, last_px)).astype(int)
    x1, y1 = np.ceil(np.minimum(box_px[2:], image.shape[1::-1])).astype(int)
    x1, y1 = max(x1, x0 + 1), max(y1, y0 + 1)
    part = image[y0:y1, x0:x1]
    scale = INPUT_PX / max(part.shape[:2])
    size = tuple(max(1, round(side * scale)) for side in part.shape[1::-1])
    inner = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    canvas = np.full((INPUT_PX, INPUT_PX, 3), np.round(MEAN * 255), np.uint8)
    left, top = (INPUT_PX - size[0]) // 2, (INPUT_PX - size[1]) // 2
    canvas[top : top + size[1], left : left + size[0]] = changed(inner)
    return canvas


def enlarged(box_px: np.ndarray, margin: float) -> np.ndarray:
    sides = box_px[2:] - box_px[:2]
    return box_px + np.concatenate((-margin * sides, margin * sides))


def planes(crops: np.ndarray) -> np.ndarray:
    """`pixel_values` [N, 3, 64, 64] of crops [N, 64, 64, 3] uint8."""
    values = ((crops / np.float32(255) - MEAN) / DEVIATION).astype(np.float32)
    return np.ascontiguousarray(values.transpose(0, 3, 1, 2))
