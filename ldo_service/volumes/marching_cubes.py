"""Marching cubes: the surface where a function on a grid changes its sign.

scikit-image computes the surface block by block. Its tables (Lorensen and Cline) resolve an
ambiguous cell face by the corners of that face alone. Therefore the triangles of neighboring cells
and blocks fit together.

Lorensen and Cline, Marching cubes, 1987.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from skimage import measure

from ldo_service.errors import ConfigError

STEPS = np.array([1 << 40, 1 << 20, 1])  # Change of a packed triple (`pack`) per step on each axis.


@dataclass(frozen=True, eq=False, slots=True)
class LatticeBlock:
    """Block of S x S x S grid cells, with the function values at the cell corners.

    Attributes:
        origin: Grid coordinates of the lower corner, [3] integers.
        values: Function values, [S + 1, S + 1, S + 1] float32, finite. Neighboring blocks must have
            equal values at common corners.
        attributes: C further values at each corner, such as colors, [S + 1, S + 1, S + 1, C].
        is_used: Cells to process, [S, S, S] bool. At least one of these cells must contain the
            surface: one of its corners has a value < 0, and another one a value >= 0.
    """

    origin: np.ndarray
    values: np.ndarray
    attributes: np.ndarray
    is_used: np.ndarray


@dataclass(frozen=True, slots=True)
class Surface:
    """Triangles of a surface, in grid coordinates.

    Attributes:
        points: Corners of the triangles, [V, 3].
        attributes: Interpolated attributes of the points, [V, C].
        triangles: Indices of points, [M, 3]; counterclockwise when seen from the side where the
            function is positive.
    """

    points: np.ndarray
    attributes: np.ndarray
    triangles: np.ndarray


def marching_cubes(blocks: Iterable[LatticeBlock], attributes: int) -> Surface:
    """Return the surface where a function on a grid is zero.

    Values are interpolated linearly along the edges of grid cells.

    Args:
        blocks: Blocks of the grid.
        attributes: Number C of attributes, for the shape of the result if there are no blocks.
    """
    points, values, triangles = [np.zeros((0, 3))], [np.zeros((0, attributes))], []
    count = 0
    for block in blocks:
        # scikit-image reads the mask of a cell at the upper corner of the cell. On an ambiguous
        # face, it separates the corners with values above 0. Values are negated here, so these are
        # the corners inside the surface.
        mask = np.pad(block.is_used, ((1, 0),) * 3)
        here, faces, _, _ = measure.marching_cubes(
            -block.values, 0.0, mask=mask, method="lorensen", gradient_direction="ascent"
        )
        triangles.append(faces + count)
        count += len(here)
        points.append(block.origin + here.astype(float))
        values.append(_interpolated(block.attributes, here))
    # A point on a shared face is bitwise equal in all blocks, because it depends on its edge alone.
    merged, first, index = np.unique(
        np.concatenate(points), axis=0, return_index=True, return_inverse=True
    )
    corners = index.reshape(-1)[np.concatenate([np.zeros((0, 3), np.int64), *triangles])]
    has_area = np.all(corners != np.roll(corners, 1, axis=1), axis=1)
    return Surface(merged, np.concatenate(values)[first], corners[has_area])


def _interpolated(attributes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Interpolate attributes at points on edges of grid cells.

    Args:
        attributes: Values at the grid points, [S + 1, S + 1, S + 1, C].
        points: Points in grid coordinates of the block, [V, 3].

    Returns:
        [V, C].
    """
    lower = np.floor(points).astype(int)
    upper = np.ceil(points).astype(int)
    share = (points - lower).sum(axis=1)[:, None]
    return (1 - share) * attributes[tuple(lower.T)] + share * attributes[tuple(upper.T)]


def pack(lattice: np.ndarray) -> np.ndarray:
    """Pack integer triples [..., 3] into int64 below 2^60; lexicographic order is preserved.

    Raises:
        ConfigError: The absolute value of a coordinate is 2^19 or more. With voxels of 2 cm, this
            is 10 km from the origin.
    """
    if len(lattice) and max(lattice.max(), -lattice.min()) >= 1 << 19:
        raise ConfigError(
            "the map extends 524,288 voxels or more from its origin. Choose larger voxels with "
            "--voxel."
        )
    return lattice.astype(np.int64) @ STEPS + (1 << 19) * STEPS.sum()


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangle mesh in the map frame.

    Attributes:
        vertices_m: Positions of the vertices, [V, 3] float32, meters.
        colors: RGB of the vertices, [V, 3] uint8.
        triangles: Indices of vertices, [M, 3] int32; counterclockwise when seen from free space.
    """

    vertices_m: np.ndarray
    colors: np.ndarray
    triangles: np.ndarray

    @property
    def area_m2(self) -> float:
        """Total area of the triangles."""
        a, b, c = np.moveaxis(self.vertices_m[self.triangles].astype(float), 1, 0)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary PLY: elements `vertex` (x y z red green blue) and `face`."""
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
