from math import log10

import autograd.numpy as anp
import cv2
import numpy as np
import pytest
from autograd import grad

from ldo_service.gaussians.exposure import Exposure
from ldo_service.gaussians.loss import LossWeights, image_loss
from tests.kernels.gpu.agreement import check, peak, relative
from tests.kernels.gpu.scenes import ARRAYS, frame_loss, host, of_kernel, plane_rendering
from tests.reference.loss import loss_reference

WEIGHTS = LossWeights(0.8, 0.2, 0.5)
Images = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def images(width: int, height: int, seed: int) -> Images:
    """Return planes, color, depth, mask and exposure, with smooth and rough content."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    smooth = 0.5 + 0.4 * np.sin(0.4 * x + np.arange(3)[:, None, None]) * np.cos(0.3 * y)
    planes = np.empty((5, height, width), np.float32)
    planes[:3] = smooth + rng.normal(0, 0.05, smooth.shape)
    planes[3:] = rng.uniform(0.5, 2, (2, height, width))
    color = (smooth * 230 + rng.normal(0, 9, smooth.shape)).clip(0, 255).astype(np.uint8)
    depth_m = rng.uniform(0.5, 2, (height, width)) * (rng.random((height, width)) > 0.3)
    mask = (rng.random((height, width)) > 0.2).astype(np.uint8)
    exposure = np.array([[1.1, 0.9, 1.0], [0.02, -0.03, 0.0]], np.float32)
    return planes, color, depth_m.astype(np.float32), mask, exposure


IMAGES = {
    "wide": images(37, 18, 0),
    "smaller than the window": images(7, 9, 1),
    "one tile": images(16, 16, 2),
}


def rendering_of(planes: np.ndarray) -> plane_rendering.PlaneRendering:
    """Return a rendering with given planes; the loss reads nothing else of it."""
    none = of_kernel("no Gaussians")
    height, width = planes.shape[1:]
    return plane_rendering.PlaneRendering(
        none.view, 1.0, width, height, none.splats, none.lists, ARRAYS.upload(planes), none.ends
    )


def loss_of_kernel(given: Images) -> tuple[np.ndarray, np.ndarray]:
    planes, color, depth_m, mask, exposure = given
    measured = int(np.count_nonzero((depth_m > 0) & (mask > 0)))
    frame = frame_loss.Frame(*map(ARRAYS.upload, (color, depth_m, mask)), measured)
    weights = WEIGHTS.l1, WEIGHTS.d_ssim, WEIGHTS.depth
    by_planes, means = frame_loss.image_loss(ARRAYS, rendering_of(planes), frame, exposure, weights)
    return host(by_planes), means


@pytest.mark.parametrize("name", IMAGES)
def test_loss_equals_that_of_the_cpu(name: str) -> None:
    planes, color, depth_m, mask, exposure = IMAGES[name]
    got, (l1, d_ssim, depth, squared) = loss_of_kernel(IMAGES[name])
    wanted = np.empty_like(planes)
    loss = image_loss(planes, color, depth_m, Exposure.of(exposure), WEIGHTS, wanted, mask=mask)
    for k in range(4):
        check("derivatives of loss to C++", relative(got[k], wanted[k]), f"{name}, plane {k}")
    assert not got[4].any()
    assert not got[:3, mask == 0].any()
    values = np.array([l1, d_ssim, depth, -10 * log10(squared)])
    error = values / [loss.l1, loss.d_ssim, loss.depth_m, loss.psnr_db] - 1
    check("loss to C++", np.abs(error).max(), name)


@pytest.mark.parametrize("name", IMAGES)
def test_loss_equals_the_reference(name: str) -> None:
    planes, color, depth_m, mask, exposure = IMAGES[name]
    weights = WEIGHTS.l1, WEIGHTS.d_ssim, WEIGHTS.depth

    def value(planes):
        return loss_reference(
            planes, exposure.astype(float), color / 255.0, depth_m.astype(float),
            mask.astype(float), weights, anp,
        )  # fmt: skip

    got, means = loss_of_kernel(IMAGES[name])
    wanted = grad(value)(planes.astype(float))
    for k in range(4):
        check("derivatives of loss to reference", relative(got[k], wanted[k]), f"{name}, plane {k}")
    error = abs(np.dot(weights, means[:3]) / value(planes.astype(float)) - 1)
    check("loss to reference", error, name)


def test_loss_without_measured_depth_has_no_depth_term() -> None:
    planes, color, _, mask, exposure = IMAGES["one tile"]
    got, means = loss_of_kernel((planes, color, np.zeros_like(planes[0]), mask, exposure))
    assert means[2] == 0
    assert not got[3].any()


@pytest.mark.parametrize("side", [3, 8])
def test_block_means_equal_those_of_opencv_and_the_reference(side: int) -> None:
    planes = IMAGES["wide"][0]
    got = plane_rendering.mean_blocks(ARRAYS, rendering_of(planes), side)
    down, across = 18 // side, 37 // side
    assert got.shape == (4, down, across)
    for k, plane in enumerate((0, 1, 2, 4)):
        whole = np.ascontiguousarray(planes[plane, : down * side, : across * side])
        wanted = cv2.resize(whole, (across, down), interpolation=cv2.INTER_AREA)
        check("block means to OpenCV", peak(got[k], wanted), f"side {side}, plane {plane}")
        wanted = whole.astype(float).reshape(down, side, across, side).mean(axis=(1, 3))
        check("block means to reference", peak(got[k], wanted), f"side {side}, plane {plane}")


def test_image_smaller_than_a_block_has_no_block_means() -> None:
    got = plane_rendering.mean_blocks(ARRAYS, rendering_of(IMAGES["smaller than the window"][0]), 8)
    assert got.shape == (4, 1, 0)
