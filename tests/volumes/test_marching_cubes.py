"""Marching cubes against closed forms of a ball and a plane, and trimesh."""

from collections import Counter

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.volumes.marching_cubes import LatticeBlock, Surface, marching_cubes, pack

SIDE = 8  # Cells per side of a block.
N = 3 * SIDE + 1


def surface_of(values: np.ndarray, is_used: np.ndarray | None = None) -> Surface:
    """Return the surface of values on a lattice, computed block by block.

    The attribute of a point is its position.

    Args:
        values: Values at the nodes, [N, N, N].
        is_used: Mask of the cells to use, [N - 1, N - 1, N - 1]; all by default.
    """
    is_crossed = np.ones((N - 1,) * 3, bool) if is_used is None else is_used
    low = np.min([values[at] for at in corners()], axis=0)
    high = np.max([values[at] for at in corners()], axis=0)
    is_crossed = is_crossed & (low < 0) & (high >= 0)
    blocks = []
    for origin in np.ndindex(3, 3, 3):
        first = SIDE * np.array(origin)
        cells = tuple(slice(start, start + SIDE) for start in first)
        nodes = tuple(slice(start, start + SIDE + 1) for start in first)
        if is_crossed[cells].any():
            at = positions()[nodes].astype(float)
            blocks.append(
                LatticeBlock(first, values[nodes].astype(np.float32), at, is_crossed[cells])
            )
    return marching_cubes(blocks, attributes=3)


def corners() -> list[tuple[slice, ...]]:
    """Return windows of the values for the eight corners of all cells."""
    return [tuple(slice(c, N - 1 + c) for c in corner) for corner in np.ndindex(2, 2, 2)]


def positions() -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(N)] * 3, indexing="ij"), -1)


def ball(center: tuple[float, float, float], radius: float) -> np.ndarray:
    return np.linalg.norm(positions() - center, axis=-1) - radius


def edge_counts(surface: Surface) -> Counter:
    t = surface.triangles
    return Counter(map(tuple, np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]]).tolist()))


def test_ball_has_its_radius_volume_and_area() -> None:
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh")
    surface = surface_of(ball((11.3, 11.6, 12.1), 8.0))
    radii = np.linalg.norm(surface.points - [11.3, 11.6, 12.1], axis=1)
    assert np.abs(radii - 8).max() < 0.02  # Error of linear interpolation.
    mesh = trimesh.Trimesh(surface.points, surface.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    # The volume is positive if faces point outward.
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 8**3, rel=0.01)
    assert mesh.area == pytest.approx(4 * np.pi * 8**2, rel=0.01)


def test_plane_is_exact() -> None:
    normal = np.array([0.6, 0.0, 0.8])
    surface = surface_of(positions() @ normal - 15.3)
    np.testing.assert_allclose(surface.points @ normal, 15.3, atol=1e-5)
    a, b, c = np.moveaxis(surface.points[surface.triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    np.testing.assert_allclose(normals[area > 1e-3] @ normal, area[area > 1e-3], rtol=1e-3)


def test_attributes_are_interpolated_at_the_points() -> None:
    surface = surface_of(ball((11.3, 11.6, 12.1), 8.0))
    np.testing.assert_allclose(surface.attributes, surface.points, atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_noise_covers_all_cases_without_cracks(seed: int) -> None:
    """Each edge of a triangle belongs to exactly one other, in the reverse direction."""
    values = np.random.default_rng(seed).normal(size=(N, N, N))
    values[[0, -1]] = values[:, [0, -1]] = values[:, :, [0, -1]] = 1  # Closed at the border.
    cases = np.stack([values[at] < 0 for at in corners()]).reshape(8, -1).T @ (1 << np.arange(8))
    assert len(np.unique(cases)) == 256
    surface = surface_of(values)
    counts = edge_counts(surface)
    assert set(counts.values()) == {1}
    assert all((b, a) in counts for a, b in counts)


def test_packed_triples_are_unique_and_ordered() -> None:
    limit = (1 << 19) - 1
    triples = np.array(
        [[-limit, limit, limit], [0, -limit, 0], [0, 0, -1], [0, 0, 0], [limit, -limit, -limit]]
    )
    assert (np.diff(pack(triples)) > 0).all()
    with pytest.raises(ConfigError, match="larger voxels"):
        pack(np.array([[0, 1 << 19, 0]]))


def test_surface_through_corners_has_no_duplicates_or_cracks() -> None:
    """Values of zero belong to the outside."""
    values = np.abs(positions() - 12).max(axis=-1) - 5.0
    surface = surface_of(values)
    assert np.abs(surface.points - 12).max(axis=1).tolist() == [5.0] * len(surface.points)
    counts = edge_counts(surface)
    assert set(counts.values()) == {1}
    assert all((b, a) in counts for a, b in counts)


def test_diagonal_corners_of_a_face_are_separated() -> None:
    values = np.ones((N, N, N))
    values[8, 8, 8] = values[9, 9, 8] = -1  # Diagonal nodes of a face between two blocks.
    surface = surface_of(values)
    assert surface.points.shape == (12, 3)  # Two octahedra.
    assert surface.triangles.shape == (16, 3)


def test_unused_cells_have_no_surface() -> None:
    """Cells below the plane x = 10, which divides a block, are not used."""
    is_used = np.zeros((N - 1,) * 3, bool)
    is_used[10:] = True
    surface = surface_of(ball((11.3, 11.6, 12.1), 8.0), is_used)
    whole = surface_of(ball((11.3, 11.6, 12.1), 8.0))
    kept = whole.points[whole.triangles].min(axis=1)[:, 0] >= 10
    assert surface.points[:, 0].min() == 10
    assert len(surface.triangles) == np.count_nonzero(kept)


def test_values_of_one_sign_give_no_surface() -> None:
    surface = surface_of(np.ones((N, N, N)))
    assert surface.points.shape == (0, 3)
    assert surface.triangles.shape == (0, 3)
