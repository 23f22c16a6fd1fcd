"""Exposure of an image relative to the map: gain and bias per channel."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil

import cv2
import numpy as np

# Minimum gain that colors are divided by when an exposure is removed from an image. An image with a
# smaller gain does not determine the brightness of the map.
MIN_GAIN = 0.1
# Images are compared as averages over blocks, so that a misplaced edge does not count as a
# change of brightness.
MIN_BLOCK_PX = 8
BLOCKS_ACROSS = 40  # Blocks across the width of an image; more blocks add no information.
SATURATED = 0.97  # Color in 0..1 above which a pixel counts as saturated.
_SATURATED_VALUE = np.uint8(ceil(255 * SATURATED))  # Smallest such value of a camera image.
MIN_SHARE = 0.15  # Minimum fraction of blocks that must be comparable.
MIN_BLOCKS = 16  # Minimum number of comparable blocks.
OUTLIER_SIGMAS = 2.5
MAX_GAIN = 3.0  # Largest plausible gain, a stop and a half; the smallest is its inverse.
ROUNDS = 6  # Maximum number of iterations of outlier rejection.
# Standard deviations of the prior: the gain of a camera changes, and its bias is nearly zero. If a
# wall fills the image, gain and bias are ambiguous. With a free bias, such an image gave a gain of
# 1.7 and wrong colors in the map. The prior gains 0.4 dB on held-out frames of a run through half
# an apartment.
GAIN_SIGMA = 0.3
BIAS_SIGMA = 0.02  # Colors are in 0..1.
# Maximum number of independent measurements that the blocks of an image count as. It is below the
# number of blocks, because errors of neighboring blocks are correlated.
PATCHES = 50
# Standard deviation of a block's color from the fitted line, for colors in 0..1: the value in the
# first iteration, and the minimum.
FIRST_SIGMA, MIN_SIGMA = 0.05, 0.01
MAX_SIGMA = 0.1  # Maximum standard deviation; above it, the images show different surfaces.


@dataclass(frozen=True, eq=False, slots=True)
class Exposure:
    """Gain and bias per color channel: color_seen = gain * color_map + bias.

    Attributes:
        gain: [3] float32.
        bias: [3] float32, for colors in 0..1.
    """

    gain: np.ndarray = field(default_factory=lambda: np.ones(3, np.float32))
    bias: np.ndarray = field(default_factory=lambda: np.zeros(3, np.float32))

    @classmethod
    def of(cls, matrix: np.ndarray) -> "Exposure":
        """Return the exposure of a matrix [2, 3]: row 0 holds the gains, row 1 the biases."""
        return cls(*np.array(matrix, np.float32))

    @property
    def matrix(self) -> np.ndarray:
        """Matrix [2, 3] float32: row 0 holds the gains, row 1 the biases."""
        return np.array([self.gain, self.bias])

    def applied(self, color: np.ndarray) -> np.ndarray:
        """Convert map colors [H, W, 3] in 0..1 to seen colors, clipped to 0..1."""
        width = color.shape[1]
        # Operations on whole rows are several times as fast as operations on three channels.
        seen = np.tile(self.gain, width) * color.reshape(-1, 3 * width)
        seen += np.tile(self.bias, width)
        return seen.clip(0, 1, out=seen).reshape(color.shape)

    def removed(self, color: np.ndarray) -> np.ndarray:
        """Convert seen colors [H, W, 3] in 0..1 to map colors, clipped to 0..1."""
        return ((color - self.bias) / np.maximum(self.gain, MIN_GAIN)).clip(0, 1)

    def removed_from_image(self, color: np.ndarray) -> np.ndarray:
        """Convert an image [H, W, 3] uint8 of the camera to map colors, rounded to uint8.

        A channel has only 256 values. `removed` therefore converts a table of these values.
        """
        values = np.arange(256, dtype=np.uint8)[None, :, None] * np.float32(1 / 255)
        table = (255 * self.removed(values) + 0.5).astype(np.uint8)
        return np.asarray(cv2.LUT(color, table))


def fit_exposure(
    rendered: np.ndarray, seen: np.ndarray, mask: np.ndarray | None = None
) -> Exposure:
    """Fit gain and bias by least squares, such that `seen` = gain * `rendered` + bias.

    Use this function for evaluation only: it uses the image that the rendering is compared with.
    A channel without contrast gets a gain of one.

    Args:
        rendered: Rendered colors, [H, W, 3], 0..1.
        seen: Colors of the camera image, [H, W, 3], 0..1.
        mask: Pixels to use, [H, W] bool; None for all.
    """
    used = np.ones(rendered.shape[:2], bool) if mask is None else mask
    x, y = rendered[used].astype(float), seen[used].astype(float)
    variance = x.var(axis=0)
    covariance = ((x - x.mean(axis=0)) * (y - y.mean(axis=0))).mean(axis=0)
    gain = np.where(variance > 1e-6, covariance / np.maximum(variance, 1e-6), 1.0)
    return Exposure.of(np.stack([gain, y.mean(axis=0) - gain * x.mean(axis=0)]))


def estimate_exposure(
    rendered: np.ndarray, opacity: np.ndarray, seen: np.ndarray, mask: np.ndarray | None = None
) -> Exposure | None:
    """Estimate gain and bias of a camera image relative to a rendering at the same pose.

    The estimate is a least-squares fit over mean colors of pixel blocks. Only opaque, unsaturated
    pixels are used. Outliers, such as moved objects and new surface, are excluded. A prior pulls
    the gain towards 1 and, more strongly, the bias towards 0.

    Args:
        rendered: Rendered color, [3, H, W], 0..1.
        opacity: Rendered opacity, [H, W], 0..1.
        seen: Image of the camera, [3, H, W] uint8.
        mask: [H, W] uint8; pixels with value 0 are ignored. None uses all pixels.

    Returns:
        The exposure. None if the two images probably show different surfaces: too few blocks are
        comparable, the gain is implausible, or the residual is too large.
    """
    return estimate_block_exposure(rendered, opacity, ImageBlocks.of(seen, mask))


def estimate_block_exposure(
    rendered: Sequence[np.ndarray] | np.ndarray, opacity: np.ndarray, seen: "ImageBlocks"
) -> Exposure | None:
    """Estimate an exposure like `estimate_exposure`, from known blocks of the camera image.

    Args:
        rendered: Rendered color, three planes [H, W], 0..1.
        opacity: Rendered opacity, [H, W], 0..1.
        seen: Blocks of the camera image, which has H x W pixels too.

    Returns:
        The exposure; None if the two images probably show different surfaces.
    """
    return fit_blocks(np.stack([*map(_averaged, rendered)]), _averaged(opacity), seen)


@dataclass(frozen=True, eq=False, slots=True)
class ImageBlocks:
    """Mean colors of the blocks of a camera image: B rows of C square blocks of pixels.

    Attributes:
        color: [3, B, C] float32, 0..1.
        usable: Blocks without saturated or ignored pixels, [B, C] bool.
    """

    color: np.ndarray
    usable: np.ndarray

    @classmethod
    def of(cls, seen: np.ndarray, mask: np.ndarray | None = None) -> "ImageBlocks":
        """Average a camera image over blocks; `estimate_exposure` describes the arguments."""
        color = np.stack([_averaged(plane) for plane in seen]) * np.float32(1 / 255)
        usable = _averaged(seen.max(axis=0) >= _SATURATED_VALUE) == 0
        if mask is not None:
            usable &= _averaged(mask > 0) > 0.99
        return cls(color, usable)


def fit_blocks(rendered: np.ndarray, opacity: np.ndarray, seen: ImageBlocks) -> Exposure | None:
    """Estimate an exposure from mean colors of pixel blocks; see `estimate_exposure`.

    Args:
        rendered: Mean rendered colors of B rows of C blocks, [3, B, C], 0..1.
        opacity: Mean rendered opacities, [B, C], 0..1.
        seen: The same blocks of the camera image.

    Returns:
        The exposure; None if the two images probably show different surfaces.
    """
    x, y = rendered, seen.color
    usable = seen.usable & (opacity > 0.95) & np.isfinite(x).all(axis=0)
    if np.count_nonzero(usable) < max(MIN_BLOCKS, MIN_SHARE * usable.size):
        return None
    lines = [_robust_line(x[c, usable], y[c, usable]) for c in range(3)]
    is_plausible = all(
        1 / MAX_GAIN < gain < MAX_GAIN and sigma < MAX_SIGMA for gain, _, sigma in lines
    )
    return Exposure.of(np.array(lines).T[:2]) if is_plausible else None


def block_side(width: int) -> int:
    """Return the side, in pixels, of the square blocks of an image that is `width` pixels wide."""
    return max(MIN_BLOCK_PX, width // BLOCKS_ACROSS)


def _averaged(plane: np.ndarray) -> np.ndarray:
    """Return the mean of each square block of an image [H, W]; incomplete blocks are omitted."""
    block = block_side(plane.shape[1])
    height, width = (n // block for n in plane.shape)
    plane = np.ascontiguousarray(plane[: height * block, : width * block], np.float32)
    return cv2.resize(plane, (width, height), interpolation=cv2.INTER_AREA)


def _robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Fit a line to y over x with outlier rejection.

    The fit minimizes w sum (y - a x - b)^2 / sigma^2 + (a - 1)^2 / GAIN_SIGMA^2
    + b^2 / BIAS_SIGMA^2 over the inliers, with w = min(PATCHES / M, 1).

    Args:
        x: Rendered colors of the blocks in one channel, [M], 0..1.
        y: Colors of the same blocks in the camera image, [M], 0..1.

    Returns:
        Slope a and offset b of the line. Then the standard deviation of all M points from the line,
        estimated from the median absolute deviation (MAD).
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
        sigma = max(1.4826 * _median(residual[inlier]), MIN_SIGMA)
        before, inlier = inlier, residual <= OUTLIER_SIGMAS * sigma
        if np.array_equal(before, inlier):
            break
    return float(gain), float(bias), 1.4826 * _median(residual)


def _median(values: np.ndarray) -> float:
    """Return the median of finite values [M], and change their order.

    The result equals that of `np.median`, which takes several times as long for these few values.
    """
    middle = len(values) // 2
    if len(values) % 2:
        values.partition(middle)
        return float(values[middle])
    values.partition((middle - 1, middle))
    return float((values[middle - 1] + values[middle]) / 2)
