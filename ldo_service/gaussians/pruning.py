"""Which Gaussians the map is better without."""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError


@dataclass(frozen=True, slots=True)
class PruningConfig:
    min_opacity: float = 0.005  # Kerbl et al. 2023, sec. 5.2
    max_relative_scale: float = 10.0  # longest axis, in means of its neighbourhood (paper, III.A)
    neighbourhood_m: float = 0.25  # edge of the cubes that are neighbourhoods
    # Once so many keyframes came after its own, and now and then later, a Gaussian must show in the
    # image of its own keyframe or of the newest. Otherwise others have grown over it.
    confirm_keyframes: int = 5
    min_weight_px: float = 0.25  # sum of its weights over the image; 0: all are confirmed. Kitchen:
    # 430 k Gaussians without, 165 k with it, held-out views 0.1 dB apart

    def __post_init__(self) -> None:
        if not 0 <= self.min_opacity < 1:
            raise ConfigError(f"min_opacity={self.min_opacity} must be in [0, 1).")
        if self.confirm_keyframes < 1 or not self.min_weight_px >= 0:
            raise ConfigError(f"{self}: confirm_keyframes at least 1, min_weight_px at least 0.")
        if not (self.max_relative_scale > 1 and self.neighbourhood_m > 0):
            raise ConfigError(f"{self}: max_relative_scale above 1, neighbourhood_m positive.")


def superfluous(rows: np.ndarray, config: PruningConfig | None = None) -> np.ndarray:
    """Mask [N] bool of rows [N, 16] that are nearly transparent, far larger than those around
    them, or not finite."""
    config = config or PruningConfig()
    finite = np.isfinite(rows[:, :14]).all(axis=1)
    longest_m = np.exp(rows[:, 3:6].max(axis=1).astype(float))
    transparent = rows[:, 10] < np.log(config.min_opacity / (1 - config.min_opacity))
    mean_m = _mean_around(rows[:, :3], np.where(finite, longest_m, 0), config.neighbourhood_m)
    return transparent | ~finite | (longest_m > config.max_relative_scale * mean_m)


def _mean_around(means: np.ndarray, values: np.ndarray, edge_m: float) -> np.ndarray:
    """Mean [N] of the values of the other Gaussians in the same cube; infinite for a lone one."""
    cube = np.floor(np.nan_to_num(means.astype(float)) / edge_m).astype(np.int64)
    cube -= cube.min(axis=0, initial=0)
    sizes = cube.max(axis=0, initial=0) + 1
    key = (cube[:, 0] * sizes[1] + cube[:, 1]) * sizes[2] + cube[:, 2]
    _, group = np.unique(key, return_inverse=True)
    others = np.bincount(group)[group] - 1
    total = np.bincount(group, values)[group] - values
    return np.where(others > 0, total / np.maximum(others, 1), np.inf)


def weights(rows: np.ndarray) -> np.ndarray:
    """How much of a picture each of the rows [N, 16] makes: opacity times its largest section, m^2,
    the product of the two larger scales."""
    log_scales = rows[:, 3:6]
    return _opacities(rows) * np.exp(log_scales.sum(axis=1) - log_scales.min(axis=1))


def weightiest(rows: np.ndarray, most: int) -> np.ndarray:
    """Mask [N] bool of the `most` rows that make most of the picture, or of all."""
    mask = np.ones(len(rows), bool)
    if len(rows) > most:
        mask[np.argsort(weights(rows), kind="stable")[: len(rows) - most]] = False
    return mask


def _opacities(rows: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-rows[:, 10]))
