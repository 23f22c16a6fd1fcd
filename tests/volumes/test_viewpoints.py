import numpy as np

from ldo_service.gaussians import Rendering
from ldo_service.geometry import Camera, se3
from ldo_service.volumes import Viewpoint
from ldo_service.volumes.viewpoints import surface_color, surface_depth_m


def disc(z_m: float, opacity_logit: float, color: float) -> np.ndarray:
    """Return a wide Gaussian that covers the view."""
    row = np.zeros(16, np.float32)
    row[2], row[3:6], row[6] = z_m, np.log([1.0, 1.0, 0.01]), 1
    row[10], row[11:14] = opacity_logit, color
    return row


def rendering_of(*rows: np.ndarray) -> Rendering:
    """Render the rows from a camera 2 m behind the map origin."""
    viewpoint = Viewpoint(
        Camera(9, 7, 9.0, 9.0, 4.0, 3.0), se3.exp(np.array([0, 0, 0, 0, 0, -2.0]))
    )
    return viewpoint.render(np.stack(rows))


def test_depth_of_a_single_surface() -> None:
    rendering = rendering_of(disc(1.0, 3.0, 0.5), disc(1.01, 3.0, 0.5))
    depth_m = surface_depth_m(rendering, 0.02)
    assert 3.0 < depth_m[3, 4] < 3.01
    assert depth_m.dtype == np.float32


def test_depth_between_two_surfaces_is_zero() -> None:
    rendering = rendering_of(disc(1.0, 1.0, 0.5), disc(3.0, 4.0, 0.5))
    assert 3.2 < rendering.depth_m[3, 4] < 4.0
    assert surface_depth_m(rendering, 0.02)[3, 4] == 0


def test_color_excludes_the_background() -> None:
    rendering = rendering_of(disc(1.0, 0.5, 0.8))
    assert rendering.color[3, 4, 0] < 0.6
    np.testing.assert_allclose(surface_color(rendering)[3, 4], 0.8, atol=1e-5)
