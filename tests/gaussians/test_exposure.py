import numpy as np

from ldo_service.gaussians import Exposure, estimate_exposure, fit_exposure


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
    found = fit_exposure(color, truth.applied(color))
    np.testing.assert_allclose(found.matrix, truth.matrix, atol=1e-5)


def test_fit_of_an_image_without_contrast_changes_the_bias_only() -> None:
    found = fit_exposure(np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.7))
    np.testing.assert_allclose(found.matrix, [[1, 1, 1], [0.2, 0.2, 0.2]], atol=1e-6)


def estimated(
    shown: np.ndarray, opacity: np.ndarray, seen: np.ndarray, mask: np.ndarray | None = None
) -> Exposure | None:
    """Of images [H, W, 3] in 0..1, as a camera tells them."""
    bytes_seen = (255 * seen.clip(0, 1) + 0.5).astype(np.uint8)
    return estimate_exposure(shown.transpose(2, 0, 1), opacity, bytes_seen.transpose(2, 0, 1), mask)


def shown_and_seen(gain: float, bias: float) -> tuple[np.ndarray, np.ndarray]:
    """A smooth map image, and the same through a camera that is a pixel off."""
    rng = np.random.default_rng(3)
    coarse = rng.uniform(0.1, 0.7, (8, 10, 3)).astype(np.float32)
    shown = coarse.repeat(16, axis=0).repeat(16, axis=1)
    seen = np.roll(shown, 1, axis=1) * np.float32(gain) + np.float32(bias)
    return shown, seen.astype(np.float32)


def test_exposure_of_a_new_image_is_found_beside_outliers_and_new_surface() -> None:
    shown, seen = shown_and_seen(0.8, 0.05)
    opacity = np.ones(shown.shape[:2], np.float32)
    seen[:40, :40] = 0.9  # somebody walked in
    opacity[:, 120:] = 0.3  # not mapped yet
    found = estimated(shown, opacity, seen)
    assert found is not None
    np.testing.assert_allclose(found.gain, 0.8, atol=0.02)
    np.testing.assert_allclose(found.bias, 0.05, atol=0.01)


def test_pixels_that_do_not_count_say_nothing() -> None:
    shown, seen = shown_and_seen(0.8, 0.0)
    mask = np.ones(shown.shape[:2], np.uint8)
    mask[:64], seen[:64] = 0, 0.5 * seen[:64]
    found = estimated(shown, np.ones(shown.shape[:2], np.float32), seen, mask)
    assert found is not None
    np.testing.assert_allclose(found.gain, 0.8, atol=0.03)


def test_saturated_pixels_say_nothing() -> None:
    shown, seen = shown_and_seen(1.9, 0.0)
    found = estimated(shown, np.ones(shown.shape[:2], np.float32), seen)
    assert found is not None
    np.testing.assert_allclose(found.gain, 1.9, atol=0.15)


def test_without_a_map_behind_it_no_exposure_is_estimated() -> None:
    shown, seen = shown_and_seen(0.8, 0.0)
    opacity = np.zeros(shown.shape[:2], np.float32)
    opacity[:16, :16] = 1
    assert estimated(shown, opacity, seen) is None


def test_one_color_alone_says_how_the_gain_changed() -> None:
    """Gain and bias cannot be told apart there, and cameras change their gain."""
    flat = np.full((160, 160, 3), 0.5, np.float32)
    found = estimated(flat, np.ones((160, 160), np.float32), flat * np.float32(0.8))
    assert found is not None
    np.testing.assert_allclose(found.gain, 0.8, atol=0.01)
    np.testing.assert_allclose(found.applied(flat), 0.4, atol=1e-3)


def test_a_wall_that_the_map_shows_badly_changes_no_contrast() -> None:
    """Errors of the map in what has little contrast are no gain of 0.5 and a bias of 0.3."""
    rng = np.random.default_rng(5)
    patches = rng.normal(0.7, 0.02, (20, 20, 3)).astype(np.float32)
    shown = (patches + rng.normal(0, 0.02, patches.shape)).repeat(8, axis=0).repeat(8, axis=1)
    seen = 0.9 * patches.repeat(8, axis=0).repeat(8, axis=1)
    found = estimated(shown, np.ones(shown.shape[:2], np.float32), seen)
    assert found is not None
    np.testing.assert_allclose(found.gain, 0.9, atol=0.06)
    np.testing.assert_allclose(found.bias, 0.0, atol=0.04)


def test_a_pixel_that_is_not_finite_says_nothing() -> None:
    shown, seen = shown_and_seen(0.8, 0.0)
    shown[5, 7, 1] = np.nan
    found = estimated(shown, np.ones(shown.shape[:2], np.float32), seen)
    assert found is not None
    np.testing.assert_allclose(found.gain, 0.8, atol=0.03)


def test_removed_undoes_applied() -> None:
    exposure = Exposure.of(np.array([[0.8, 1.1, 0.9], [0.05, -0.02, 0.0]]))
    color = np.random.default_rng(0).uniform(0.1, 0.8, (4, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(exposure.removed(exposure.applied(color)), color, atol=1e-6)


def test_images_of_different_things_have_no_exposure() -> None:
    shown, _ = shown_and_seen(1.0, 0.0)
    other = 0.8 - shown
    assert estimated(shown, np.ones(shown.shape[:2], np.float32), other) is None
