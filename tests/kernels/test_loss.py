"""Tests of the loss kernel against the reference and its derivative."""

from collections.abc import Callable

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad

from ldo_service.gaussians import Exposure, LossWeights, image_loss
from ldo_service.kernels import _loss
from tests.reference.loss import loss_reference, ssim

WEIGHTS = (0.8, 0.2, 0.7)
# Some are smaller than a window, one is taller than a band.
SIZES = ((23, 37), (48, 64), (5, 3), (250, 17), (1, 1))
COMPARE_ALL = """
from ldo_service.kernels import _loss
for name in {key.split("/")[0] for key in given}:
    parts = [given[f"{name}/{part}"] for part in ("planes", "color", "depth_m", "mask", "exposure")]
    by_planes = np.full_like(parts[0], np.nan)
    terms = _loss.image_loss(*parts, 0.8, 0.2, 0.7, by_planes, 2)
    result |= {f"{name}/terms": terms, f"{name}/by_planes": by_planes}
"""


def scene(height: int, width: int) -> dict[str, np.ndarray]:
    """Return random arguments of the loss."""
    rng = np.random.default_rng(height)
    depth_m = rng.uniform(0, 1, (height, width)).astype(np.float32)
    return {
        "planes": rng.uniform(0, 1, (5, height, width)).astype(np.float32),
        "color": rng.integers(0, 256, (3, height, width), np.uint8),
        "depth_m": np.where(depth_m < 0.3, 0, depth_m),
        "mask": (rng.uniform(size=(height, width)) < 0.8).astype(np.uint8),
        "exposure": np.array([[1.1, 0.9, 1], [0.05, -0.1, 0]], np.float32),
    }


def reference_loss(planes: np.ndarray, exposure: np.ndarray, given: dict) -> float:
    """Compute the loss by the reference, in a form that `autograd` can differentiate."""
    color, mask = given["color"] / 255, given["mask"].astype(float)
    return loss_reference(planes, exposure, color, given["depth_m"], mask, WEIGHTS, anp)


@pytest.fixture(scope="module")
def by_kernel(with_isa: Callable) -> dict[str, np.ndarray]:
    """Return the terms of the loss and their derivatives, computed by the kernel."""
    given = {f"{h}x{w}/{k}": v for h, w in SIZES for k, v in scene(h, w).items()}
    return with_isa(COMPARE_ALL, given)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_kernel_agrees_with_the_reference_and_its_derivative(
    height: int, width: int, by_kernel: dict
) -> None:
    given, name = scene(height, width), f"{height}x{width}"
    planes, exposure = given["planes"].astype(float), given["exposure"].astype(float)
    total = np.dot(WEIGHTS, by_kernel[f"{name}/terms"][:3])
    np.testing.assert_allclose(total, reference_loss(planes, exposure, given), atol=2e-7)
    wanted = grad(reference_loss)(planes, exposure, given)
    error = np.linalg.norm(by_kernel[f"{name}/by_planes"].ravel() - wanted.ravel())
    assert error <= 2e-6 * np.linalg.norm(wanted)


def loss_of(given: dict, **changes: object) -> tuple[float, np.ndarray]:
    """Return the total loss of a scene, with some arguments changed, and its derivatives."""
    given = given | changes
    by_planes = np.zeros_like(given["planes"])
    loss = image_loss(
        given["planes"],
        given["color"],
        given["depth_m"],
        Exposure.of(given["exposure"]),
        LossWeights(*WEIGHTS),
        by_planes,
        mask=given["mask"],
        threads=given.get("threads", 1),
    )
    return loss.total, by_planes


def test_missing_mask_means_that_every_pixel_counts() -> None:
    given = scene(20, 30)
    everywhere = loss_of(given, mask=np.ones((20, 30), np.uint8))
    for a, b in zip(loss_of(given, mask=None), everywhere, strict=True):
        np.testing.assert_array_equal(a, b)


def test_masked_pixels_have_no_say() -> None:
    given = scene(20, 30)
    outside = given["mask"] == 0
    repainted = np.where(outside, 7, given["planes"]).astype(np.float32)
    before, by_planes = loss_of(given)
    after, _ = loss_of(given, planes=repainted)
    assert before == after
    assert not by_planes[:, outside].any()
    assert by_planes[:, ~outside].any()


def test_loss_of_the_frame_itself_is_zero() -> None:
    given = scene(20, 30)
    given["planes"][:3] = given["color"] * np.float32(1 / 255)
    given["planes"][3] = given["depth_m"]
    given["exposure"] = Exposure().matrix
    total, by_planes = loss_of(given)
    assert abs(total) < 1e-6
    assert np.abs(by_planes[3:]).max() == 0
    assert np.abs(by_planes).max() < 1e-3 / by_planes[0].size


def test_frame_without_depth_has_no_depth_loss() -> None:
    given = scene(8, 8)
    _, by_planes = loss_of(given, depth_m=np.zeros((8, 8), np.float32))
    assert not by_planes[3:].any()


def test_similarity_is_one_for_equal_images_and_falls_with_noise() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 1, (30, 30, 3))
    np.testing.assert_allclose(ssim(image, image), 1)
    a_little, much = (
        ssim(image, image + s * rng.normal(size=image.shape)).mean() for s in (0.1, 1)
    )
    assert 1 > a_little > much > 0


@pytest.mark.parametrize("threads", [2, 5])
def test_number_of_threads_changes_no_bit(threads: int) -> None:
    given = scene(300, 61)
    one, many = loss_of(given), loss_of(given, threads=threads)
    assert one[0] == many[0]
    assert one[1].tobytes() == many[1].tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"planes": np.zeros((4, 8, 8), np.float32)}, r"\[5, H, W\]"),
        ({"color": np.zeros((8, 8, 3), np.uint8)}, r"color must have shape \[3, 8, 8\]"),
        ({"color": np.zeros((3, 8, 8), np.float32)}, "uint8"),
        ({"depth": np.zeros((8, 7), np.float32)}, "depth must have shape"),
        ({"mask": np.zeros((8, 8), bool)}, "mask must be uint8"),
        ({"exposure": np.zeros((2, 3))}, "exposure must be float32"),
        ({"gradients": np.zeros((5, 8, 16), np.float32)[:, :, ::2]}, "contiguous"),
        ({"threads": 0}, "threads"),
    ],
)
def test_bad_arguments_raise_value_error(change: dict, message: str) -> None:
    given = scene(8, 8)
    arguments = {
        "planes": given["planes"],
        "color": given["color"],
        "depth": given["depth_m"],
        "mask": given["mask"],
        "exposure": given["exposure"],
        "l1": 0.8,
        "d_ssim": 0.2,
        "depth_weight": 1.0,
        "gradients": np.zeros((5, 8, 8), np.float32),
    }
    _loss.image_loss(**arguments)
    with pytest.raises(ValueError, match=message):
        _loss.image_loss(**arguments | change)
