import numpy as np

from ldo_service.gaussians import Exposure, estimate_exposure, fit_exposure


def test_default_exposure_is_identity() -> None:
    color = np.random.default_rng(0).uniform(0, 1, (4, 5, 3)).astype(np.float32)
    np.testing.assert_array_equal(Exposure().applied(color), color)


def test_exposure_matches_its_matrix() -> None:
    matrix = np.array([[1.5, 1, 0.5], [0.1, 0, -0.1]], np.float32)
    np.testing.assert_array_equal(Exposure.of(matrix).matrix, matrix)
    rendered = Exposure.of(matrix).applied(np.full((1, 1, 3), 0.4))
    np.testing.assert_allclose(rendered[0, 0], [0.7, 0.4, 0.1], atol=1e-6)


def test_exposure_is_applied_to_each_channel_bit_for_bit() -> None:
    exposure = Exposure.of(np.array([[1.3, 0.8, 0.05], [-0.1, 0.2, 0.05]]))
    color = np.random.default_rng(1).uniform(-0.1, 1.1, (7, 5, 3)).astype(np.float32)
    expected = (exposure.gain * color + exposure.bias).clip(0, 1)
    np.testing.assert_array_equal(exposure.applied(color), expected)


def test_exposure_is_removed_from_an_image_bit_for_bit() -> None:
    exposure = Exposure.of(np.array([[1.3, 0.8, 0.05], [-0.1, 0.2, 0.05]]))
    image = np.random.default_rng(1).integers(0, 256, (40, 50, 3)).astype(np.uint8)
    color = exposure.removed(image * np.float32(1 / 255))
    expected = (255 * color + 0.5).astype(np.uint8)
    np.testing.assert_array_equal(exposure.removed_from_image(image), expected)


def test_fit_recovers_the_applied_exposure() -> None:
    color = np.random.default_rng(0).uniform(0.2, 0.6, (20, 20, 3))
    true_exposure = Exposure.of(np.array([[1.3, 0.8, 1.0], [-0.1, 0.2, 0.05]]))
    exposure = fit_exposure(color, true_exposure.applied(color))
    np.testing.assert_allclose(exposure.matrix, true_exposure.matrix, atol=1e-5)


def test_fit_without_contrast_changes_only_the_bias() -> None:
    exposure = fit_exposure(np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.7))
    np.testing.assert_allclose(exposure.matrix, [[1, 1, 1], [0.2, 0.2, 0.2]], atol=1e-6)


def estimate(
    rendered: np.ndarray, opacity: np.ndarray, observed: np.ndarray, mask: np.ndarray | None = None
) -> Exposure | None:
    """Estimate the exposure from images [H, W, 3] in 0..1, quantized as by a camera."""
    quantized = (255 * observed.clip(0, 1) + 0.5).astype(np.uint8)
    return estimate_exposure(
        rendered.transpose(2, 0, 1), opacity, quantized.transpose(2, 0, 1), mask
    )


def rendered_and_observed(gain: float, bias: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a smooth rendering and its image through a camera that is displaced by one pixel."""
    rng = np.random.default_rng(3)
    coarse = rng.uniform(0.1, 0.7, (8, 10, 3)).astype(np.float32)
    rendered = coarse.repeat(16, axis=0).repeat(16, axis=1)
    observed = np.roll(rendered, 1, axis=1) * np.float32(gain) + np.float32(bias)
    return rendered, observed.astype(np.float32)


def test_estimate_is_robust_to_outliers_and_unmapped_surface() -> None:
    rendered, observed = rendered_and_observed(0.8, 0.05)
    opacity = np.ones(rendered.shape[:2], np.float32)
    observed[:40, :40] = 0.9  # An object that is not in the map.
    opacity[:, 120:] = 0.3  # Surface that is not mapped yet.
    exposure = estimate(rendered, opacity, observed)
    assert exposure is not None
    np.testing.assert_allclose(exposure.gain, 0.8, atol=0.02)
    np.testing.assert_allclose(exposure.bias, 0.05, atol=0.01)


def test_masked_pixels_are_ignored() -> None:
    rendered, observed = rendered_and_observed(0.8, 0.0)
    mask = np.ones(rendered.shape[:2], np.uint8)
    mask[:64], observed[:64] = 0, 0.5 * observed[:64]
    exposure = estimate(rendered, np.ones(rendered.shape[:2], np.float32), observed, mask)
    assert exposure is not None
    np.testing.assert_allclose(exposure.gain, 0.8, atol=0.03)


def test_saturated_pixels_are_ignored() -> None:
    rendered, observed = rendered_and_observed(1.9, 0.0)
    exposure = estimate(rendered, np.ones(rendered.shape[:2], np.float32), observed)
    assert exposure is not None
    np.testing.assert_allclose(exposure.gain, 1.9, atol=0.15)


def test_too_little_opacity_gives_no_exposure() -> None:
    rendered, observed = rendered_and_observed(0.8, 0.0)
    opacity = np.zeros(rendered.shape[:2], np.float32)
    opacity[:16, :16] = 1
    assert estimate(rendered, opacity, observed) is None


def test_uniform_image_changes_only_the_gain() -> None:
    """Gain and bias are ambiguous there; cameras usually change their gain."""
    uniform = np.full((160, 160, 3), 0.5, np.float32)
    exposure = estimate(uniform, np.ones((160, 160), np.float32), uniform * np.float32(0.8))
    assert exposure is not None
    np.testing.assert_allclose(exposure.gain, 0.8, atol=0.01)
    np.testing.assert_allclose(exposure.applied(uniform), 0.4, atol=1e-3)


def test_map_errors_at_low_contrast_keep_gain_and_bias() -> None:
    """Map errors on a wall of low contrast do not give a gain of 0.5 and a bias of 0.3."""
    rng = np.random.default_rng(5)
    patches = rng.normal(0.7, 0.02, (20, 20, 3)).astype(np.float32)
    rendered = (patches + rng.normal(0, 0.02, patches.shape)).repeat(8, axis=0).repeat(8, axis=1)
    observed = 0.9 * patches.repeat(8, axis=0).repeat(8, axis=1)
    exposure = estimate(rendered, np.ones(rendered.shape[:2], np.float32), observed)
    assert exposure is not None
    np.testing.assert_allclose(exposure.gain, 0.9, atol=0.06)
    np.testing.assert_allclose(exposure.bias, 0.0, atol=0.04)


def test_non_finite_pixels_are_ignored() -> None:
    rendered, observed = rendered_and_observed(0.8, 0.0)
    rendered[5, 7, 1] = np.nan
    exposure = estimate(rendered, np.ones(rendered.shape[:2], np.float32), observed)
    assert exposure is not None
    np.testing.assert_allclose(exposure.gain, 0.8, atol=0.03)


def test_removed_inverts_applied() -> None:
    exposure = Exposure.of(np.array([[0.8, 1.1, 0.9], [0.05, -0.02, 0.0]]))
    color = np.random.default_rng(0).uniform(0.1, 0.8, (4, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(exposure.removed(exposure.applied(color)), color, atol=1e-6)


def test_unrelated_images_give_no_exposure() -> None:
    rendered, _ = rendered_and_observed(1.0, 0.0)
    other = 0.8 - rendered
    assert estimate(rendered, np.ones(rendered.shape[:2], np.float32), other) is None
