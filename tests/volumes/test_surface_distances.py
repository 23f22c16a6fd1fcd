"""Distances between surfaces, as `bench_surface` measures them, on shapes with known answers."""

import numpy as np
import pytest

from ldo_service.geometry import Camera, RgbdFrame
from ldo_service.volumes import Mesh
from tests.bench.bench_surface import Samples, distances_m, samples_of_frame, samples_of_mesh

CAMERA = Camera(80, 60, 60.0, 60.0, 40.0, 30.0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def square(side_m: float, z_m: float) -> Mesh:
    corners = np.array([[0, 0, z_m], [1, 0, z_m], [1, 1, z_m], [0, 1, z_m]]) * [side_m, side_m, 1]
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh(corners.astype(np.float32), np.zeros((4, 3), np.uint8), triangles)


def test_points_of_a_mesh_cover_its_area_evenly(rng: np.random.Generator) -> None:
    samples = samples_of_mesh(square(0.5, 2.0), rng)
    counts, _, _ = np.histogram2d(*samples.points_m[:, :2].T, bins=5, range=[(0, 0.5)] * 2)
    assert counts.min() > 0.7 * counts.mean()
    assert samples.normals == pytest.approx(np.tile([0, 0, 1.0], (len(samples.normals), 1)))


def test_distance_to_a_plane_is_exact_between_samples(rng: np.random.Generator) -> None:
    plane = samples_of_mesh(square(0.5, 2.0), rng).thinned()
    points = np.column_stack([rng.uniform(0.05, 0.45, (200, 2)), np.full(200, 2.003)])
    assert distances_m(points, plane) == pytest.approx(np.full(200, 0.003), abs=1e-9)


def test_distance_beyond_the_end_of_a_surface_counts(rng: np.random.Generator) -> None:
    plane = samples_of_mesh(square(0.5, 2.0), rng).thinned()
    (distance_m,) = distances_m(np.array([[0.6, 0.25, 2.0]]), plane)
    assert distance_m == pytest.approx(0.1 - 0.017, abs=0.01)


def test_points_of_a_frame_lie_on_the_wall_and_not_on_its_edge() -> None:
    depth_m = np.full((60, 80), 2.0, np.float32)
    depth_m[:, 40:] = 3.0
    depth_m[0, 0] = 0.0
    frame = RgbdFrame(np.zeros((60, 80, 3), np.uint8), depth_m, CAMERA)
    T_world_camera = np.eye(4)
    T_world_camera[2, 3] = 1.0
    samples = samples_of_frame(frame, T_world_camera)
    assert set(samples.points_m[:, 2].round(6)) == {3.0, 4.0}
    assert abs(samples.normals[:, 2]) == pytest.approx(np.ones(len(samples.normals)))
    columns = samples.points_m[:, 0] / (samples.points_m[:, 2] - 1) * CAMERA.fx + CAMERA.cx
    assert not np.any((columns > 38.5) & (columns < 40.5)), "the pixels beside the edge are kept"


def test_thinning_keeps_one_sample_per_cell() -> None:
    points = np.array([[0.001, 0, 0], [0.002, 0, 0], [0.013, 0, 0]])
    thinned = Samples(points, np.tile([0, 0, 1.0], (3, 1))).thinned(0.01)
    assert thinned.points_m[:, 0] == pytest.approx([0.001, 0.013])
