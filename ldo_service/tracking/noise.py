"""How exact a depth measurement is. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Axial noise sigma(z) = floor + growth (z - nearest)^2 of a depth camera.

    The defaults are the Kinect's (Nguyen, Izadi and Lovell 2012, equation 5). Only the shape of
    the curve matters much: alignment estimates a factor on it from every frame's residuals.
    """

    floor_m: float = 0.0012
    growth_per_m: float = 0.0019
    nearest_m: float = 0.4

    def __post_init__(self) -> None:
        if not (self.floor_m > 0 and self.growth_per_m >= 0):
            raise ConfigError(
                f"depth noise floor_m={self.floor_m:g} must be positive and "
                f"growth_per_m={self.growth_per_m:g} must not be negative."
            )

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """(floor_m, growth_per_m, nearest_m)."""
        return self.floor_m, self.growth_per_m, self.nearest_m

    def sigma_m(self, depth_m: np.ndarray) -> np.ndarray:
        """Standard deviation [...] of depth [...]."""
        return self.floor_m + self.growth_per_m * (depth_m - self.nearest_m) ** 2
