"""Floor plan, read as in the documentation of map_server."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ldo_service.errors import ConfigError
from ldo_service.volumes import OccupancyGrid, floor_plan, write_floor_plan
from ldo_service.volumes.occupancy import FREE, OCCUPIED, UNKNOWN, UP


@pytest.fixture
def grid() -> OccupancyGrid:
    """Return 5 x 10 x 7 free voxels of 0.1 m with one occupied voxel and one unknown column."""
    states = np.full((5, 10, 7), FREE, np.uint8)
    states[4, 5, 6] = OCCUPIED
    states[0, :, 0] = UNKNOWN
    return OccupancyGrid(np.array([-0.2, -0.5, -0.3]), 0.1, states)


def read_as_map_server(path: Path) -> tuple[dict, np.ndarray]:
    """Return the metadata and the grid [row, column] from the lower left.

    A cell is 100 if occupied, 0 if free and -1 if unknown: the trinary interpretation of
    http://wiki.ros.org/map_server.
    """
    metadata = yaml.safe_load(path.read_text())
    image = cv2.imread(str(path.parent / metadata["image"]), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint8
    assert metadata["negate"] == 0
    p = (255 - image[::-1].astype(float)) / 255
    occupied, free = p > metadata["occupied_thresh"], p < metadata["free_thresh"]
    return metadata, np.where(occupied, 100, np.where(free, 0, -1))


def test_map_server_reads_each_cell_at_its_position(grid: OccupancyGrid, tmp_path: Path) -> None:
    plan = floor_plan(grid, "-y", (-0.5, 0.5))
    write_floor_plan(tmp_path / "plan.yaml", plan)
    metadata, cells = read_as_map_server(tmp_path / "plan.yaml")
    assert metadata["image"] == "plan.pgm"
    assert metadata["resolution"] == 0.1
    np.testing.assert_allclose(metadata["origin"], [-0.2, -0.3, 0])  # X and z of the map.
    expected = np.zeros((7, 5))  # Rows along z.
    expected[6, 4], expected[0, 0] = 100, -1
    np.testing.assert_array_equal(cells, expected)


def test_only_heights_in_the_band_are_projected(grid: OccupancyGrid) -> None:
    """The occupied voxel is at y = 0.05 m, half a voxel below the first camera."""
    assert (floor_plan(grid, "-y", (-0.1, 0.0)).states == OCCUPIED).sum() == 1
    assert (floor_plan(grid, "-y", (0.0, 0.5)).states == OCCUPIED).sum() == 0
    assert (floor_plan(grid, "y", (0.0, 0.5)).states == OCCUPIED).sum() == 1


@pytest.mark.parametrize("up", list(UP))
def test_axes_of_the_plan_are_right_handed(grid: OccupancyGrid, up: str) -> None:
    plan = floor_plan(grid, up, (-1, 1))
    axes = dict(zip("xyz", np.eye(3), strict=True))
    sign = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(np.cross(axes[plan.x], axes[plan.y]), sign * axes[up[-1]])
    sides = dict(zip("xyz", grid.states.shape, strict=True))
    assert plan.states.shape == (sides[plan.x], sides[plan.y])


def test_band_outside_the_map_raises_with_its_range(grid: OccupancyGrid) -> None:
    with pytest.raises(ConfigError, match=r"from -0\.45 to 0\.45 m along -y"):
        floor_plan(grid, "-y", (3, 4))


def test_invalid_up_axis_raises(grid: OccupancyGrid) -> None:
    with pytest.raises(ConfigError, match="must be one of x, y, z"):
        floor_plan(grid, "w")
