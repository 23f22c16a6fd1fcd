import cv2
import numpy as np
import pytest

from ldo_service.evaluation import psnr

RNG = np.random.default_rng(0)
A, B = RNG.integers(0, 256, (2, 20, 30, 3), dtype=np.uint8)


def test_psnr_agrees_with_opencv() -> None:
    assert psnr(A, B) == pytest.approx(cv2.PSNR(A, B), abs=1e-9)


def test_floating_images_have_a_peak_of_one() -> None:
    assert psnr(A / 255, B / 255) == pytest.approx(psnr(A, B))


def test_only_pixels_of_the_mask_count() -> None:
    mask = np.zeros((20, 30), bool)
    mask[:5] = True
    assert psnr(A, B, mask) == pytest.approx(cv2.PSNR(A[:5].copy(), B[:5].copy()), abs=1e-9)


def test_equal_images_are_infinitely_good_and_none_is_nothing() -> None:
    assert psnr(A, A) == float("inf")
    assert np.isnan(psnr(A, B, np.zeros((20, 30), bool)))


def test_unlike_images_are_refused() -> None:
    with pytest.raises(ValueError, match="differ"):
        psnr(A, B[:10])
    with pytest.raises(ValueError, match="differ"):
        psnr(A, B / 255)
