import numpy as np

from ldo_service.gaussians import Exposure, fitted_exposure


def test_exposure_starts_by_changing_nothing() -> None:
    color = np.random.default_rng(0).uniform(0, 1, (4, 5, 3)).astype(np.float32)
    np.testing.assert_array_equal(Exposure().applied(color), color)


def test_matrix_and_exposure_say_the_same() -> None:
    matrix = np.array([[1.5, 1, 0.5], [0.1, 0, -0.1]], np.float32)
    np.testing.assert_array_equal(Exposure.of(matrix).matrix, matrix)
    shown = Exposure.of(matrix).applied(np.full((1, 1, 3), 0.4))
    np.testing.assert_allclose(shown[0, 0], [0.7, 0.4, 0.1], atol=1e-6)


def test_fit_finds_the_exposure_that_was_applied() -> None:
    color = np.random.default_rng(0).uniform(0.2, 0.6, (20, 20, 3))
    truth = Exposure.of(np.array([[1.3, 0.8, 1.0], [-0.1, 0.2, 0.05]]))
    found = fitted_exposure(color, truth.applied(color))
    np.testing.assert_allclose(found.matrix, truth.matrix, atol=1e-5)


def test_fit_of_an_image_without_contrast_changes_the_bias_only() -> None:
    found = fitted_exposure(np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.7))
    np.testing.assert_allclose(found.matrix, [[1, 1, 1], [0.2, 0.2, 0.2]], atol=1e-6)
