import numpy as np
import pytest

from ldo_service.geometry import Camera, se3
from ldo_service.tracking import PyramidConfig, build_reference, pyramid_of
from ldo_service.tracking.alignment import BrightnessModel, ResidualConfig, normal_equations
from ldo_service.tracking.pyramid import Level
from tests.reference import alignment

APPEARANCE = BrightnessModel(gain=1.1, bias=-4.0, intensity_sigma=6.0, depth_noise_scale=1.5)
T_CAMERA_REFERENCE = se3.exp(np.array([0.02, -0.03, 0.01, 0.04, -0.02, 0.03]))


@pytest.mark.parametrize("level", [0, 1, 2])
def test_kernel_equals_the_reference_implementation(room, level: int) -> None:
    pyramid = pyramid_of(room.view(np.eye(4)), PyramidConfig())
    view = room.view(se3.inverse(T_CAMERA_REFERENCE))
    view.depth_m[30:50, 40:90] = 0  # A hole in the depth.
    view.color[60:80, 20:60] = 255  # Clipped to white.
    view.color[100:, 100:] = 0
    target = pyramid_of(view, PyramidConfig()).levels[level]
    points = build_reference(pyramid).points[level]
    guess = se3.exp(np.array([0.004, 0.002, -0.003, 0.01, 0.01, -0.02])) @ T_CAMERA_REFERENCE
    arguments = (points, target, guess, APPEARANCE, ResidualConfig())
    fast, plain = normal_equations(*arguments), alignment.normal_equations(*arguments)
    scale = np.abs(plain.hessian).max(axis=1)
    assert fast.visible == pytest.approx(plain.visible, abs=2)  # Rounding at the image border.
    for a, b in ((fast.photometric, plain.photometric), (fast.geometric, plain.geometric)):
        assert a.count > 50
        assert a.count == pytest.approx(b.count, abs=2)
        assert a.inliers == pytest.approx(b.inliers, abs=3)
        assert a.square == pytest.approx(b.square, rel=3e-3)
    np.testing.assert_allclose(fast.hessian / scale, plain.hessian / scale, atol=3e-3)
    size = np.sqrt(np.diag(plain.hessian))
    np.testing.assert_allclose(fast.gradient / size, plain.gradient / size, atol=0.3)


def perturbed(xi: np.ndarray, points: np.ndarray, normals: np.ndarray) -> tuple:
    """Return camera points and normals under T_reference_camera * exp(xi)."""
    T_reference_camera = se3.inverse(T_CAMERA_REFERENCE) @ se3.exp(xi)
    T = se3.inverse(T_reference_camera)
    return se3.transform(T, points), normals @ T[:3, :3].T


def central_differences(residuals, step: float = 1e-5) -> np.ndarray:
    columns = [
        (residuals(step * axis) - residuals(-step * axis)) / (2 * step) for axis in np.eye(6)
    ]
    return np.stack(columns, axis=1)


def surface(rng: np.random.Generator, n: int = 40) -> tuple[np.ndarray, np.ndarray]:
    points = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 2.5], (n, 3))
    normals = rng.normal(size=(n, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_geometric_jacobian_is_the_derivative() -> None:
    rng = np.random.default_rng(0)
    points, normals = surface(rng)
    q = points + rng.normal(0, 0.05, points.shape)

    def residuals(xi: np.ndarray) -> np.ndarray:
        p, n = perturbed(xi, points, normals)
        return alignment.geometric(p, n, q)[0]

    _, J = alignment.geometric(*perturbed(np.zeros(6), points, normals), q)
    np.testing.assert_allclose(J[:, :6], central_differences(residuals), atol=1e-8)


def test_photometric_jacobian_is_the_derivative() -> None:
    camera = Camera(160, 120, 130.0, 125.0, 79.0, 61.0)
    v, u = np.mgrid[:120, :160]
    flat = np.ones_like(u, float)
    image = 0.7 * u - 0.4 * v + 30  # Bilinear samples of a ramp are exact.
    level = Level(np.stack([image, 0.7 * flat, -0.4 * flat, flat], axis=-1), camera)
    points, normals = surface(np.random.default_rng(1))
    shade = np.linspace(10, 200, len(points))

    def residuals(xi: np.ndarray, appearance: BrightnessModel = APPEARANCE) -> np.ndarray:
        p, _ = perturbed(xi, points, normals)
        return alignment.photometric(level, p, shade, *camera.project(p).T, appearance)[0]

    p, _ = perturbed(np.zeros(6), points, normals)
    _, J = alignment.photometric(level, p, shade, *camera.project(p).T, APPEARANCE)
    np.testing.assert_allclose(J[:, :6], central_differences(residuals), atol=1e-5)
    brighter = BrightnessModel(APPEARANCE.gain + 1, APPEARANCE.bias + 2)
    change = residuals(np.zeros(6), brighter) - residuals(np.zeros(6))
    np.testing.assert_allclose(J[:, 6] + 2 * J[:, 7], change, atol=1e-9)
