"""Errors of rendered images."""

from dataclasses import dataclass

import cv2
import numpy as np

WINDOW_PX, SIGMA_PX = 11, 1.5  # Wang et al. 2004, section III.B
C1, C2 = 0.01**2, 0.03**2  # the same, for images in 0..1
COVERED = 0.5  # rendered opacity above which there is a surface to compare


@dataclass(frozen=True, slots=True)
class DepthError:
    l1_m: float  # NaN where no pixel counts
    share: float  # of the pixels with measured depth, those that count; NaN where none is measured


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB: 10 log10(peak^2 / mean (a - b)^2).

    a, b    [H, W, C] or [H, W]; both uint8 (peak 255) or both floating in 0..1 (peak 1)
    mask    [H, W] bool, the pixels that count; all by default
    Equal images give infinity, an empty mask gives NaN. Raises ValueError for unlike images.
    """
    if a.shape != b.shape or (a.dtype == np.uint8) != (b.dtype == np.uint8):
        raise ValueError(f"images differ in kind: {a.dtype}{a.shape} and {b.dtype}{b.shape}")
    peak = 255.0 if a.dtype == np.uint8 else 1.0
    squares = (a.astype(np.float64) - b) ** 2
    squares = squares if mask is None else squares[mask]
    if squares.size == 0:
        return float("nan")
    mse = float(squares.mean())
    return float("inf") if mse == 0 else float(10 * np.log10(peak**2 / mse))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Mean structural similarity of images [H, W, 3], floating in 0..1.

        (2 m_a m_b + c1) (2 s_ab + c2) / ((m_a^2 + m_b^2 + c1) (s_a^2 + s_b^2 + c2))

    per channel under an 11x11 Gaussian window of sigma 1.5 px, over the pixels whose window lies
    in the image. One scale: MS-SSIM, which some print under this name, is often higher. Raises
    ValueError for unlike images and for a side below 11 pixels. Wang et al., TIP 2004.
    """
    if a.shape != b.shape or a.ndim != 3 or min(a.shape[:2]) < WINDOW_PX:
        raise ValueError(f"SSIM of images {a.shape} and {b.shape}: they must be alike, from 11x11.")
    a, b = a.astype(np.float64), b.astype(np.float64)
    mean_a, mean_b = _windowed(a), _windowed(b)
    variances = _windowed(a * a) - mean_a**2 + _windowed(b * b) - mean_b**2
    covariance = _windowed(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return float(np.mean(luminance * (2 * covariance + C2) / (variances + C2)))


def depth_error(rendered_m: np.ndarray, opacity: np.ndarray, measured_m: np.ndarray) -> DepthError:
    """Mean |rendered - measured| over pixels with measured depth and opacity above one half.

    rendered_m, measured_m  [H, W] metres, measured 0 where it was not
    opacity                 [H, W] 0..1
    """
    measured = measured_m > 0
    counted = measured & (opacity > COVERED)
    if not counted.any():
        return DepthError(float("nan"), 0.0 if measured.any() else float("nan"))
    errors_m = np.abs(rendered_m[counted].astype(np.float64) - measured_m[counted])
    return DepthError(float(errors_m.mean()), float(counted.sum() / measured.sum()))


def _windowed(image: np.ndarray) -> np.ndarray:
    """Gaussian means [H - 10, W - 10, C]."""
    kernel = cv2.getGaussianKernel(WINDOW_PX, SIGMA_PX)
    margin = WINDOW_PX // 2
    return cv2.sepFilter2D(image, -1, kernel, kernel)[margin:-margin, margin:-margin]
