import numpy as np

from ldo_service.tracking import PyramidConfig, build_reference, pyramid_of


def test_points_lie_on_the_surface_of_every_level(room) -> None:
    pyramid = pyramid_of(room.view(np.eye(4)), PyramidConfig())
    for points, level in zip(build_reference(pyramid).points, pyramid.levels, strict=True):
        column, row = level.camera.project(points[:3].T.astype(float)).round().astype(int).T
        np.testing.assert_allclose(points[2], level.depth_m[row, column])
        np.testing.assert_array_equal(points[3], level.texels[row, column, 0])


def test_normals_are_those_of_the_walls(room) -> None:
    points = build_reference(pyramid_of(room.view(np.eye(4)), PyramidConfig())).points[0]
    normals = points[4:][:, points[4:].any(axis=0)]
    assert normals.shape[1] > 0.75 * points.shape[1]
    along_axes = np.abs(normals).max(axis=0)
    assert np.mean(along_axes > 0.999) > 0.95
    facing = np.sum(points[:3] * points[4:], axis=0)
    assert facing.max() <= 0


def test_scale_of_the_scene_is_its_median_depth(room) -> None:
    frame = room.view(np.eye(4))
    scale_m = build_reference(pyramid_of(frame, PyramidConfig())).median_depth_m
    assert abs(scale_m - np.median(frame.depth_m)) < 0.05


def test_blank_frame_has_no_points(room) -> None:
    reference = build_reference(pyramid_of(room.blank(), PyramidConfig()))
    assert all(points.shape == (7, 0) for points in reference.points)
    assert reference.median_depth_m == 1.0


def test_masked_pixels_have_no_points_on_any_level(room) -> None:
    pyramid = pyramid_of(room.view(np.eye(4)), PyramidConfig())
    ignore_mask = np.zeros((120, 160), bool)
    ignore_mask[30:61, 41:90] = True
    for points, level in zip(
        build_reference(pyramid, ignore_mask).points, pyramid.levels, strict=True
    ):
        column, row = level.camera.project(points[:3].T.astype(float)).round().astype(int).T
        scale = 160 / level.camera.width
        u, v = (column + 0.5) * scale, (row + 0.5) * scale
        assert not ((u > 41) & (u < 90) & (v > 30) & (v < 61)).any()
        assert len(column) > 0.7 * (level.camera.width - 2) * (level.camera.height - 2)


def test_cells_are_numbered_by_rows_of_the_image(room) -> None:
    pyramid = pyramid_of(room.view(np.eye(4)), PyramidConfig())
    reference, camera = build_reference(pyramid), pyramid.levels[0].camera
    u, v = camera.project(reference.points[0][:3].T.astype(float)).round().T
    row, column = 6 * v / camera.height, 8 * u / camera.width
    is_inside = (row % 1 > 0.01) & (column % 1 > 0.01)  # Rounding decides at the first pixel.
    expected = 8 * np.floor(row) + np.floor(column)
    np.testing.assert_array_equal(reference.cells[is_inside], expected[is_inside])
    assert reference.cells.max() == 47
