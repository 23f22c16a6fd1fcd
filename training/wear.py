"""Frames as a worse camera takes them, and of things painted otherwise."""

import cv2
import numpy as np

GAIN = (0.72, 1.3)  # of exposure; the flat's drifts by +-20 %
TINT = (0.85, 1.18)  # of each channel
SWAP_SHARE = 0.3  # of frames whose channels are permuted: paints have any hue
BLUR_SHARE, BLUR_PX = 0.6, 6.0  # of frames, and at most in a frame of 320 pixels
NOISE = (0.0, 5.0)  # grey levels
DRAWN = np.random.default_rng(12).standard_normal(1 << 20, np.float32)
REPAINTED_SHARE = 0.6  # of objects
REPAINT, REPAINT_TINT, REPAINT_MOST = 0.35, 0.25, 2.5  # deviations of logarithms; largest factor


def degrade(image: np.ndarray, rng: np.random.Generator, blur_px: float = BLUR_PX) -> np.ndarray:
    """A frame [H, W, 3] uint8 of another exposure and tint, blurred by motion, with noise."""
    values = image.astype(np.float32)
    if rng.random() < SWAP_SHARE:
        values = values[..., rng.permutation(3)]
    values *= (rng.uniform(*GAIN) * rng.uniform(*TINT, 3)).astype(np.float32)
    if rng.random() < BLUR_SHARE:
        values = blurred(values, *(rng.uniform(-blur_px, blur_px, 2) / 1.4))
    noise = _noise(values.shape, rng) * np.float32(rng.uniform(*NOISE))
    return np.clip(values + noise, 0, 255).astype(np.uint8)


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Of deviation 1, a stretch of what was drawn once: that takes a tenth of the time."""
    count = int(np.prod(shape))
    start = int(rng.integers(len(DRAWN) - count))
    return DRAWN[start : start + count].reshape(shape)


def recolor(image: np.ndarray, plane: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A frame [H, W, 3] uint8 whose objects, ids in `plane`, have other brightness and hue."""
    factors = np.exp(
        REPAINT * rng.standard_normal((256, 1)) + REPAINT_TINT * rng.standard_normal((256, 3))
    )
    factors = np.clip(factors, 1 / REPAINT_MOST, REPAINT_MOST).astype(np.float32)
    factors[rng.random(256) >= REPAINTED_SHARE] = 1
    factors[0] = 1
    return np.minimum(image * factors[plane], 255).astype(np.uint8)


def blurred(values: np.ndarray, du_px: float, dv_px: float) -> np.ndarray:
    """The mean along a segment, by a kernel of its own."""
    radius = int(np.ceil(max(abs(du_px), abs(dv_px)) / 2)) + 1
    cells, shares = np.arange(2 * radius + 1)[:, None], np.linspace(-0.5, 0.5, 9)
    rows, columns = (
        np.maximum(0, 1 - np.abs(radius + shares * moved - cells)) for moved in (dv_px, du_px)
    )
    kernel = (rows @ columns.T).astype(np.float32)
    return cv2.filter2D(values, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
