"""Tests of the splats for the browser and of the choice of Gaussians to draw."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ldo_service.gaussians.file_formats import read_ply
from ldo_service.gaussians.pruning import weightiest, weights
from ldo_service.runs.finished import read_viewpoints
from ldo_service.viewer.scene import splats_of
from tests.maps.streams import random_rows


def test_splat_covariances_equal_those_by_scipy_rotations() -> None:
    rows = random_rows(np.random.default_rng(1), 100)
    splats = splats_of(rows)
    R = Rotation.from_quat(rows[:, [7, 8, 9, 6]]).as_matrix()
    S2 = np.exp(2 * rows[:, 3:6])[:, None, :] * np.eye(3)
    np.testing.assert_allclose(splats.covariances, R @ S2 @ R.transpose(0, 2, 1), rtol=1e-4)
    np.testing.assert_allclose(splats.opacities[:, 0], 1 / (1 + np.exp(-rows[:, 10])), rtol=1e-5)
    np.testing.assert_array_equal(splats.centers, rows[:, 0:3])


def test_splat_colors_are_clipped() -> None:
    rows = random_rows(np.random.default_rng(1), 2)
    rows[:, 11:14] = [[-0.5, 0.5, 1.5], [0.0, 1.0, 0.25]]
    np.testing.assert_array_equal(splats_of(rows).colors, [[0, 0.5, 1], [0, 1, 0.25]])


def test_empty_map_has_no_splats() -> None:
    splats = splats_of(random_rows(np.random.default_rng(1), 0))
    assert splats.covariances.shape == (0, 3, 3)
    assert splats.opacities.shape == (0, 1)


def test_weight_is_opacity_times_the_two_largest_scales() -> None:
    rows = random_rows(np.random.default_rng(1), 2)
    rows[:, 10] = 0.0  # Opacity 0.5.
    rows[0, 3:6] = np.log([0.5, 0.001, 0.2])
    rows[1, 3:6] = np.log([0.001, 0.1, 0.1])
    np.testing.assert_allclose(weights(rows), [0.5 * 0.1, 0.5 * 0.01], rtol=1e-5)


def test_weightiest_selects_the_exact_count_among_equal_weights() -> None:
    rows = np.repeat(random_rows(np.random.default_rng(1), 1), 10, axis=0)
    assert weightiest(rows, 4).sum() == 4
    assert weightiest(rows, 10).all()
    assert weightiest(rows, 11).all()


def test_weightiest_half_renders_closer_to_the_map_than_a_random_half(finished_run: Path) -> None:
    """The error is the difference of the rendered image from that of all Gaussians."""
    rows = read_ply(finished_run / "map.ply")
    viewpoint = next(iter(read_viewpoints(finished_run).values()))
    chosen = weightiest(rows, len(rows) // 2)
    at_random = np.random.default_rng(0).permutation(chosen)
    image_of_all, image_of_chosen, image_of_random = (
        viewpoint.render(np.ascontiguousarray(part)).color
        for part in (rows, rows[chosen], rows[at_random])
    )
    assert (
        np.abs(image_of_chosen - image_of_all).mean()
        < 0.5 * np.abs(image_of_random - image_of_all).mean()
    )
