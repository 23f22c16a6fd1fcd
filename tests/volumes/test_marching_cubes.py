"""Judges: closed forms of a ball and a plane, and trimesh."""

from collections import Counter

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.volumes.marching_cubes import CORNERS, Surface, marching_cubes, pack

N = 24


def of_a_lattice(values: np.ndarray) -> Surface:
    """The surface in all cells of values [X, Y, Z]; the attribute is the position."""
    cells = np.stack(
        np.meshgrid(*[np.arange(side - 1) for side in values.shape], indexing="ij"), -1
    ).reshape(-1, 3)
    corners = cells[:, None] + CORNERS
    return marching_cubes(cells, values[tuple(np.moveaxis(corners, -1, 0))], corners.astype(float))


def positions() -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(N)] * 3, indexing="ij"), -1)


def ball(center: tuple[float, float, float], radius: float) -> np.ndarray:
    return np.linalg.norm(positions() - center, axis=-1) - radius


def sides(surface: Surface) -> Counter:
    t = surface.triangles
    return Counter(map(tuple, np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]]).tolist()))


def test_a_ball_has_its_radius_volume_and_area() -> None:
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh")
    surface = of_a_lattice(ball((11.3, 11.6, 12.1), 8.0))
    radii = np.linalg.norm(surface.points - [11.3, 11.6, 12.1], axis=1)
    assert np.abs(radii - 8).max() < 0.02  # linear interpolation of a curved distance
    mesh = trimesh.Trimesh(surface.points, surface.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 8**3, rel=0.01)  # positive: faces outward
    assert mesh.area == pytest.approx(4 * np.pi * 8**2, rel=0.01)


def test_a_plane_is_met_exactly() -> None:
    normal = np.array([0.6, 0.0, 0.8])
    surface = of_a_lattice(positions() @ normal - 15.3)
    np.testing.assert_allclose(surface.points @ normal, 15.3, atol=1e-12)
    a, b, c = np.moveaxis(surface.points[surface.triangles], 1, 0)
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1)
    np.testing.assert_allclose(across[area > 1e-9] @ normal, area[area > 1e-9])


def test_attributes_are_interpolated_where_the_points_are() -> None:
    surface = of_a_lattice(ball((11.3, 11.6, 12.1), 8.0))
    np.testing.assert_allclose(surface.attributes, surface.points)


@pytest.mark.parametrize("seed", range(5))
def test_noise_meets_all_cases_and_leaves_no_crack(seed: int) -> None:
    """Each side of a triangle is that of one other, walked the other way; each point lies between
    two corners of different sign."""
    values = np.random.default_rng(seed).normal(size=(N, N, N))
    values[[0, -1]] = values[:, [0, -1]] = values[:, :, [0, -1]] = 1  # closed at the border
    cells = np.stack([values[x : N - 1 + x, y : N - 1 + y, z : N - 1 + z] for x, y, z in CORNERS])
    assert len(np.unique((cells < 0).reshape(8, -1).T @ (1 << np.arange(8)))) == 256
    surface = of_a_lattice(values)
    counts = sides(surface)
    assert set(counts.values()) == {1}
    assert all((b, a) in counts for a, b in counts)


def test_triples_keep_their_order_and_their_own_number() -> None:
    far = (1 << 19) - 1
    triples = np.array([[-far, far, far], [0, -far, 0], [0, 0, -1], [0, 0, 0], [far, -far, -far]])
    assert (np.diff(pack(triples)) > 0).all()
    with pytest.raises(ConfigError, match="larger voxels"):
        pack(np.array([[0, 1 << 19, 0]]))


def test_no_crossing_makes_no_surface() -> None:
    surface = of_a_lattice(np.ones((N, N, N)))
    assert surface.points.shape == (0, 3)
    assert surface.triangles.shape == (0, 3)
