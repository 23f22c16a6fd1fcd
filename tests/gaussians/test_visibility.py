import numpy as np
import pytest

from ldo_service.gaussians import render
from ldo_service.gaussians.visibility import BoundingSpheres, PlacedCamera, chunk_numbers
from ldo_service.geometry import Camera, se3

CAMERA = Camera(64, 48, 50.0, 40.0, 28.0, 27.0)


def clusters(count: int, each: int, seed: int, *, around_m: float = 4.0) -> tuple:
    """Return rows and anchors of small and large Gaussians, some at the camera in the origin."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((count * each, 16), np.float32)
    centers = rng.uniform(-around_m, around_m, (count, 3))
    rows[:, 0:3] = np.repeat(centers, each, axis=0) + rng.normal(0, 0.1, (count * each, 3))
    rows[:, 3:6] = np.repeat(rng.uniform(-6, -1, (count, 1)), each, axis=0)
    rows[:, 3:6] += rng.uniform(-1, 1, (count * each, 3))
    rows[:, 6:10] = rng.normal(size=(count * each, 4))
    rows[:, 10] = rng.uniform(-2, 8, count * each)
    rows[:, 11:14] = rng.uniform(0, 1, (count * each, 3))
    return rows, np.repeat(np.arange(count, dtype=np.int32), each)


@pytest.mark.parametrize("seed", range(8))
def test_invisible_spheres_do_not_change_the_rendering(seed: int) -> None:
    rows, anchors = clusters(400, 3, seed)
    camera = PlacedCamera(CAMERA, se3.exp(np.array([0.2, seed, -0.1, 0.3, -0.2, 0.1])))
    spheres = BoundingSpheres.around(rows, anchors)
    seen = camera.may_see(spheres.centers, spheres.radii_m)
    assert 0.05 < seen.mean() < 0.7
    T_camera_map = se3.inverse(camera.T_map_camera)
    whole = render(rows, CAMERA, T_camera_map)
    part = render(np.ascontiguousarray(rows[seen[anchors]]), CAMERA, T_camera_map)
    assert whole.opacity.max() > 0.5
    for name in ("color", "opacity", "median_depth_m", "weighted_depth_m"):
        assert getattr(whole, name).tobytes() == getattr(part, name).tobytes()


@pytest.mark.parametrize("sigma_px", [0.05, 1, 8])
def test_rendered_gaussians_outside_the_image_are_visible(
    sigma_px: float,
) -> None:
    rng = np.random.default_rng(int(sigma_px))
    n, reach_px = 3000, 5 * sigma_px + 4
    z = rng.uniform(0.1, 4, n)
    u, v = rng.uniform(-reach_px, 63 + reach_px, n), rng.uniform(-reach_px, 47 + reach_px, n)
    is_outside = (u < 0) | (u > 63) | (v < 0) | (v > 47)
    rows = np.zeros((np.count_nonzero(is_outside), 16), np.float32)
    rows[:, 0:3] = np.stack([(u - 28) * z / 50, (v - 27) * z / 40, z], axis=-1)[is_outside]
    rows[:, 3:6] = np.log(sigma_px * z[is_outside, None] / 50)
    rows[:, 6], rows[:, 10] = 1, 8
    anchors = np.arange(len(rows), dtype=np.int32)
    spheres = BoundingSpheres.around(rows, anchors)
    seen = PlacedCamera(CAMERA, np.eye(4)).may_see(spheres.centers, spheres.radii_m)
    drawn = np.array([render(row[None], CAMERA, np.eye(4)).opacity.any() for row in rows])
    assert np.count_nonzero(drawn) > 50
    assert not np.any(drawn & ~seen)
    assert np.count_nonzero(~seen) > 0.1 * len(rows)


def test_spheres_enclose_the_gaussians_of_their_anchor() -> None:
    rows, anchors = clusters(30, 5, 1)
    shuffled = np.random.default_rng(0).permutation(len(rows))
    spheres = BoundingSpheres.around(rows[shuffled], anchors[shuffled])
    np.testing.assert_array_equal(spheres.anchors, np.arange(30))
    np.testing.assert_array_equal(spheres.counts, 5)
    distances = np.linalg.norm(rows[:, :3] - spheres.centers[anchors], axis=1)
    sigmas = np.exp(rows[:, 3:6].max(axis=1))
    assert np.all(distances + 3 * sigmas < spheres.radii_m[anchors])


def test_chunk_has_one_anchor_and_one_cube() -> None:
    rows, anchors = clusters(30, 20, 1)
    chunks = chunk_numbers(rows[:, :3], anchors, 0.25)
    assert chunks.max() + 1 == len(np.unique(chunks)) > 60
    for chunk in range(chunks.max() + 1):
        is_own = chunks == chunk
        assert len(np.unique(anchors[is_own])) == 1
        assert len(np.unique(np.floor(rows[is_own, :3] / 0.25), axis=0)) == 1
    order = np.argsort(chunks, kind="stable")
    assert np.all(np.diff(anchors[order]) >= 0)


def test_sphere_encloses_its_chunk() -> None:
    rows, anchors = clusters(30, 20, 1)
    chunks = chunk_numbers(rows[:, :3], anchors, 0.25)
    spheres = BoundingSpheres.around(rows, anchors, chunks)
    assert spheres.counts.tolist() == np.bincount(chunks).tolist()
    assert np.all(anchors == spheres.anchors[chunks])
    distances = np.linalg.norm(rows[:, :3] - spheres.centers[chunks], axis=1)
    assert np.all(distances + 3 * np.exp(rows[:, 3:6].max(axis=1)) < spheres.radii_m[chunks])


@pytest.mark.parametrize(
    ("center", "is_seen"),
    [
        ((0, 0, 3), True),
        ((0, 0, -0.2), False),
        ((0, 0, -0.05), True),  # Extends beyond the near plane.
        ((3 * 36 / 50, 0, 3), True),  # Touches the right border of the image.
        ((3 * 36 / 50 + 0.6, 0, 3), False),
        ((0, -3 * 28 / 40 - 0.6, 3), False),
        ((0, 0, 10.05), True),
        ((0, 0, 10.2), False),  # Out of reach.
        ((np.nan, 0, 3), True),
    ],
)
def test_visibility_of_a_sphere_at_the_limits_of_the_view(
    center: tuple[float, ...], is_seen: bool
) -> None:
    camera = PlacedCamera(CAMERA, np.eye(4))
    seen = camera.may_see(np.array([center], float), np.array([0.1]), reach_m=10)
    assert seen.tolist() == [is_seen]


def test_empty_map_has_no_spheres() -> None:
    spheres = BoundingSpheres.around(np.zeros((0, 16), np.float32), np.zeros(0, np.int32))
    assert len(spheres) == 0
    assert PlacedCamera(CAMERA, np.eye(4)).may_see(spheres.centers, spheres.radii_m).size == 0


def test_huge_gaussian_is_visible_from_everywhere() -> None:
    rows, anchors = clusters(1, 2, 1)
    rows[1, 3] = 1e4
    spheres = BoundingSpheres.around(rows, anchors)
    far_camera = PlacedCamera(CAMERA, se3.exp(np.array([0, 0, 0, 0, 0, 1e6])))
    assert far_camera.may_see(spheres.centers, spheres.radii_m, reach_m=20).all()
