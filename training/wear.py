"""Augmentation of frames: errors of a poor camera, and objects in other colors."""

import cv2
import numpy as np

GAIN = (0.72, 1.3)  # Range of the exposure gain; in frames of the flat, it drifts by +-20 %.
TINT = (0.85, 1.18)  # Range of the gain of each channel.
SWAP_SHARE = 0.3  # Fraction of frames with permuted color channels, because paints have any hue.
BLUR_SHARE, BLUR_PX = 0.6, 6.0  # Fraction of blurred frames; maximum blur at a width of 320 pixels.
NOISE = (0.0, 5.0)  # Range of the standard deviation of the noise, gray levels.
# Precomputed noise with a standard deviation of 1.
DRAWN = np.random.default_rng(12).standard_normal(1 << 20, np.float32)
REPAINTED_SHARE = 0.6  # Fraction of objects with another color.
# Standard deviations of the logarithms of the factors on brightness and on each channel; maximum of
# their product.
REPAINT, REPAINT_TINT, REPAINT_MOST = 0.35, 0.25, 2.5


def degrade(image: np.ndarray, rng: np.random.Generator, blur_px: float = BLUR_PX) -> np.ndarray:
    """Return a frame with random exposure, tint, motion blur and noise, [H, W, 3] uint8.

    Args:
        image: Sharp frame [H, W, 3] uint8.
        rng: Source of the errors.
        blur_px: Maximum length of the motion blur.
    """
    values = image.astype(np.float32)
    if rng.random() < SWAP_SHARE:
        values = values[..., rng.permutation(3)]
    values *= (rng.uniform(*GAIN) * rng.uniform(*TINT, 3)).astype(np.float32)
    if rng.random() < BLUR_SHARE:
        values = blurred(values, *(rng.uniform(-blur_px, blur_px, 2) / 1.4))
    noise = _noise(values.shape, rng) * np.float32(rng.uniform(*NOISE))
    return np.clip(values + noise, 0, 255).astype(np.uint8)


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Return noise of this shape with a standard deviation of 1.

    It is a random part of a precomputed array, which takes a tenth of the time of new noise.
    """
    count = int(np.prod(shape))
    start = int(rng.integers(len(DRAWN) - count))
    return DRAWN[start : start + count].reshape(shape)


def recolor(image: np.ndarray, plane: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a frame [H, W, 3] uint8 with random brightness and hue of its objects.

    Args:
        image: The frame.
        plane: Instance ids [H, W]; pixels with id 0 keep their color.
        rng: Source of the colors.
    """
    factors = np.exp(
        REPAINT * rng.standard_normal((256, 1)) + REPAINT_TINT * rng.standard_normal((256, 3))
    )
    factors = np.clip(factors, 1 / REPAINT_MOST, REPAINT_MOST).astype(np.float32)
    factors[rng.random(256) >= REPAINTED_SHARE] = 1
    factors[0] = 1
    return np.minimum(image * factors[plane], 255).astype(np.uint8)


def blurred(values: np.ndarray, du_px: float, dv_px: float) -> np.ndarray:
    """Return an image [H, W, 3] averaged along a line, as in motion blur.

    Args:
        values: The image, float32.
        du_px: Horizontal extent of the line.
        dv_px: Vertical extent of the line.
    """
    radius = int(np.ceil(max(abs(du_px), abs(dv_px)) / 2)) + 1
    cells, shares = np.arange(2 * radius + 1)[:, None], np.linspace(-0.5, 0.5, 9)
    rows, columns = (
        np.maximum(0, 1 - np.abs(radius + shares * moved - cells)) for moved in (dv_px, du_px)
    )
    kernel = (rows @ columns.T).astype(np.float32)
    return cv2.filter2D(values, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
