"""Triangles, and the PLY file for them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True, slots=True)
class Mesh:
    """A surface in the map frame.

    vertices_m  [V, 3] float32
    colors      [V, 3] uint8 RGB
    triangles   [M, 3] int32, indices of vertices, counter-clockwise seen from the free side
    """

    vertices_m: np.ndarray
    colors: np.ndarray
    triangles: np.ndarray

    @property
    def area_m2(self) -> float:
        a, b, c = np.moveaxis(self.vertices_m[self.triangles].astype(float), 1, 0)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY with `vertex` (x y z red green blue) and `face` (vertex_indices)."""
    vertices = np.zeros(len(mesh.vertices_m), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = mesh.vertices_m, mesh.colors
    faces = np.zeros(len(mesh.triangles), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with path.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode())
        file.write(vertices.tobytes())
        file.write(faces.tobytes())
