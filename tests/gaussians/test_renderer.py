import numpy as np
import pytest

from ldo_service.errors import DataError
from ldo_service.gaussians import render
from ldo_service.geometry import Camera, se3
from tests.reference.render import render_reference

CAMERA = Camera(33, 21, 30.0, 32.0, 15.0, 11.0)


def disc(x: float, y: float, z: float, *, sigma_m: float = 0.2, opacity_logit: float = 2.0):
    row = np.zeros(16, np.float32)
    row[:3], row[3:6], row[6] = (x, y, z), np.log(sigma_m), 1
    row[10], row[11:14] = opacity_logit, (0.2, 0.5, 0.8)
    return row


def test_gaussian_is_rendered_at_its_projected_mean() -> None:
    T_camera_map = se3.exp(np.array([0.1, -0.2, 0.3, 0.1, 0.1, 0.3]))
    mean_camera = CAMERA.rays()[7, 22] * 2.0
    mean_map = se3.transform(se3.inverse(T_camera_map), mean_camera)
    rendering = render(disc(*mean_map, sigma_m=0.05)[None], CAMERA, T_camera_map)
    row, column = np.unravel_index(np.argmax(rendering.opacity), rendering.opacity.shape)
    assert (row, column) == (7, 22)
    np.testing.assert_allclose(rendering.opacity[7, 22], 1 / (1 + np.exp(-2.0)), atol=1e-4)


def test_depths_of_a_surface_agree_and_are_zero_elsewhere() -> None:
    rendering = render(disc(0, 0, 2.0)[None], CAMERA, np.eye(4))
    seen = rendering.opacity > 0.5
    assert 0 < seen.sum() < seen.size
    np.testing.assert_allclose(rendering.depth_m[seen], 2.0, atol=1e-5)
    np.testing.assert_allclose(rendering.median_depth_m[seen], 2.0)
    assert not rendering.depth_m[~seen].any()
    assert not rendering.median_depth_m[~seen].any()
    np.testing.assert_allclose(rendering.weighted_depth_m, 2 * rendering.opacity, atol=1e-6)


def test_median_depth_lies_on_a_surface_unlike_mean_depth() -> None:
    rows = np.stack([disc(0, 0, 1.0, opacity_logit=1.0), disc(0, 0, 3.0, opacity_logit=4.0)])
    rendering = render(rows, CAMERA, np.eye(4))
    assert rendering.median_depth_m[11, 15] == 1.0
    assert 1.2 < rendering.depth_m[11, 15] < 2.0


def test_camera_with_lens_distortion_raises() -> None:
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0, (0.1, 0.0, 0.0, 0.0))
    with pytest.raises(DataError, match="rectified"):
        render(disc(0, 0, 1.0)[None], camera, np.eye(4))


def test_reference_renderer_is_differentiable() -> None:
    anp = pytest.importorskip("autograd.numpy", reason="pip install autograd")
    from autograd import grad

    camera = Camera(9, 7, 8.0, 8.0, 4.0, 3.0)
    rng = np.random.default_rng(0)
    rows = np.stack([disc(*rng.uniform(-0.3, 0.3, 2), z).astype(float) for z in (1.0, 1.5, 2.0)])
    rows[:, 6:10] += rng.normal(0, 0.3, (3, 4))
    weights = rng.normal(size=(7, 9, 3))

    def loss(rows: np.ndarray) -> float:
        rendering = render_reference(rows, camera, np.eye(4), anp)
        return anp.sum(weights * rendering.color) + anp.sum(rendering.weighted_depth_m)

    gradient = grad(loss)(rows)
    step = 1e-6 * rng.normal(size=rows.shape)
    expected = (loss(rows + step) - loss(rows - step)) / 2
    assert abs(expected) > 1e-7
    np.testing.assert_allclose(np.sum(gradient * step), expected, rtol=1e-4)
