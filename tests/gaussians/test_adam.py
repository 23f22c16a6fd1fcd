import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldo_service.errors import ConfigError
from ldo_service.gaussians import Adam, AdamConfig, GaussianMap, Rasterizer, RowGradients
from ldo_service.geometry import Camera


def map_of(n: int) -> GaussianMap:
    gaussians = GaussianMap(capacity=1)
    gaussians.add(np.random.default_rng(n).normal(size=(n, 16)).astype(np.float32), 0)
    return gaussians


def gradients(gaussians: GaussianMap, ids: list[int], seed: int = 0) -> RowGradients:
    """Return gradients that depend on the id but not on its row."""
    rows = [np.random.default_rng(100 * seed + i).normal(size=16) for i in ids]
    indices = np.searchsorted(gaussians.ids, ids).astype(np.uint32)
    return RowGradients(indices, np.array(rows, np.float32), np.zeros(6))


def test_moments_follow_their_gaussians_after_removal_and_insertion() -> None:
    changed, unchanged = map_of(6), map_of(6)
    adams = Adam(), Adam()
    for adam, gaussians in zip(adams, (changed, unchanged), strict=True):
        adam.step(gaussians, gradients(gaussians, [1, 2, 4, 5]))
    changed.remove(np.array([1, 0, 0, 1, 0, 0], bool))
    changed.add(map_of(3).rows.copy(), 1)
    for adam, gaussians in zip(adams, (changed, unchanged), strict=True):
        adam.step(gaussians, gradients(gaussians, [1, 4], seed=1))
    shared = np.isin(unchanged.ids, changed.ids)
    assert changed.rows[:4].tobytes() == unchanged.rows[shared].tobytes()


def test_reinserted_gaussians_reset_moments_and_others_keep_them() -> None:
    changed, unchanged = map_of(6), map_of(6)
    adams = Adam(), Adam()
    for adam, gaussians in zip(adams, (changed, unchanged), strict=True):
        adam.step(gaussians, gradients(gaussians, [0, 1, 2, 3, 5]))
    removed = changed.extract(np.array([0, 1, 1, 0, 0, 0], bool))
    adams[0].step(changed, gradients(changed, [0], seed=1))
    adams[1].step(unchanged, gradients(unchanged, [0], seed=1))
    changed.reinsert(*removed)
    changed.add(map_of(2).rows.copy(), 1)
    adams[0].step(changed, gradients(changed, [3, 5], seed=2))
    adams[1].step(unchanged, gradients(unchanged, [3, 5], seed=2))
    assert changed.rows[:6].tobytes() == unchanged.rows.tobytes()
    a, b = (adam.snapshot() for adam in adams)
    stayed = [0, 3, 4, 5]
    for name in ("mean", "square", "steps"):
        assert a[name][stayed].tobytes() == b[name][stayed].tobytes()
        assert not np.any(a[name][[1, 2, 6, 7]])
    np.testing.assert_array_equal(a["ids"], np.arange(8))


@given(st.lists(st.sets(st.integers(0, 11), min_size=1), min_size=1, max_size=6))
@settings(deadline=None)
def test_moments_are_matched_by_id_for_any_set_of_gaussians(present) -> None:
    gaussians, adam = map_of(12), Adam()
    rows, anchors = gaussians.rows.copy(), gaussians.anchors.copy()
    step_counts: dict[int, int] = {}  # Steps since the Gaussian was last inserted.
    for ids in present:
        gaussians.extract(np.ones(len(gaussians), bool))
        present_ids = np.array(sorted(ids), int)
        gaussians.reinsert(present_ids, rows[present_ids], anchors[present_ids])
        adam.step(gaussians, gradients(gaussians, sorted(ids)))
        step_counts = {i: step_counts.get(i, 0) + 1 for i in ids}
        steps = np.array([step_counts[i] for i in present_ids])
        np.testing.assert_array_equal(adam.snapshot()["steps"], steps)
        g = gradients(gaussians, sorted(ids)).rows
        expected = g * (1 - 0.9 ** steps[:, None]), g**2 * (1 - 0.95 ** steps[:, None])
        np.testing.assert_allclose(adam.snapshot()["mean"], expected[0], rtol=1e-4)
        np.testing.assert_allclose(adam.snapshot()["square"], expected[1], rtol=1e-4)


def visible_map(n: int) -> GaussianMap:
    rng, gaussians = np.random.default_rng(n), GaussianMap(capacity=1)
    rows = rng.normal(size=(n, 16)).astype(np.float32)
    rows[:, 2], rows[:, 3:6] = rng.uniform(1, 3, n), np.log(0.05)
    gaussians.add(rows, 0)
    return gaussians


@pytest.mark.parametrize("threads", [1, 3])
def test_fused_step_is_bitwise_equal_to_gradients_and_step(threads: int) -> None:
    camera, by_planes = Camera(40, 32, 40.0, 40.0, 20.0, 16.0), np.ones((5, 32, 40), np.float32)
    maps, adams = (visible_map(9_000), visible_map(9_000)), (Adam(), Adam())
    needles = {"needle_weight": 0.1, "needle_ratio": 1.5}
    for rate in (1.0, 0.5):
        fused, separate = Rasterizer(threads=threads), Rasterizer()
        for rasterizer, gaussians in zip((fused, separate), maps, strict=True):
            rasterizer.render(gaussians.rows, camera, np.eye(4), bounds=gaussians.bounds)
        visible = adams[0].step_fused(maps[0], fused, by_planes, rate=rate, **needles)
        derivatives = separate.gradients(by_planes, **needles)
        adams[1].step(maps[1], derivatives, rate=rate)
        assert visible.indices.tobytes() == derivatives.indices.tobytes()
        assert visible.weights.tobytes() == derivatives.rows[:, 14].tobytes()
        assert visible.xi.tobytes() == derivatives.xi.tobytes()
    assert maps[0].rows.tobytes() == maps[1].rows.tobytes() != visible_map(9_000).rows.tobytes()
    a, b = (adam.snapshot() for adam in adams)
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)
    assert 0 < np.count_nonzero(a["steps"]) < 9_000


def stepped_mask(gaussians: GaussianMap, max_sigma_px: float) -> np.ndarray:
    """Return the mask [N] of the Gaussians that one step changed."""
    camera, by_planes = Camera(40, 32, 40.0, 40.0, 20.0, 16.0), np.ones((5, 32, 40), np.float32)
    rasterizer, adam = Rasterizer(), Adam()
    rasterizer.render(gaussians.rows, camera, np.eye(4))
    adam.step_fused(gaussians, rasterizer, by_planes, max_sigma_px=max_sigma_px)
    return adam.steps(gaussians) > 0


def test_stepped_gaussians_are_limited_to_max_sigma() -> None:
    """20 px at a focal length of 40 px are 0.5 m at 1 m depth."""
    unlimited, limited = visible_map(400), visible_map(400)
    for gaussians in (unlimited, limited):
        gaussians.log_scales[::3] = np.log([0.9, 0.7, 0.01])
    is_moved = stepped_mask(unlimited, np.inf)
    np.testing.assert_array_equal(stepped_mask(limited, 20.0), is_moved)
    max_log_scales = np.log(20 / 40 * limited.means[:, 2:3])
    expected = np.where(
        is_moved[:, None], np.minimum(unlimited.log_scales, max_log_scales), unlimited.log_scales
    )
    np.testing.assert_allclose(limited.log_scales, expected, atol=1e-6)
    assert 0 < np.count_nonzero(limited.log_scales < unlimited.log_scales) < 400
    others = [*range(3), *range(6, 16)]
    np.testing.assert_array_equal(limited.rows[:, others], unlimited.rows[:, others])


def test_fused_step_of_a_map_that_was_not_rendered_raises() -> None:
    camera, by_planes = Camera(8, 8, 8.0, 8.0, 4.0, 4.0), np.ones((5, 8, 8), np.float32)
    rendered, other, rasterizer = visible_map(50), visible_map(50), Rasterizer()
    rasterizer.render(rendered.rows, camera, np.eye(4))
    with pytest.raises(ValueError, match="not those that were rendered"):
        Adam().step_fused(other, rasterizer, by_planes)
    Adam().step_fused(rendered, rasterizer, by_planes)
    with pytest.raises(ValueError, match="holds no rendering"):
        Adam().step_fused(rendered, rasterizer, by_planes)


def test_moments_are_matched_to_the_map_of_the_step() -> None:
    adam, first, second = Adam(), map_of(6), map_of(6)
    adam.step(first, gradients(first, [1, 2]))
    second.remove(np.array([0, 1, 0, 0, 0, 0], bool))
    adam.step(second, gradients(second, [2]))
    np.testing.assert_array_equal(adam.snapshot()["ids"], second.ids)
    np.testing.assert_array_equal(adam.snapshot()["steps"], [0, 2, 0, 0, 0])


def test_first_step_of_a_new_gaussian_is_full() -> None:
    gaussians, adam = map_of(2), Adam()
    for seed in range(5):
        adam.step(gaussians, gradients(gaussians, [0, 1], seed))
    (new,) = gaussians.add(np.zeros((1, 16), np.float32), 1)
    step = gradients(gaussians, [int(new)])
    adam.step(gaussians, step)
    expected = -AdamConfig().rates() * np.sign(step.rows[0])
    np.testing.assert_allclose(gaussians.rows[-1], expected, rtol=1e-5)


def test_restored_moments_continue_bitwise_equal() -> None:
    one, other = map_of(4), map_of(4)
    original, copy = Adam(), Adam()
    original.step(one, gradients(one, [0, 2]))
    original.step(other, gradients(other, [0, 2]))
    copy.restore(original.snapshot())
    state = original.snapshot()
    original.step(one, gradients(one, [0, 1], seed=2))
    assert copy.snapshot()["steps"].tobytes() == state["steps"].tobytes()
    other.rows[:] = map_of(4).rows
    restored = Adam()
    restored.restore(state)
    restored.step(other, gradients(other, [0, 1], seed=2))
    assert restored.snapshot()["mean"].tobytes() == original.snapshot()["mean"].tobytes()


def test_rates_apply_to_their_columns() -> None:
    rates = AdamConfig(1, 2, 3, 4, 5).rates()
    np.testing.assert_array_equal(rates, [1, 1, 1, 2, 2, 2, 3, 3, 3, 3, 4, 5, 5, 5, 0, 0])


@pytest.mark.parametrize("change", [{"color": -1.0}, {"beta2": 1.0}, {"epsilon": 0.0}])
def test_invalid_settings_raise_config_error(change: dict) -> None:
    with pytest.raises(ConfigError):
        AdamConfig(**change)


def test_touch_makes_moments_follow_changed_ids() -> None:
    adam, gaussians = Adam(), map_of(3)
    adam.step(gaussians, gradients(gaussians, [0, 1]))
    gaussians.ids[:] += 5  # Other ids in the same rows.
    gaussians.touch()
    adam.step(gaussians, gradients(gaussians, [6]))
    np.testing.assert_array_equal(adam.snapshot()["ids"], [5, 6, 7])
    np.testing.assert_array_equal(adam.snapshot()["steps"], [0, 1, 0])
