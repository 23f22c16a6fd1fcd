"""Crops in the format of the image encoder."""

import cv2
import numpy as np

INPUT_PX = 64
MEAN = np.array([0.48145466, 0.4578275, 0.40821073], np.float32)  # Radford et al., ICML 2021
DEVIATION = np.array([0.26862954, 0.26130258, 0.27577711], np.float32)
MARGIN = 0.1  # Margin of a crop around a box, as a fraction of the box's sides.


def crop(image: np.ndarray, box_px: np.ndarray, side_px: int = INPUT_PX) -> np.ndarray:
    """Crop a box out of an image, and scale the crop to fit into a square of CLIP's mean color.

    Args:
        image: Image [H, W, 3] uint8.
        box_px: Box [4], x0, y0, x1, y1, pixels.
        side_px: Side of the square, pixels.

    Returns:
        The square [side_px, side_px, 3] uint8, with the crop in its center.
    """
    return framed(resized(cut(image, box_px), side_px), side_px)


def cut(image: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """Return the part [h, w, ...] of an image [H, W, ...] in a box, at least one pixel."""
    last_px = np.array(image.shape[1::-1]) - 1
    x0, y0 = np.floor(np.clip(box_px[:2], 0, last_px)).astype(int)
    x1, y1 = np.ceil(np.minimum(box_px[2:], image.shape[1::-1])).astype(int)
    return image[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)]


def resized(part: np.ndarray, side_px: int, is_ids: bool = False) -> np.ndarray:
    """Resize an image to a longer side of `side_px` pixels, and keep its aspect ratio.

    If `is_ids` is true, the values are ids, and the function does not interpolate them.
    """
    scale = side_px / max(part.shape[:2])
    width, height = (max(1, round(side * scale)) for side in part.shape[1::-1])
    mixed = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_NEAREST if is_ids else mixed)


def framed(part: np.ndarray, side_px: int) -> np.ndarray:
    """Center an image [h, w, 3] in a square of side `side_px` that has CLIP's mean color."""
    canvas = np.full((side_px, side_px, 3), np.round(MEAN * 255), np.uint8)
    height, width = part.shape[:2]
    left, top = (side_px - width) // 2, (side_px - height) // 2
    canvas[top : top + height, left : left + width] = part
    return canvas


def enlarged(box_px: np.ndarray, margin: float) -> np.ndarray:
    """Return a box [4] grown on each side by the fraction `margin` of its width or height."""
    sides = box_px[2:] - box_px[:2]
    return box_px + np.concatenate((-margin * sides, margin * sides))


def planes(crops: np.ndarray) -> np.ndarray:
    """Return the image encoder's input [N, 3, 64, 64] for crops [N, 64, 64, 3] uint8."""
    values = ((crops / np.float32(255) - MEAN) / DEVIATION).astype(np.float32)
    return np.ascontiguousarray(values.transpose(0, 3, 1, 2))
