import math

import numpy as np
import pytest

from tests.kernels.gpu.scenes import MAX_PAIRS, NAMES, SCENES, host, of_cpu, of_kernel
from tests.reference.render import project

LOG2_MIN_ALPHA = math.log2(1 / 255)


@pytest.mark.parametrize("name", NAMES)
def test_splats_equal_the_reference(name: str) -> None:
    scene, rendering = SCENES[name], of_kernel(name)
    visible = host(rendering.lists.visible)
    rasterizer, _ = of_cpu(scene)
    np.testing.assert_array_equal(visible, rasterizer.gradients(scene.by_planes()).indices)
    low_pass, box = scene.view[16:].astype(float)
    means, covariances, z = project(
        scene.drawable_rows(), scene.camera, scene.T_rounded, low_pass=low_pass
    )
    splats, inverse = host(rendering.splats.splats)[visible], np.linalg.inv(covariances[visible])
    conic = np.stack([inverse[:, 0, 0], 2 * inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    size = np.linalg.norm(conic, axis=1, keepdims=True)
    np.testing.assert_allclose(splats[:, 2:5] / size, conic / size * -0.5 / math.log(2), atol=2e-5)
    np.testing.assert_allclose(splats[:, :2], means[visible], rtol=3e-6, atol=3e-5)
    np.testing.assert_allclose(splats[:, 11], z[visible], rtol=1e-6)
    narrow = np.linalg.det(covariances[visible] - box * np.eye(2))
    lowered = np.log2(narrow / np.linalg.det(covariances[visible])) / 2
    log2_opacities = -np.log2(1 + np.exp(-scene.rows[visible, 10].astype(float)))
    np.testing.assert_allclose(splats[:, 5], log2_opacities + lowered, atol=4e-6)


@pytest.mark.parametrize("name", NAMES)
def test_pairs_are_sorted_by_tile_depth_and_row(name: str) -> None:
    scene, rendering = SCENES[name], of_kernel(name)
    lists, splats = rendering.lists, host(rendering.splats.splats)
    columns = -(-scene.camera.width // 16)
    ranges, pairs = host(rendering.splats.ranges), host(rendering.splats.pairs)
    wanted = sorted(
        (y * columns + x, splats[i, 11], i)
        for i in np.flatnonzero(pairs)
        for y in range(ranges[i, 1], ranges[i, 3] + 1)
        for x in range(ranges[i, 0], ranges[i, 2] + 1)
    )
    assert 0 < len(wanted) <= MAX_PAIRS
    listed, origins = host(lists.listed), host(lists.origins)
    np.testing.assert_array_equal(listed, [i for _, _, i in wanted])
    tiles = np.array([tile for tile, _, _ in wanted])
    starts = host(lists.starts)
    np.testing.assert_array_equal(starts, np.searchsorted(tiles, np.arange(len(starts))))
    # The pairs of a splat are contiguous in the order before the sort by tile.
    firsts = host(lists.firsts)[listed]
    assert sorted(origins) == list(range(len(origins)))
    assert ((origins >= firsts) & (origins < firsts + pairs[listed])).all()


@pytest.mark.parametrize("name", NAMES)
def test_reached_blocks_hold_each_pixel_that_counts(name: str) -> None:
    scene, rendering = SCENES[name], of_kernel(name)
    listed, reached = host(rendering.lists.listed), host(rendering.lists.reached)
    starts, columns = host(rendering.lists.starts), -(-scene.camera.width // 16)
    tiles = np.searchsorted(starts, np.arange(len(listed)), side="right") - 1
    u, v, a, b, c, log2_opacity = host(rendering.splats.splats)[listed].astype(float).T[:6, :, None]
    for block in range(16):
        x0, y0 = tiles % columns * 16 + block % 4 * 4, tiles // columns * 16 + block // 4 * 4
        fine_y, fine_x = np.mgrid[0:3:61j, 0:3:61j].reshape(2, -1)
        dx, dy = x0[:, None] + fine_x - u, y0[:, None] + fine_y - v
        log2_alpha = (a * dx**2 + b * dx * dy + c * dy**2 + log2_opacity).reshape(-1, 61, 61)
        is_reached = (reached >> block & 1).astype(bool)
        assert is_reached[log2_alpha[:, ::20, ::20].max(axis=(1, 2)) >= LOG2_MIN_ALPHA].all()
        assert not is_reached[log2_alpha.max(axis=(1, 2)) < LOG2_MIN_ALPHA - 0.3].any()


@pytest.mark.parametrize("name", NAMES)
def test_box_of_tiles_holds_each_pixel_that_counts(name: str) -> None:
    scene, rendering = SCENES[name], of_kernel(name)
    x, y = np.meshgrid(np.arange(scene.camera.width), np.arange(scene.camera.height))
    for i in host(rendering.lists.visible):
        u, v, a, b, c, log2_opacity = host(rendering.splats.splats)[i].astype(float)[:6]
        log2_alpha = a * (x - u) ** 2 + b * (x - u) * (y - v) + c * (y - v) ** 2 + log2_opacity
        counts = log2_alpha >= LOG2_MIN_ALPHA + 1e-3
        x0, y0, x1, y1 = host(rendering.splats.ranges)[i]
        assert (x[counts] // 16 >= x0).all()
        assert (x[counts] // 16 <= x1).all()
        assert (y[counts] // 16 >= y0).all()
        assert (y[counts] // 16 <= y1).all()
