"""Tests that culling skips rows out of view and leaves the images bitwise equal."""

from collections.abc import Callable

import numpy as np
import pytest

from ldo_service.gaussians import GaussianMap, Rasterizer, render
from ldo_service.geometry import Camera, se3
from ldo_service.kernels import _rasterize

CAMERA = Camera(52, 40, 45.0, 47.0, 22.0, 21.0)
BLOCK = 256

RENDER_BOTH = """
from ldo_service.gaussians import Rasterizer
from ldo_service.geometry import Camera
from ldo_service.kernels import _rasterize
camera, bounds = Camera(52, 40, 45.0, 47.0, 22.0, 21.0), _rasterize.Bounds()
uncut, cut = Rasterizer(), Rasterizer(threads=2)
for k, T in enumerate(given["poses"]):
    result[f"uncut{k}"] = uncut.render(given["rows"], camera, T).copy()
    result[f"cut{k}"] = cut.render(given["rows"], camera, T, bounds=bounds).copy()
"""


def patches(n: int, seed: int = 0) -> np.ndarray:
    """Return rows in spatially small runs around the origin; a few rows are large."""
    rng = np.random.default_rng(seed)
    center = rng.normal(size=(n // 100 + 1, 3)) * 2
    rows = np.zeros((n, 16), np.float32)
    rows[:, :3] = center[np.arange(n) // 100] + 0.1 * rng.normal(size=(n, 3))
    rows[:, 3:6] = np.log(0.01 * rng.uniform(0.2, 3, (n, 3)))
    rows[::997, 3:6] = np.log(0.5)
    rows[:, 6:10] = rng.normal(size=(n, 4))
    rows[:, 10] = rng.uniform(-3, 6, n)
    rows[:, 11:14] = rng.uniform(0, 1, (n, 3))
    return rows


def poses(n: int, seed: int = 1) -> np.ndarray:
    """Return random transforms [n, 4, 4]."""
    rng = np.random.default_rng(seed)
    return np.stack([se3.exp(xi) for xi in rng.normal(size=(n, 6))])


def assert_same_images(rows: np.ndarray, bounds: _rasterize.Bounds, T: np.ndarray) -> None:
    """Check that the images with and without bounds are bitwise equal."""
    with_bounds, without = render(rows, CAMERA, T, bounds=bounds), render(rows, CAMERA, T)
    for name in ("color", "weighted_depth_m", "median_depth_m", "opacity"):
        assert getattr(with_bounds, name).tobytes() == getattr(without, name).tobytes(), name


def test_culling_changes_no_bit_of_the_images(with_isa: Callable) -> None:
    images = with_isa(RENDER_BOTH, {"rows": patches(10_007), "poses": poses(40)})
    for k in range(40):
        assert images[f"uncut{k}"].tobytes() == images[f"cut{k}"].tobytes()


@pytest.mark.parametrize("edge", range(4))
def test_gaussian_that_slides_out_of_view_is_drawn_as_long_as_a_pixel_shows_it(edge: int) -> None:
    """Check that the bound excludes the block soon after it leaves the image, never before."""
    axis, sign = divmod(edge, 2)
    drawn, read = [], []
    for step in np.linspace(0, 3, 150):
        rows = np.zeros((BLOCK, 16), np.float32)
        rows[:, 2], rows[:, 3:6], rows[:, 6], rows[:, 10] = 2, np.log(0.5), 1, 9
        rows[:, axis] = step * (1 - 2 * sign) * 2
        bounds = _rasterize.Bounds()
        render(rows, CAMERA, np.eye(4), bounds=bounds)
        drawn.append(render(rows, CAMERA, np.eye(4)).opacity.any())
        # The bounds are not notified.
        rows[:] = 0, 0, 2, *[np.log(0.05)] * 3, 1, 0, 0, 0, 9, 1, 1, 1, 0, 0
        read.append(render(rows, CAMERA, np.eye(4), bounds=bounds).opacity.any())
    assert all(r for d, r in zip(drawn, read, strict=True) if d)
    assert 0 < sum(drawn) <= sum(read) < sum(drawn) + 20


def test_gradients_are_the_same_with_culling() -> None:
    rows, T = patches(6_000), poses(1)[0]
    by_planes = np.random.default_rng(2).normal(size=(5, 40, 52)).astype(np.float32)
    bounds = _rasterize.Bounds()
    both = []
    for given in (None, bounds, bounds):  # The last uses known bounds.
        rasterizer = Rasterizer()
        rasterizer.render(rows, CAMERA, T, bounds=given)
        both.append(rasterizer.gradients(by_planes))
    assert 0 < len(both[0].indices) < 3_000
    for other in both[1:]:
        for name in ("indices", "rows", "xi"):
            assert getattr(both[0], name).tobytes() == getattr(other, name).tobytes()


def map_of(n: int) -> GaussianMap:
    """Return a map of n rows from five keyframes."""
    gaussians = GaussianMap(capacity=2 * n)
    for keyframe, part in enumerate(np.array_split(patches(n), 5)):
        gaussians.add(part, keyframe)
    return gaussians


CHANGES: dict[str, Callable[[GaussianMap], object]] = {
    "add": lambda m: m.add(patches(700, 3), 9),
    "add_into_the_last_block": lambda m: m.add(patches(3, 3), 9),
    "remove": lambda m: m.remove(np.arange(len(m)) % 3 == 1),
    "remove_and_add_as_many": lambda m: m.add(patches(m.remove(np.arange(len(m)) > 900), 4), 9),
    "move_anchors": lambda m: m.move_anchors({1: poses(1, 5)[0], 3: poses(1, 6)[0]}),
    "touch_all": lambda m: (m.means.__imul__(0.7), m.touch()),
    "touch_some": lambda m: (
        m.means[1000:2000].__imul__(-1),
        m.touch(np.arange(1000, 2000, dtype=np.uint32)),
    ),
    "touch_slice": lambda m: (m.means[-900:].__imul__(-1), m.touch(slice(-900, None))),
    "grow": lambda m: [m.add(patches(3000, k), 9) for k in range(4)],
}


@pytest.mark.parametrize("change", CHANGES)
def test_whatever_happens_to_the_map_is_seen(change: str) -> None:
    gaussians, views = map_of(5_000), poses(12, 8)
    for T in views:  # Every bound is known before the change.
        assert_same_images(gaussians.rows, gaussians.bounds, T)
    CHANGES[change](gaussians)
    for T in views:
        assert_same_images(gaussians.rows, gaussians.bounds, T)


def test_rows_elsewhere_in_memory_are_not_taken_for_those_that_were_measured() -> None:
    bounds, views = _rasterize.Bounds(), poses(12, 8)
    for rows in (patches(5_000), patches(5_000, 7)):
        for T in views:
            assert_same_images(rows, bounds, T)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_senseless_rows_hide_none_of_their_block(value: float) -> None:
    rows = patches(2_000)
    rows[np.arange(0, 1400, 100), np.arange(14)] = value
    bounds = _rasterize.Bounds()
    for T in [*poses(8, 8), *poses(8, 8)]:
        assert_same_images(rows, bounds, T)


def test_blocks_out_of_view_are_not_read() -> None:
    rows, bounds = patches(4 * BLOCK), _rasterize.Bounds()
    rows[:BLOCK, :3], rows[:BLOCK, 3:6] = (0, 0, -5), np.log(0.01)
    before = render(rows, CAMERA, np.eye(4), bounds=bounds)
    rows[:BLOCK, :3] = (0, 0, 1)  # The bounds are not notified.
    after = render(rows, CAMERA, np.eye(4), bounds=bounds)
    assert before.opacity.tobytes() == after.opacity.tobytes()
    bounds.forget(10, 11)
    assert render(rows, CAMERA, np.eye(4), bounds=bounds).opacity.mean() > before.opacity.mean()


def test_bad_arguments_raise_value_error() -> None:
    bounds = _rasterize.Bounds()
    with pytest.raises(ValueError, match="negative"):
        bounds.forget(3, 2)
    with pytest.raises(ValueError, match="uint32"):
        bounds.forget_rows(np.arange(3))
