"""Errors of rendered views."""

import numpy as np


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
