"""Judge: what map_server makes of a pixel, from its documentation."""

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
    """5 x 10 x 7 voxels of 0.1 m about the origin: free, one voxel occupied, one column unknown."""
    states = np.full((5, 10, 7), FREE, np.uint8)
    states[4, 5, 6] = OCCUPIED
    states[0, :, 0] = UNKNOWN
    return OccupancyGrid(np.array([-0.2, -0.5, -0.3]), 0.1, states)


def served(path: Path) -> tuple[dict, np.ndarray]:
    """The facts, and the grid [row, column] from the lower left: 100 occupied, 0 free, -1 unknown.

    http://wiki.ros.org/map_server, trinary interpretation.
    """
    facts = yaml.safe_load(path.read_text())
    picture = cv2.imread(str(path.parent / facts["image"]), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint8
    assert facts["negate"] == 0
    p = (255 - picture[::-1].astype(float)) / 255
    occupied, free = p > facts["occupied_thresh"], p < facts["free_thresh"]
    return facts, np.where(occupied, 100, np.where(free, 0, -1))


def test_map_server_finds_each_cell_where_it_is(grid: OccupancyGrid, tmp_path: Path) -> None:
    plan = floor_plan(grid, "-y", (-0.5, 0.5))
    write_floor_plan(tmp_path / "plan.yaml", plan)
    facts, cells = served(tmp_path / "plan.yaml")
    assert facts["image"] == "plan.pgm"
    assert facts["resolution"] == 0.1
    np.testing.assert_allclose(facts["origin"], [-0.2, -0.3, 0])  # x and z of the map
    expected = np.zeros((7, 5))  # rows along z
    expected[6, 4], expected[0, 0] = 100, -1
    np.testing.assert_array_equal(cells, expected)


def test_only_heights_in_the_band_count(grid: OccupancyGrid) -> None:
    """The occupied voxel is at y = 0.05, half a voxel below the first camera."""
    assert (floor_plan(grid, "-y", (-0.1, 0.0)).states == OCCUPIED).sum() == 1
    assert (floor_plan(grid, "-y", (0.0, 0.5)).states == OCCUPIED).sum() == 0
    assert (floor_plan(grid, "y", (0.0, 0.5)).states == OCCUPIED).sum() == 1


@pytest.mark.parametrize("up", list(UP))
def test_x_y_and_up_are_right_handed(grid: OccupancyGrid, up: str) -> None:
    plan = floor_plan(grid, up, (-1, 1))
    axes = dict(zip("xyz", np.eye(3), strict=True))
    sign = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(np.cross(axes[plan.x], axes[plan.y]), sign * axes[up[-1]])
    side = dict(zip("xyz", grid.states.shape, strict=True))
    assert plan.states.shape == (side[plan.x], side[plan.y])


def test_a_band_beside_the_map_is_said(grid: OccupancyGrid) -> None:
    with pytest.raises(ConfigError, match=r"from -0\.45 to 0\.45 m along -y"):
        floor_plan(grid, "-y", (3, 4))


def test_an_axis_that_is_none_is_said(grid: OccupancyGrid) -> None:
    with pytest.raises(ConfigError, match="not one of x, y, z"):
        floor_plan(grid, "w")
