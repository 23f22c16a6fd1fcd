import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.gaussians import GaussianMap, PruningConfig, prunable_mask


def cloud(n: int = 50, *, sigma_m: float = 0.01) -> GaussianMap:
    rows = np.zeros((n, 16), np.float32)
    rows[:, :3] = np.random.default_rng(0).uniform(-0.1, 0.1, (n, 3)) - 3.125
    rows[:, 3:6], rows[:, 6] = np.log(sigma_m), 1
    rows[:, 10] = 2
    gaussians = GaussianMap()
    gaussians.add(rows, 0)
    return gaussians


def test_ordinary_map_is_not_pruned() -> None:
    assert not prunable_mask(cloud().rows).any()
    assert prunable_mask(GaussianMap().rows).shape == (0,)


def test_transparent_and_non_finite_gaussians_are_pruned() -> None:
    gaussians = cloud()
    gaussians.opacity_logits[3] = -6
    gaussians.means[7, 1] = np.nan
    np.testing.assert_array_equal(np.flatnonzero(prunable_mask(gaussians.rows)), [3, 7])


def test_gaussian_much_larger_than_its_neighbors_is_pruned() -> None:
    gaussians = cloud()
    gaussians.log_scales[5, 2] = np.log(0.2)
    gaussians.log_scales[6, 2] = np.log(0.05)
    np.testing.assert_array_equal(np.flatnonzero(prunable_mask(gaussians.rows)), [5])


def test_isolated_gaussian_is_not_pruned() -> None:
    gaussians = cloud()
    far = gaussians.rows[:1].copy()
    far[0, :3], far[0, 3:6] = 50, np.log(3)
    gaussians.add(far, 1)
    assert not prunable_mask(gaussians.rows).any()


@pytest.mark.parametrize(
    "change", [{"min_opacity": 1.0}, {"max_relative_scale": 0.5}, {"neighborhood_m": 0.0}]
)
def test_invalid_settings_raise_config_error(change: dict) -> None:
    with pytest.raises(ConfigError):
        PruningConfig(**change)
