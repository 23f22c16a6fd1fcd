"""Occupancy grid against the solids of the synthetic room and walls at known positions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Camera, se3
from ldo_service.synthetic.room import furnished_room
from ldo_service.synthetic.solids import vector
from ldo_service.volumes import OccupancyConfig, OccupancyGrid, Viewpoint, occupancy
from ldo_service.volumes.occupancy import FREE, OCCUPIED, UNKNOWN, occupied_voxels

VOXEL_M = 0.1


@pytest.fixture(scope="module")
def grid(mapped_room) -> OccupancyGrid:
    return occupancy(mapped_room.rows, mapped_room.viewpoints, OccupancyConfig(VOXEL_M))


def centers(grid: OccupancyGrid, state: int) -> np.ndarray:
    """Return the centers [V, 3] of the voxels in a state."""
    return grid.origin_m + grid.voxel_m * (np.argwhere(grid.states == state) + 0.5)


def state_at(grid: OccupancyGrid, p_map: tuple[float, float, float]) -> int:
    return int(grid.states[tuple(np.floor((p_map - grid.origin_m) / grid.voxel_m).astype(int))])


def disc(mean: tuple[float, float, float], sigma_m: float, opacity_logit: float = 4.0):
    """Return a flat Gaussian that faces the camera."""
    row = np.zeros(16, np.float32)
    row[:3], row[3:6], row[6] = mean, np.log([sigma_m, sigma_m, sigma_m / 100]), 1
    row[10] = opacity_logit
    return row


def test_occupied_voxels_contain_a_surface(grid: OccupancyGrid, p_true: np.ndarray) -> None:
    distance_m, _ = cKDTree(p_true).query(centers(grid, OCCUPIED))
    half_diagonal_m = np.sqrt(3) / 2 * VOXEL_M  # Half diagonal of a voxel.
    assert np.mean(distance_m < half_diagonal_m) > 0.98
    assert distance_m.max() < 2 * half_diagonal_m


def test_true_surface_is_occupied(grid: OccupancyGrid, p_true: np.ndarray) -> None:
    """A voxel may contain too little of the surface; its neighbor then contains more."""
    distance_m, _ = cKDTree(centers(grid, OCCUPIED)).query(p_true[::17])
    assert np.mean(distance_m < 1.2 * VOXEL_M) > 0.98


def test_free_voxels_lie_in_the_room_outside_of_solids(grid: OccupancyGrid) -> None:
    free, room = centers(grid, FREE), furnished_room(0)
    assert len(free) > 10_000
    local = np.stack(room.shell.point_to_local(vector(free.T)))
    half_m = np.array(room.shell.size_m)[:, None] / 2
    assert ((np.abs(local) - 1) * half_m).max() < VOXEL_M / 2
    for solid in room.furniture:
        if solid.shape == "box":
            local = np.stack(solid.point_to_local(vector(free.T)))
            depth_m = ((1 - np.abs(local)) * np.array(solid.size_m)[:, None] / 2).min(axis=0)
            assert depth_m.max() < VOXEL_M / 2, solid


def test_free_voxels_were_observed_as_free(
    grid: OccupancyGrid, mapped_room, room: Sequence
) -> None:
    """Compared with the true depth of the frames. Camera positions are free without depth."""
    free = centers(grid, FREE)
    seen = np.zeros(len(free), bool)
    for viewpoint, index in zip(mapped_room.viewpoints, mapped_room.frames, strict=True):
        p_camera = se3.transform(se3.inverse(viewpoint.T_map_camera), free)
        column, row = np.rint(room.camera.project(p_camera)).astype(int).T
        within = (p_camera[:, 2] > 0) & (column >= 0) & (column < 320) & (row >= 0) & (row < 240)
        depth_m = room[index].depth_m[np.where(within, row, 0), np.where(within, column, 0)]
        seen |= within & (p_camera[:, 2] < depth_m)
    assert np.count_nonzero(~seen) <= len(mapped_room.viewpoints)


def test_camera_positions_are_free(grid: OccupancyGrid, mapped_room) -> None:
    for viewpoint in mapped_room.viewpoints:
        assert state_at(grid, viewpoint.T_map_camera[:3, 3]) == FREE


def test_space_behind_a_wall_is_unknown() -> None:
    camera = Viewpoint(Camera(64, 48, 60.0, 60.0, 31.5, 23.5), np.eye(4))
    wall = np.stack(
        [disc((x, y, 2.05), 0.05) for x in np.arange(-2, 2, 0.1) for y in np.arange(-1, 1, 0.1)]
    )
    lamp = disc((0.05, 0.05, 4.05), 0.3)
    grid = occupancy(np.concatenate([wall, lamp[None]]), [camera])
    assert state_at(grid, (0.05, 0.05, 1.0)) == FREE
    assert state_at(grid, (0.05, 0.05, 2.05)) == OCCUPIED
    assert state_at(grid, (0.05, 0.05, 3.0)) == UNKNOWN
    assert state_at(grid, (0.05, 0.05, 4.05)) == OCCUPIED  # Part of the map although hidden.
    assert state_at(grid, (1.85, 0.05, 0.2)) == UNKNOWN  # Outside of the view.


def test_large_gaussian_occupies_its_extent() -> None:
    """Voxels of high density are occupied, and none beyond three sigmas."""
    row = disc((0.05, 0.05, 0.05), sigma_m=0.5)
    voxels = occupied_voxels(row[None], OccupancyConfig())
    assert set(voxels[:, 2]) == {0}
    is_occupied = np.zeros((61, 61), bool)
    is_occupied[tuple(voxels[:, :2].T + 30)] = True
    radius_m = 0.1 * np.hypot(*np.mgrid[-30:31, -30:31])
    assert is_occupied[radius_m < 0.6].all()
    assert not is_occupied[radius_m > 1.5].any()


def test_small_and_transparent_gaussians_occupy_nothing() -> None:
    small, glass = disc((0.05, 0.05, 0.05), 0.005), disc((0.05, 0.05, 0.05), 0.05, -1.0)
    assert len(occupied_voxels(np.stack([small, glass]), OccupancyConfig())) == 0


def test_file_contains_origin_voxel_size_and_states(grid: OccupancyGrid, tmp_path: Path) -> None:
    grid.save(tmp_path / "grid")
    read = np.load(tmp_path / "grid")
    np.testing.assert_array_equal(read["states"], grid.states)
    np.testing.assert_array_equal(read["origin_m"], grid.origin_m)
    assert read["voxel_m"] == VOXEL_M


def test_empty_map_raises() -> None:
    with pytest.raises(DataError, match="no opaque surface"):
        occupancy(np.zeros((0, 16), np.float32), [])


def test_too_large_grid_raises_with_advice() -> None:
    distant = np.stack([disc((x, 0.0, 0.0), 0.05) for x in (0.0, 5000.0)])
    with pytest.raises(ConfigError, match="larger voxels"):
        occupancy(distant, [], replace(OccupancyConfig(), max_voxels=100_000))
