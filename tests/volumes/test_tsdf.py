"""Judge: the exact surface of the synthetic room, and a plane."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera
from ldo_service.volumes import Mesh, Tsdf, TsdfConfig, Viewpoint, fuse

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
AHEAD = Viewpoint(CAMERA, np.eye(4))
VOXEL_M = 0.02


def looking_at_a_wall(tsdf: Tsdf, distance_m: float, color: float = 0.5) -> Tsdf:
    depth_m = np.full((48, 64), distance_m, np.float32)
    tsdf.integrate(depth_m, np.full((48, 64, 3), color, np.float32), AHEAD)
    return tsdf


@pytest.fixture(scope="module")
def fused(mapped) -> Tsdf:
    return fuse(mapped.rows, mapped.viewpoints, TsdfConfig(VOXEL_M))


@pytest.fixture(scope="module")
def mesh(fused: Tsdf) -> Mesh:
    return fused.mesh()


def test_vertices_lie_on_the_surface(mesh: Mesh, p_true: np.ndarray) -> None:
    distance_m, _ = cKDTree(p_true).query(mesh.vertices_m)
    assert len(mesh.vertices_m) > 50_000
    assert np.median(distance_m) < 0.6 * VOXEL_M
    assert np.mean(distance_m < 2 * VOXEL_M) > 0.995
    assert distance_m.max() < 5 * VOXEL_M


def test_the_surface_that_was_seen_is_there(mesh: Mesh, p_true: np.ndarray) -> None:
    distance_m, _ = cKDTree(mesh.vertices_m).query(p_true[::17])
    assert np.mean(distance_m < 2 * VOXEL_M) > 0.97


def test_triangles_face_the_free_side(mesh: Mesh, mapped) -> None:
    """Every wall is seen from the middle of the room; what stands before it may look elsewhere."""
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.triangles].astype(float), 1, 0)
    across = np.cross(b - a, c - a)
    center = np.mean([v.T_map_camera[:3, 3] for v in mapped.viewpoints], axis=0)
    toward = np.einsum("ni,ni->n", across, center - a) > 0
    area = np.linalg.norm(across, axis=1)
    assert area[toward].sum() > 0.95 * area.sum()


def test_memory_is_that_of_the_blocks_near_a_surface(fused: Tsdf, mesh: Mesh) -> None:
    """A surface through blocks of 16 cm, and 8 cm to both sides: three blocks for each face."""
    assert fused.memory_mb == pytest.approx(fused.blocks * 512 * 20 / 2**20)
    assert fused.blocks < 3 * mesh.area_m2 / 0.16**2


def test_a_wall_is_flat_where_it_is() -> None:
    mesh = looking_at_a_wall(Tsdf(), 1.503).mesh()
    np.testing.assert_allclose(mesh.vertices_m[:, 2], 1.503, atol=1e-5)
    expected_m2 = (1.503 / 60) ** 2 * 64 * 48
    assert mesh.area_m2 == pytest.approx(expected_m2, rel=0.05)


def test_views_are_averaged_by_the_density_of_their_pixels() -> None:
    tsdf = looking_at_a_wall(looking_at_a_wall(Tsdf(), 1.500, color=0.2), 1.510, color=0.8)
    mesh = tsdf.mesh()
    np.testing.assert_allclose(mesh.vertices_m[:, 2], 1.505, atol=1e-4)
    np.testing.assert_allclose(mesh.colors, 255 * 0.5, atol=2)


def test_the_order_of_views_does_not_matter(mapped) -> None:
    config = TsdfConfig(0.05)
    forward, backward = (
        fuse(mapped.rows, views, config).mesh()
        for views in (mapped.viewpoints[:3], mapped.viewpoints[2::-1])
    )
    assert len(forward.triangles) == len(backward.triangles)
    distance_m, _ = cKDTree(backward.vertices_m).query(forward.vertices_m)
    assert distance_m.max() < 1e-5


def test_too_little_memory_is_said_and_what_was_fused_stays() -> None:
    tsdf = looking_at_a_wall(Tsdf(TsdfConfig(max_memory_mb=2)), 0.5)
    before = tsdf.blocks
    with pytest.raises(ConfigError, match="larger voxels"):
        looking_at_a_wall(tsdf, 4.0)
    assert tsdf.blocks == before
    assert tsdf.memory_mb <= 2


def test_nothing_seen_makes_an_empty_mesh() -> None:
    mesh = looking_at_a_wall(Tsdf(), 0.0).mesh()
    assert mesh.vertices_m.shape == (0, 3)
    assert mesh.triangles.shape == (0, 3)


@pytest.mark.parametrize(
    "change", [{"voxel_m": 0.0}, {"voxel_m": np.nan}, {"truncation_voxels": 0.5}], ids=str
)
def test_a_config_without_sense_is_refused(change: dict) -> None:
    with pytest.raises(ConfigError):
        replace(TsdfConfig(), **change)
