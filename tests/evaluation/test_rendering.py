import cv2
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from ldo_service.evaluation import depth_error, psnr, ssim

RNG = np.random.default_rng(0)
A, B = RNG.integers(0, 256, (2, 20, 30, 3), dtype=np.uint8)


def test_psnr_agrees_with_opencv() -> None:
    assert psnr(A, B) == pytest.approx(cv2.PSNR(A, B), abs=1e-9)


def test_floating_images_have_a_peak_of_one() -> None:
    assert psnr(A / 255, B / 255) == pytest.approx(psnr(A, B))


def test_psnr_counts_only_pixels_of_the_mask() -> None:
    mask = np.zeros((20, 30), bool)
    mask[:5] = True
    assert psnr(A, B, mask) == pytest.approx(cv2.PSNR(A[:5].copy(), B[:5].copy()), abs=1e-9)


def test_psnr_is_infinite_for_equal_images_and_nan_without_pixels() -> None:
    assert psnr(A, A) == float("inf")
    assert np.isnan(psnr(A, B, np.zeros((20, 30), bool)))


def test_images_of_different_size_or_type_are_rejected() -> None:
    with pytest.raises(ValueError, match="shapes must be equal"):
        psnr(A, B[:10])
    with pytest.raises(ValueError, match="shapes must be equal"):
        psnr(A, B / 255)


def blurred(image: np.ndarray, sigma_px: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma_px)


@pytest.mark.parametrize("sigma_px", [0.3, 1, 4])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ssim_agrees_with_scikit_image(sigma_px: float, dtype: type) -> None:
    a = blurred(A / 255, 1.0).astype(dtype)
    b = blurred(0.9 * a + 0.05 * B / 255, sigma_px).astype(dtype)
    expected = structural_similarity(
        a.astype(float), b.astype(float), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    assert 0.05 < expected < 0.999
    assert ssim(a, b) == pytest.approx(expected, abs=1e-12)


def test_ssim_of_an_image_with_itself_is_one_and_of_a_negative_is_negative() -> None:
    a = A / 255
    assert ssim(a, a) == pytest.approx(1)
    assert ssim(a, 1 - a) < -0.5


def test_images_without_an_ssim_window_or_of_unequal_size_are_rejected() -> None:
    with pytest.raises(ValueError, match="H and W at least 11"):
        ssim(A[:10] / 255, A[:10] / 255)
    with pytest.raises(ValueError, match="the shapes must be equal"):
        ssim(A / 255, B[:, 1:] / 255)


def test_depth_error_counts_pixels_measured_and_rendered() -> None:
    measured_m = np.array([[1.0, 2, 0, 4]], np.float32)
    rendered_m = np.array([[1.1, 2.3, 9, 9]], np.float32)
    opacity = np.array([[1, 0.6, 1, 0.5]], np.float32)
    error = depth_error(rendered_m, opacity, measured_m)
    assert error.l1_m == pytest.approx(0.2, abs=1e-6)
    assert error.share == pytest.approx(2 / 3)


def test_depth_error_is_nan_without_measured_or_rendered_pixels() -> None:
    one, zero = np.ones((2, 2), np.float32), np.zeros((2, 2), np.float32)
    unmeasured, unrendered = depth_error(one, one, zero), depth_error(one, zero, one)
    assert np.isnan([unmeasured.l1_m, unmeasured.share, unrendered.l1_m]).all()
    assert unrendered.share == 0
