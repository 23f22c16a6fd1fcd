"""TSDF fusion against the exact surface of the synthetic room and a plane."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera
from ldo_service.volumes import Mesh, Tsdf, TsdfConfig, Viewpoint, fuse

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
VIEWPOINT = Viewpoint(CAMERA, np.eye(4))
VOXEL_M = 0.02


def with_wall(tsdf: Tsdf, distance_m: float, color: float = 0.5) -> Tsdf:
    depth_m = np.full((48, 64), distance_m, np.float32)
    tsdf.integrate(depth_m, np.full((48, 64, 3), color, np.float32), VIEWPOINT)
    return tsdf


@pytest.fixture(scope="module")
def fused(mapped_room) -> Tsdf:
    return fuse(mapped_room.rows, mapped_room.viewpoints, TsdfConfig(VOXEL_M))


@pytest.fixture(scope="module")
def mesh(fused: Tsdf) -> Mesh:
    return fused.mesh()


def test_vertices_lie_on_the_true_surface(mesh: Mesh, p_true: np.ndarray) -> None:
    distance_m, _ = cKDTree(p_true).query(mesh.vertices_m)
    assert len(mesh.vertices_m) > 50_000
    assert np.median(distance_m) < 0.6 * VOXEL_M
    assert np.mean(distance_m < 2 * VOXEL_M) > 0.995
    assert distance_m.max() < 5 * VOXEL_M


def test_mesh_covers_the_observed_surface(mesh: Mesh, p_true: np.ndarray) -> None:
    distance_m, _ = cKDTree(mesh.vertices_m).query(p_true[::17])
    assert np.mean(distance_m < 2 * VOXEL_M) > 0.97


def test_triangles_face_the_free_side(mesh: Mesh, mapped_room) -> None:
    """Walls face the center of the room; furniture may have other normals."""
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.triangles].astype(float), 1, 0)
    normals = np.cross(b - a, c - a)
    center = np.mean([v.T_map_camera[:3, 3] for v in mapped_room.viewpoints], axis=0)
    faces_center = np.einsum("ni,ni->n", normals, center - a) > 0
    area = np.linalg.norm(normals, axis=1)
    assert area[faces_center].sum() > 0.95 * area.sum()


def test_memory_is_limited_to_blocks_near_the_surface(fused: Tsdf, mesh: Mesh) -> None:
    """A surface through blocks of 16 cm, with 8 cm on both sides, uses three blocks per face."""
    assert fused.memory_mb == pytest.approx(fused.blocks * 512 * 20 / 2**20)
    assert fused.blocks < 3 * mesh.area_m2 / 0.16**2


def test_wall_is_flat_at_its_depth() -> None:
    mesh = with_wall(Tsdf(), 1.503).mesh()
    np.testing.assert_allclose(mesh.vertices_m[:, 2], 1.503, atol=1e-5)
    expected_m2 = (1.503 / 60) ** 2 * 64 * 48
    assert mesh.area_m2 == pytest.approx(expected_m2, rel=0.05)


def test_views_are_averaged_by_pixel_density() -> None:
    tsdf = with_wall(with_wall(Tsdf(), 1.500, color=0.2), 1.510, color=0.8)
    mesh = tsdf.mesh()
    np.testing.assert_allclose(mesh.vertices_m[:, 2], 1.505, atol=1e-4)
    np.testing.assert_allclose(mesh.colors, 255 * 0.5, atol=2)


def test_order_of_views_does_not_change_the_mesh(mapped_room) -> None:
    config = TsdfConfig(0.05)
    forward, backward = (
        fuse(mapped_room.rows, views, config).mesh()
        for views in (mapped_room.viewpoints[:3], mapped_room.viewpoints[2::-1])
    )
    assert len(forward.triangles) == len(backward.triangles)
    distance_m, _ = cKDTree(backward.vertices_m).query(forward.vertices_m)
    assert distance_m.max() < 1e-5


def test_memory_limit_raises_and_keeps_the_fused_blocks() -> None:
    tsdf = with_wall(Tsdf(TsdfConfig(max_memory_mb=2)), 0.5)
    before = tsdf.blocks
    with pytest.raises(ConfigError, match="larger voxels"):
        with_wall(tsdf, 4.0)
    assert tsdf.blocks == before
    assert tsdf.memory_mb <= 2


def test_missing_depth_gives_an_empty_mesh() -> None:
    mesh = with_wall(Tsdf(), 0.0).mesh()
    assert mesh.vertices_m.shape == (0, 3)
    assert mesh.triangles.shape == (0, 3)


@pytest.mark.parametrize(
    "change", [{"voxel_m": 0.0}, {"voxel_m": np.nan}, {"truncation_voxels": 0.5}], ids=str
)
def test_invalid_settings_raise_config_error(change: dict) -> None:
    with pytest.raises(ConfigError):
        replace(TsdfConfig(), **change)
