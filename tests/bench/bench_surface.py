"""Accuracy and completeness of the mesh of a run, measured against the true surface.

    python -m tests.bench.bench_surface RUN SOURCE [--voxel M] [--every N]

RUN is the folder of a finished `ldo run` on SOURCE. SOURCE must have exact depth and true poses,
such as `synthetic:flat-exact` or a sequence of Replica. The mesh is that of `ldo export --format
mesh`. The true surface consists of the points of all depth images, at the true poses. The map is
aligned to it by the ATE alignment of the trajectory.

- accuracy: distance from points on the mesh to the true surface.
- completeness: distance from points of the true surface to the mesh.

The distance to a surface is the distance to its nearest sample: along the normal of the sample, and
along the surface as far as it exceeds the diagonal of the cells that have one sample each. Sampling
therefore adds no error on a flat surface.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ldo_service.datasets import open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import RgbdFrame, Trajectory, se3
from ldo_service.geometry.sequence import Sequence
from ldo_service.runs.finished import newest_map
from ldo_service.volumes import Mesh
from ldo_service.volumes.tsdf import TsdfConfig, fuse

SPACING_M = 0.01  # Side of the cells that keep one sample each.
MAX_QUERIES = 200_000  # Points whose distances are averaged, as usual in the field.
# Neighbor pixels whose depths differ by more than this fraction lie on different surfaces. A floor
# that is seen at 6 degrees differs by 3 % between two pixels of a camera with 300 px focal length.
EDGE = 0.03
LIMITS_M = (0.01, 0.05)  # Limits of the printed shares of near points.


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Samples of a surface: points and unit normals, [N, 3] each."""

    points_m: np.ndarray
    normals: np.ndarray

    def thinned(self, spacing_m: float = SPACING_M) -> "Samples":
        """Return the first sample of each cubic cell of a grid."""
        cells = np.floor(self.points_m / spacing_m).astype(np.int64)
        cells -= cells.min(axis=0)
        _, first = np.unique(np.ravel_multi_index(cells.T, cells.max(axis=0) + 1), True)
        return Samples(self.points_m[first], self.normals[first])

    @staticmethod
    def joined(parts: list["Samples"]) -> "Samples":
        """Return the samples of several parts as one."""
        return Samples(
            np.concatenate([part.points_m for part in parts]),
            np.concatenate([part.normals for part in parts]),
        )


def samples_of_mesh(mesh: Mesh, rng: np.random.Generator) -> Samples:
    """Return points on a mesh, several per cell, uniform over its area."""
    corners = mesh.vertices_m[mesh.triangles].astype(float)  # [T, 3, 3].
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1) / 2
    chosen = rng.choice(len(areas), int(4 * areas.sum() / SPACING_M**2), p=areas / areas.sum())
    u, v = rng.random((2, len(chosen), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = np.moveaxis(corners[chosen], 1, 0)
    return Samples(a + u * (b - a) + v * (c - a), crosses[chosen] / (2 * areas[chosen, None]))


def samples_of_frame(frame: RgbdFrame, T_world_camera: np.ndarray) -> Samples:
    """Return the measured points of a frame in the world; pixels at depth edges have none."""
    depth_m = frame.depth_m.astype(float)
    rows, columns = np.indices(depth_m.shape)
    camera = frame.camera
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], -1)
    points = np.concatenate([rays * depth_m[..., None], depth_m[..., None]], -1)
    along_u = points[1:-1, 2:] - points[1:-1, :-2]
    along_v = points[2:, 1:-1] - points[:-2, 1:-1]
    normals = np.cross(along_u, along_v)
    lengths = np.linalg.norm(normals, axis=-1)
    middle = depth_m[1:-1, 1:-1]
    steps = np.maximum(abs(along_u[..., 2]), abs(along_v[..., 2]))
    around = [depth_m[1:-1, 2:], depth_m[1:-1, :-2], depth_m[2:, 1:-1], depth_m[:-2, 1:-1]]
    is_valid = (np.min([middle, *around], axis=0) > 0) & (steps < 2 * EDGE * middle) & (lengths > 0)
    normals = normals[is_valid] / lengths[is_valid][:, None]
    return Samples(
        se3.transform(T_world_camera, points[1:-1, 1:-1][is_valid]),
        normals @ T_world_camera[:3, :3].T,
    )


def true_surface(sequence: Sequence, truth: Trajectory, every: int, until_s: float) -> Samples:
    """Return samples of the surface that the depth images of a sequence show.

    Args:
        sequence: A sequence with exact depth.
        truth: The true poses at the stamps of its frames.
        every: Use every n-th frame.
        until_s: Stamp of the last frame of the run, seconds.
    """
    surface: list[Samples] = []
    used = int(np.searchsorted(sequence.stamps_ns, until_s * 1e9 + 1e3))
    for index in range(0, used, every):
        frame = sequence[index]
        nearest = int(np.argmin(abs(truth.stamps_s - frame.stamp_ns / 1e9)))
        part = samples_of_frame(frame, truth.T_world_camera[nearest])
        surface = [Samples.joined([*surface, part.thinned()]).thinned()]
    return surface[0]


def distances_m(points_m: np.ndarray, surface: Samples) -> np.ndarray:
    """Return the distance [N] of points [N, 3] to a surface, as the module docstring defines it."""
    _, nearest = KDTree(surface.points_m).query(points_m, workers=-1)
    offsets = points_m - surface.points_m[nearest]
    along_normal = abs(np.einsum("ni,ni->n", offsets, surface.normals[nearest]))
    along_surface = np.sqrt(np.maximum((offsets**2).sum(axis=1) - along_normal**2, 0))
    return np.hypot(along_normal, np.maximum(along_surface - np.sqrt(3) * SPACING_M, 0))


def chosen_points(samples: Samples, rng: np.random.Generator) -> np.ndarray:
    """Return at most `MAX_QUERIES` of the points."""
    points = samples.points_m
    return points[rng.permutation(len(points))[:MAX_QUERIES]]


def summary(errors_m: np.ndarray) -> str:
    """Return mean, median and the shares below `LIMITS_M` as text."""
    shares = ", ".join(
        f"{(errors_m < limit).mean():.1%} < {100 * limit:g} cm" for limit in LIMITS_M
    )
    mean, median = 100 * errors_m.mean(), 100 * np.median(errors_m)
    return f"mean {mean:.2f} cm, median {median:.2f} cm, {shares}"


def main() -> None:
    """Print accuracy and completeness of the mesh of a run."""
    parser = argparse.ArgumentParser(
        description="Measure the mesh of a run against the true surface."
    )
    parser.add_argument("run", type=Path, help="folder of a finished `ldo run`")
    parser.add_argument("source", help="the source of the run")
    parser.add_argument("--voxel", type=float, default=0.02, help="side of a voxel, meters")
    parser.add_argument("--every", type=int, default=5, help="use every n-th true depth image")
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.source)
    source = newest_map(arguments.run)
    truth = sequence.truth()
    if truth is None:
        parser.error(f"{arguments.source} has no true poses. Give a source with exact truth.")
    trajectory = source.trajectory()
    T_truth_map = evaluate_trajectory(trajectory, truth).T_truth_estimate
    mesh = fuse(
        source.gaussians(), source.viewpoints(), TsdfConfig(arguments.voxel), threads=2
    ).mesh()
    rng = np.random.default_rng(0)
    mapped = samples_of_mesh(mesh, rng)
    mapped = Samples(
        se3.transform(T_truth_map, mapped.points_m), mapped.normals @ T_truth_map[:3, :3].T
    )
    true = true_surface(sequence, truth, arguments.every, trajectory.stamps_s[-1])
    print(f"mesh: {mesh.area_m2:.1f} m2; true surface: {len(true.points_m):,} samples")
    print("accuracy:", summary(distances_m(chosen_points(mapped, rng), true)))
    print("completeness:", summary(distances_m(chosen_points(true, rng), mapped.thinned())))


if __name__ == "__main__":
    main()
