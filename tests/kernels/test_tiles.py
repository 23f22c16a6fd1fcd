"""Tests of renderings, losses and gradients of some tiles against the masked whole image."""

import numpy as np
import pytest

from ldo_service.gaussians import Exposure, LossWeights, Rasterizer, RowGradients, image_loss
from ldo_service.gaussians.loss import tile_mask
from ldo_service.geometry import Camera

CAMERA = Camera(75, 50, 60.0, 62.0, 35.0, 27.0)  # 5 x 4 tiles; the last ones are cut.
TILES = np.array([[0, 1, 0, 0, 1], [0, 0, 0, 0, 0], [1, 0, 1, 1, 0], [0, 0, 0, 0, 1]], np.uint8)
INSIDE = tile_mask(TILES, 50, 75).astype(bool)


def gaussians(n: int) -> np.ndarray:
    """Return random rows in front of the camera."""
    rng = np.random.default_rng(n)
    rows = np.zeros((n, 16), np.float32)
    rows[:, 2] = rng.uniform(0.5, 4, n)
    rows[:, :2] = rng.uniform(-0.8, 0.8, (n, 2)) * rows[:, 2:3]
    rows[:, 3:6] = np.log(0.03 * rows[:, 2:3] * rng.uniform(0.1, 2, (n, 3)))
    rows[:, 6:10], rows[:, 10] = rng.normal(size=(n, 4)), rng.uniform(-3, 4, n)
    rows[:, 11:14] = rng.uniform(0, 1, (n, 3))
    return rows


def test_wanted_tiles_have_the_bits_of_the_whole_image_and_the_others_are_zero() -> None:
    rows, rasterizer = gaussians(9_000), Rasterizer()
    whole = rasterizer.render(rows, CAMERA, np.eye(4)).copy()
    for threads in (1, 3):
        some = Rasterizer(threads=threads).render(rows, CAMERA, np.eye(4), tiles=TILES)
        assert some[:, INSIDE].tobytes() == whole[:, INSIDE].tobytes()
        assert not some[:, ~INSIDE].any()
    assert whole[4, ~INSIDE].mean() > 0.3


def by_row(gradients: RowGradients, n: int) -> np.ndarray:
    """Return the gradients as an array [n, 16], zero for rows without one."""
    out = np.zeros((n, 16), np.float32)
    out[gradients.indices] = gradients.rows
    return out


def test_gradients_are_those_of_the_wanted_tiles_alone() -> None:
    rows = gaussians(9_000)
    by_planes = np.random.default_rng(0).normal(size=(5, 50, 75)).astype(np.float32)
    whole, some = Rasterizer(), Rasterizer(threads=2)
    whole.render(rows, CAMERA, np.eye(4))
    wanted = whole.gradients(by_planes * INSIDE)
    some.render(rows, CAMERA, np.eye(4), tiles=TILES)
    actual = some.gradients(by_planes)
    assert 0 < len(actual.indices) < 0.8 * len(wanted.indices)
    np.testing.assert_array_equal(by_row(actual, 9_000)[:, :14], by_row(wanted, 9_000)[:, :14])
    np.testing.assert_allclose(actual.xi, wanted.xi, rtol=1e-5)


def test_weights_are_counted_in_the_wanted_tiles_alone() -> None:
    rasterizer = Rasterizer()
    planes = rasterizer.render(gaussians(9_000), CAMERA, np.eye(4), tiles=TILES)
    gradients = rasterizer.gradients(np.zeros_like(planes))
    np.testing.assert_allclose(gradients.rows[:, 14].sum(), planes[4].sum(), rtol=1e-5)


@pytest.mark.parametrize("is_masked", [False, True])
def test_loss_of_some_tiles_is_the_masked_loss_per_pixel_of_theirs(is_masked: bool) -> None:
    rng = np.random.default_rng(1)
    planes = rng.uniform(0, 1, (5, 50, 75)).astype(np.float32)
    color = rng.integers(0, 256, (3, 50, 75), np.uint8)
    depth_m = rng.uniform(0, 1, (50, 75)).astype(np.float32)
    mask = (rng.uniform(size=(50, 75)) < 0.7).astype(np.uint8) if is_masked else None
    both = INSIDE.astype(np.uint8) if mask is None else INSIDE * mask
    frame, weights, more = (color, depth_m, Exposure()), LossWeights(depth=0), 1 / INSIDE.mean()
    some, masked = np.empty_like(planes), np.empty_like(planes)
    a = image_loss(planes, *frame, weights, some, mask=mask, tiles=TILES)
    b = image_loss(planes, *frame, weights, masked, mask=both)
    np.testing.assert_allclose(
        [a.l1, a.d_ssim, a.total], np.array([b.l1, b.d_ssim, b.total]) * more
    )
    np.testing.assert_allclose(a.psnr_db, b.psnr_db - 10 * np.log10(more))
    np.testing.assert_allclose(some, masked * more, rtol=1e-5, atol=1e-12)
    assert not some[:, ~INSIDE].any()


def test_depth_loss_of_some_tiles_is_their_mean() -> None:
    planes, depth_m = np.zeros((5, 50, 75), np.float32), np.ones((50, 75), np.float32)
    depth_m[~INSIDE] = 7
    frame = np.zeros((3, 50, 75), np.uint8), depth_m, Exposure()
    loss = image_loss(planes, *frame, LossWeights(), np.empty_like(planes), tiles=TILES)
    assert loss.depth_m == 1


@pytest.mark.parametrize(
    ("tiles", "message"),
    [(np.ones((3, 5), np.uint8), r"shape"), (np.zeros((4, 5), np.uint8), "not all be 0")],
)
def test_senseless_tiles_are_refused(tiles: np.ndarray, message: str) -> None:
    planes = np.zeros((5, 50, 75), np.float32)
    frame = np.zeros((3, 50, 75), np.uint8), planes[0], Exposure()
    with pytest.raises(ValueError, match=message):
        image_loss(planes, *frame, LossWeights(), planes.copy(), tiles=tiles)


@pytest.mark.parametrize("tiles", [np.ones((4, 4), np.uint8), np.ones((4, 5))])
def test_tiles_that_do_not_fit_are_refused(tiles: np.ndarray) -> None:
    with pytest.raises(ValueError, match="tiles"):
        Rasterizer().render(gaussians(9), CAMERA, np.eye(4), tiles=tiles)
