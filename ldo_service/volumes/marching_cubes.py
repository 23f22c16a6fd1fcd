"""Marching cubes: the surface where a function on a lattice changes its sign.

The table of the 256 cases is derived here, from one rule for each face of a cell: every run of
corners within is cut off by a segment of its own. The rule looks at the corners of the face alone,
so the cells on both sides of it agree, also where it is ambiguous, and the surface has no cracks.

Lorensen and Cline, Marching cubes, 1987; Montani et al., A modified look-up table, 1994.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from ldo_service.errors import ConfigError

CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])  # c = x + 2 y + 4 z
EDGES = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]  # lower corner, upper
STEPS = np.array([1 << 40, 1 << 20, 1])  # of a packed triple along each axis
# Of an edge of the lattice: its lower corner, packed, times four, and its axis.
EDGE_KEYS = [4 * (CORNERS[low] @ STEPS) + (high ^ low).bit_length() - 1 for low, high in EDGES]
# Corners of each face, counter-clockwise for who looks at it from outside the cell.
FACES = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))


@dataclass(frozen=True, slots=True)
class Surface:
    """points [V, 3] in lattice units; attributes [V, C] there; triangles [M, 3] indices of points,
    counter-clockwise for who looks from where the function is positive."""

    points: np.ndarray
    attributes: np.ndarray
    triangles: np.ndarray


def marching_cubes(cells: np.ndarray, values: np.ndarray, attributes: np.ndarray) -> Surface:
    """The surface value = 0 in some cells of a lattice, linear along their edges.

    cells       [A, 3] integers, lower corner of each cell
    values      [A, 8] at its corners x + 2 y + 4 z; finite, equal where cells share a corner
    attributes  [A, 8, C] there
    """
    case = (values < 0) @ (1 << np.arange(8))
    triangles = _TRIANGLES[case]  # [A, T, 3] edges, -1 where a case has fewer than T
    cell, which = np.nonzero(triangles[:, :, 0] >= 0)
    edge = triangles[cell, which].ravel()
    cell = np.repeat(cell, 3)
    # One point for each edge of the lattice, whichever cells it is met in.
    key = (4 * pack(cells))[cell] + np.array(EDGE_KEYS)[edge]
    _, first, point = np.unique(key, return_index=True, return_inverse=True)
    cell, (lower, upper) = cell[first], np.array(EDGES)[edge[first]].T
    a, b = values[cell, lower], values[cell, upper]
    share = (a / (a - b))[:, None]
    ends = cells[cell] + CORNERS[lower], cells[cell] + CORNERS[upper]
    return Surface(
        ends[0] + share * (ends[1] - ends[0]),
        (1 - share) * attributes[cell, lower] + share * attributes[cell, upper],
        point.reshape(-1, 3),
    )


def pack(lattice: np.ndarray) -> np.ndarray:
    """One int64 [...] for each integer triple [..., 3], in the same order; below 2^60.

    Raises ConfigError for what lies 2^19 or more from the origin: 10 km of voxels of 2 cm.
    """
    if len(lattice) and max(lattice.max(), -lattice.min()) >= 1 << 19:
        raise ConfigError("the map reaches further than 524,288 voxels: choose larger voxels.")
    return lattice.astype(np.int64) @ STEPS + (1 << 19) * STEPS.sum()


# --- the table ------------------------------------------------------------------------------------
def _table() -> np.ndarray:
    """Triangles [256, T, 3] of edge numbers for each set of corners that are within, then -1."""
    cases = [[t for loop in _loops(case) for t in _fan(loop)] for case in range(256)]
    table = np.full((256, max(map(len, cases)), 3), -1, np.int8)
    for case, triangles in enumerate(cases):
        table[case, : len(triangles)] = np.reshape(triangles, (-1, 3))
    return table


def _loops(case: int) -> Iterator[list[int]]:
    """Closed polygons of edge numbers: the segments of all faces, chained."""
    follower = {start: end for face in FACES for start, end in _segments(case, face)}
    while follower:
        start = next(iter(follower))
        loop = [start]
        while (edge := follower.pop(loop[-1])) != start:
            loop.append(edge)
        yield loop


def _segments(case: int, face: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    """From the edge where a walk around the face enters a run of corners within, to where it
    leaves it."""
    within = [bool(case >> corner & 1) for corner in face]
    for start in range(4):
        if within[start] and not within[start - 1]:
            stop = next(start + n for n in range(1, 4) if not within[(start + n) % 4])
            yield _edge(face, start - 1), _edge(face, stop - 1)


def _edge(face: tuple[int, ...], corner: int) -> int:
    """Number of the edge from a corner of a face to the next one."""
    a, b = face[corner % 4], face[(corner + 1) % 4]
    return EDGES.index((min(a, b), max(a, b)))


def _fan(loop: list[int]) -> Iterator[tuple[int, int, int]]:
    """Triangles of a polygon, about the point from which the fewest diagonals lie in a face: there
    the neighbouring cell could have the same one."""
    apex = min(range(len(loop)), key=lambda k: _diagonals_in_faces(loop[k:] + loop[:k]))
    first, *others = loop[apex:] + loop[:apex]
    for second, third in pairwise(others):
        yield first, second, third


def _diagonals_in_faces(loop: list[int]) -> int:
    return sum(frozenset((loop[0], other)) in _PAIRS_IN_FACES for other in loop[2:-1])


_PAIRS_IN_FACES = {
    frozenset(pair)
    for face in FACES
    for pair in combinations([_edge(face, corner) for corner in range(4)], 2)
}
_TRIANGLES = _table()


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
