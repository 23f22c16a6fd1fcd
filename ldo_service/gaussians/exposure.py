"""Brightness of one image beside the map's: gain and bias per channel."""

from dataclasses import dataclass, field

import cv2
import numpy as np

MIN_GAIN = 0.1  # below, nothing of the map's brightness can be told from the image
MIN_BLOCK_PX = 8  # images are compared after averaging: a misplaced edge is no change of
BLOCKS_ACROSS = 40  # brightness; so many blocks in a row say as much as more would
SATURATED = 0.97  # of the range: beyond, the sensor says no more
MIN_SHARE = 0.15  # of the image that must be comparable
MIN_BLOCKS = 16
OUTLIER_SIGMAS = 2.5
MAX_GAIN = 3.0  # and its inverse: a stop and a half
ROUNDS = 6
# What is believed of a camera before its image is seen, standard deviations: it changes its gain,
# and hardly adds anything. Where a wall fills the image the two cannot be told apart; with the bias
# left free the map was painted with a gain of 1.7 there. Half of a flat, held out: 0.4 dB.
GAIN_SIGMA = 0.3
BIAS_SIGMA = 0.02  # of the range
PATCHES = 50  # that the blocks of an image are worth at most: neighbours err alike
FIRST_SIGMA, MIN_SIGMA = 0.05, 0.01  # of a block's colour, at the first round and at the least
MAX_SIGMA = 0.1  # beyond, the images show different things


@dataclass(frozen=True, eq=False, slots=True)
class Exposure:
    """color_seen = gain * color_map + bias, per channel; gain, bias [3] float32."""

    gain: np.ndarray = field(default_factory=lambda: np.ones(3, np.float32))
    bias: np.ndarray = field(default_factory=lambda: np.zeros(3, np.float32))

    @classmethod
    def of(cls, matrix: np.ndarray) -> "Exposure":
        """From gains and biases [2, 3]."""
        return cls(*np.array(matrix, np.float32))

    @property
    def matrix(self) -> np.ndarray:
        """Gains, then biases [2, 3] float32."""
        return np.array([self.gain, self.bias])

    def applied(self, color: np.ndarray) -> np.ndarray:
        """The image [H, W, 3] as this camera would have exposed it, in 0..1."""
        return (self.gain * color + self.bias).clip(0, 1)

    def removed(self, color: np.ndarray) -> np.ndarray:
        """An image [H, W, 3] of this camera at the brightness of the map, in 0..1."""
        return ((color - self.bias) / np.maximum(self.gain, MIN_GAIN)).clip(0, 1)


def fit_exposure(rendered: np.ndarray, seen: np.ndarray) -> Exposure:
    """Least squares fit of gain and bias that take `rendered` to `seen`, both [H, W, 3] in 0..1.

    A channel without contrast gets gain one. For evaluation: it uses the image that is judged.
    """
    x, y = rendered.reshape(-1, 3).astype(float), seen.reshape(-1, 3).astype(float)
    variance = x.var(axis=0)
    covariance = ((x - x.mean(axis=0)) * (y - y.mean(axis=0))).mean(axis=0)
    gain = np.where(variance > 1e-6, covariance / np.maximum(variance, 1e-6), 1.0)
    return Exposure.of(np.stack([gain, y.mean(axis=0) - gain * x.mean(axis=0)]))


def estimate_exposure(
    rendered: np.ndarray, opacity: np.ndarray, seen: np.ndarray, mask: np.ndarray | None = None
) -> Exposure | None:
    """Gain and bias of an image against what the map shows at its pose, where it shows enough.

    rendered [3, H, W] in 0..1, opacity [H, W], seen [3, H, W] uint8, mask [H, W] uint8, 0 where a
    pixel does not count. Least squares over averages of blocks of pixels that are opaque and not
    saturated, without outliers (moved things, new surface), drawn to gain 1 and more so to bias 0.
    None where these are too few, or the gain is none that a camera would choose, or leaves too much
    unexplained: then the images show different things.
    """
    x = np.stack([_averaged(plane) for plane in rendered])
    y = np.stack([_averaged(plane) for plane in seen]) * np.float32(1 / 255)
    usable = (_averaged(opacity) > 0.95) & np.isfinite(x).all(axis=0)
    usable &= _averaged(seen.max(axis=0) >= 255 * SATURATED) == 0
    if mask is not None:
        usable &= _averaged(mask > 0) > 0.99
    if np.count_nonzero(usable) < max(MIN_BLOCKS, MIN_SHARE * usable.size):
        return None
    lines = [_robust_line(x[c, usable], y[c, usable]) for c in range(3)]
    is_plausible = all(
        1 / MAX_GAIN < gain < MAX_GAIN and sigma < MAX_SIGMA for gain, _, sigma in lines
    )
    return Exposure.of(np.array(lines).T[:2]) if is_plausible else None


def _averaged(plane: np.ndarray) -> np.ndarray:
    """Means of square blocks of [H, W]; what is left at two of the edges has none."""
    block = max(MIN_BLOCK_PX, plane.shape[1] // BLOCKS_ACROSS)
    height, width = (n // block for n in plane.shape)
    plane = np.ascontiguousarray(plane[: height * block, : width * block], np.float32)
    return cv2.resize(plane, (width, height), interpolation=cv2.INTER_AREA)


def _robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Slope a and offset b of y over x, both [M], and the deviation sigma of all from that line, by
    the median of the absolute residuals (MAD).

    The a and b of the least  w sum (y - a x - b)^2 / sigma^2 + (a - 1)^2 / GAIN_SIGMA^2
    + b^2 / BIAS_SIGMA^2,  w = min(PATCHES / M, 1), of those that are no outliers.
    """
    gain_weight, bias_weight = GAIN_SIGMA**-2, BIAS_SIGMA**-2
    x, y = x.astype(float), y.astype(float)
    inlier, sigma = np.ones(len(x), bool), FIRST_SIGMA
    gain, bias, residual = 1.0, 0.0, np.abs(y - x)
    for _ in range(ROUNDS):
        among_x, among_y = x[inlier], y[inlier]
        weight = min(PATCHES / len(among_x), 1.0) / sigma**2
        aa, ab = weight * among_x @ among_x + gain_weight, weight * among_x.sum()
        bb, right_b = weight * len(among_x) + bias_weight, weight * among_y.sum()
        right_a = weight * among_x @ among_y + gain_weight
        determinant = aa * bb - ab * ab
        gain = (bb * right_a - ab * right_b) / determinant
        bias = (aa * right_b - ab * right_a) / determinant
        residual = np.abs(y - gain * x - bias)
        sigma = max(1.4826 * float(np.median(residual[inlier])), MIN_SIGMA)
        before, inlier = inlier, residual <= OUTLIER_SIGMAS * sigma
        if np.array_equal(before, inlier):
            break
    return float(gain), float(bias), 1.4826 * float(np.median(residual))
