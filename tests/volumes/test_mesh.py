from pathlib import Path

import numpy as np
import pytest

from ldo_service.volumes import Mesh, write_mesh

TETRAHEDRON = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32),
    np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 20, 30]], np.uint8),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
)


def test_trimesh_reads_vertices_colors_and_triangles(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh")
    write_mesh(tmp_path / "mesh.ply", TETRAHEDRON)
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(read.vertices, TETRAHEDRON.vertices_m)
    np.testing.assert_array_equal(read.faces, TETRAHEDRON.triangles)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], TETRAHEDRON.colors)
    assert read.volume == pytest.approx(1.0)
    assert read.area == pytest.approx(TETRAHEDRON.area_m2)


def test_file_is_a_binary_little_endian_ply(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile", reason="pip install plyfile")
    write_mesh(tmp_path / "mesh.ply", TETRAHEDRON)
    read = plyfile.PlyData.read(str(tmp_path / "mesh.ply"))
    assert (read.text, read.byte_order) == (False, "<")
    np.testing.assert_array_equal(read["vertex"]["blue"], TETRAHEDRON.colors[:, 2])
    np.testing.assert_array_equal(np.stack(read["face"]["vertex_indices"]), TETRAHEDRON.triangles)
