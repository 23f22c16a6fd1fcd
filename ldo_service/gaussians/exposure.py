"""Brightness of one image beside the map's: gain and bias per channel."""

from dataclasses import dataclass, field

import numpy as np


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
        return np.stack([self.gain, self.bias])

    def applied(self, color: np.ndarray) -> np.ndarray:
        """The image [H, W, 3] as this camera would have exposed it, in 0..1."""
        return (self.gain * color + self.bias).clip(0, 1)


def fitted_exposure(rendered: np.ndarray, seen: np.ndarray) -> Exposure:
    """Least squares fit of gain and bias that take `rendered` to `seen`, both [H, W, 3] in 0..1.

    A channel without contrast gets gain one. For evaluation: it uses the image that is judged.
    """
    x, y = rendered.reshape(-1, 3).astype(float), seen.reshape(-1, 3).astype(float)
    variance = x.var(axis=0)
    covariance = ((x - x.mean(axis=0)) * (y - y.mean(axis=0))).mean(axis=0)
    gain = np.where(variance > 1e-6, covariance / np.maximum(variance, 1e-6), 1.0)
    return Exposure.of(np.stack([gain, y.mean(axis=0) - gain * x.mean(axis=0)]))
