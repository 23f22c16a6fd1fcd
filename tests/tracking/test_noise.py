import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.tracking.pyramid import DepthNoise


def test_noise_grows_with_the_square_of_depth() -> None:
    sigma_m = DepthNoise(0.001, 0.002, 0.5).sigma_m(np.array([0.5, 1.5, 2.5]))
    np.testing.assert_allclose(sigma_m, [0.001, 0.003, 0.009])


def test_noise_without_a_floor_is_rejected() -> None:
    with pytest.raises(ConfigError, match="floor_m"):
        DepthNoise(floor_m=0.0)
