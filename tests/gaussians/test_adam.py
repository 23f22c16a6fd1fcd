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
    """The same gradient for an id wherever its row is."""
    rows = [np.random.default_rng(100 * seed + i).normal(size=16) for i in ids]
    indices = np.searchsorted(gaussians.ids, ids).astype(np.uint32)
    return RowGradients(indices, np.array(rows, np.float32), np.zeros(6))


def test_moments_follow_the_gaussians_when_others_come_and_go() -> None:
    changed, still = map_of(6), map_of(6)
    adams = Adam(), Adam()
    for adam, gaussians in zip(adams, (changed, still), strict=True):
        adam.step(gaussians, gradients(gaussians, [1, 2, 4, 5]))
    changed.remove(np.array([1, 0, 0, 1, 0, 0], bool))
    changed.add(map_of(3).rows.copy(), 1)
    for adam, gaussians in zip(adams, (changed, still), strict=True):
        adam.step(gaussians, gradients(gaussians, [1, 4], seed=1))
    shared = np.isin(still.ids, changed.ids)
    assert changed.rows[:4].tobytes() == still.rows[shared].tobytes()


def test_gaussians_that_come_back_begin_anew_and_the_others_go_on() -> None:
    changed, still = map_of(6), map_of(6)
    adams = Adam(), Adam()
    for adam, gaussians in zip(adams, (changed, still), strict=True):
        adam.step(gaussians, gradients(gaussians, [0, 1, 2, 3, 5]))
    away = changed.extract(np.array([0, 1, 1, 0, 0, 0], bool))
    adams[0].step(changed, gradients(changed, [0], seed=1))
    adams[1].step(still, gradients(still, [0], seed=1))
    changed.reinsert(*away)
    changed.add(map_of(2).rows.copy(), 1)
    adams[0].step(changed, gradients(changed, [3, 5], seed=2))
    adams[1].step(still, gradients(still, [3, 5], seed=2))
    assert changed.rows[:6].tobytes() == still.rows.tobytes()
    a, b = (adam.snapshot() for adam in adams)
    stayed = [0, 3, 4, 5]
    for name in ("mean", "square", "steps"):
        assert a[name][stayed].tobytes() == b[name][stayed].tobytes()
        assert not np.any(a[name][[1, 2, 6, 7]])
    np.testing.assert_array_equal(a["ids"], np.arange(8))


@given(st.lists(st.sets(st.integers(0, 11), min_size=1), min_size=1, max_size=6))
@settings(deadline=None)
def test_moments_of_any_set_of_gaussians_are_found_by_their_ids(present) -> None:
    gaussians, adam = map_of(12), Adam()
    rows, anchors = gaussians.rows.copy(), gaussians.anchors.copy()
    taken: dict[int, int] = {}  # steps since the Gaussian last came
    for ids in present:
        gaussians.extract(np.ones(len(gaussians), bool))
        where = np.array(sorted(ids), int)
        gaussians.reinsert(where, rows[where], anchors[where])
        adam.step(gaussians, gradients(gaussians, sorted(ids)))
        taken = {i: taken.get(i, 0) + 1 for i in ids}
        steps = np.array([taken[i] for i in where])
        np.testing.assert_array_equal(adam.snapshot()["steps"], steps)
        g = gradients(gaussians, sorted(ids)).rows
        expected = g * (1 - 0.9 ** steps[:, None]), g**2 * (1 - 0.95 ** steps[:, None])
        np.testing.assert_allclose(adam.snapshot()["mean"], expected[0], rtol=1e-4)
        np.testing.assert_allclose(adam.snapshot()["square"], expected[1], rtol=1e-4)


def seen_map(n: int) -> GaussianMap:
    rng, gaussians = np.random.default_rng(n), GaussianMap(capacity=1)
    rows = rng.normal(size=(n, 16)).astype(np.float32)
    rows[:, 2], rows[:, 3:6] = rng.uniform(1, 3, n), np.log(0.05)
    gaussians.add(rows, 0)
    return gaussians


@pytest.mark.parametrize("threads", [1, 3])
def test_descent_is_the_step_against_the_gradients_to_the_bit(threads: int) -> None:
    camera, by_planes = Camera(40, 32, 40.0, 40.0, 20.0, 16.0), np.ones((5, 32, 40), np.float32)
    maps, adams = (seen_map(9_000), seen_map(9_000)), (Adam(), Adam())
    needles = {"needle_weight": 0.1, "needle_ratio": 1.5}
    for rate in (1.0, 0.5):
        at_once, in_two = Rasterizer(threads=threads), Rasterizer()
        for rasterizer, gaussians in zip((at_once, in_two), maps, strict=True):
            rasterizer.render(gaussians.rows, camera, np.eye(4), bounds=gaussians.bounds)
        reached = adams[0].step_fused(maps[0], at_once, by_planes, rate=rate, **needles)
        derivatives = in_two.gradients(by_planes, **needles)
        adams[1].step(maps[1], derivatives, rate=rate)
        assert reached.indices.tobytes() == derivatives.indices.tobytes()
        assert reached.weights.tobytes() == derivatives.rows[:, 14].tobytes()
        assert reached.xi.tobytes() == derivatives.xi.tobytes()
    assert maps[0].rows.tobytes() == maps[1].rows.tobytes() != seen_map(9_000).rows.tobytes()
    a, b = (adam.snapshot() for adam in adams)
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)
    assert 0 < np.count_nonzero(a["steps"]) < 9_000


def stepped(gaussians: GaussianMap, max_sigma_px: float) -> np.ndarray:
    """Mask [N] of those that one step moved."""
    camera, by_planes = Camera(40, 32, 40.0, 40.0, 20.0, 16.0), np.ones((5, 32, 40), np.float32)
    rasterizer, adam = Rasterizer(), Adam()
    rasterizer.render(gaussians.rows, camera, np.eye(4))
    adam.step_fused(gaussians, rasterizer, by_planes, max_sigma_px=max_sigma_px)
    return adam.steps(gaussians) > 0


def test_what_moves_is_cut_to_the_size_that_the_view_allows() -> None:
    """20 px of a camera with 40 px focal length are 0.5 m at 1 m."""
    free, bound = seen_map(400), seen_map(400)
    for gaussians in (free, bound):
        gaussians.log_scales[::3] = np.log([0.9, 0.7, 0.01])
    moved = stepped(free, np.inf)
    np.testing.assert_array_equal(stepped(bound, 20.0), moved)
    most = np.log(20 / 40 * bound.means[:, 2:3])
    expected = np.where(moved[:, None], np.minimum(free.log_scales, most), free.log_scales)
    np.testing.assert_allclose(bound.log_scales, expected, atol=1e-6)
    assert 0 < np.count_nonzero(bound.log_scales < free.log_scales) < 400
    others = [*range(3), *range(6, 16)]
    np.testing.assert_array_equal(bound.rows[:, others], free.rows[:, others])


def test_descent_of_another_map_than_was_rendered_is_refused() -> None:
    camera, by_planes = Camera(8, 8, 8.0, 8.0, 4.0, 4.0), np.ones((5, 8, 8), np.float32)
    rendered, other, rasterizer = seen_map(50), seen_map(50), Rasterizer()
    rasterizer.render(rendered.rows, camera, np.eye(4))
    with pytest.raises(ValueError, match="not those that were rendered"):
        Adam().step_fused(other, rasterizer, by_planes)
    Adam().step_fused(rendered, rasterizer, by_planes)
    with pytest.raises(ValueError, match="holds no rendering"):
        Adam().step_fused(rendered, rasterizer, by_planes)


def test_moments_go_with_the_map_that_is_stepped_on() -> None:
    adam, first, second = Adam(), map_of(6), map_of(6)
    adam.step(first, gradients(first, [1, 2]))
    second.remove(np.array([0, 1, 0, 0, 0, 0], bool))
    adam.step(second, gradients(second, [2]))
    np.testing.assert_array_equal(adam.snapshot()["ids"], second.ids)
    np.testing.assert_array_equal(adam.snapshot()["steps"], [0, 2, 0, 0, 0])


def test_new_gaussian_begins_with_a_full_step() -> None:
    gaussians, adam = map_of(2), Adam()
    for seed in range(5):
        adam.step(gaussians, gradients(gaussians, [0, 1], seed))
    (new,) = gaussians.add(np.zeros((1, 16), np.float32), 1)
    step = gradients(gaussians, [int(new)])
    adam.step(gaussians, step)
    expected = -AdamConfig().rates() * np.sign(step.rows[0])
    np.testing.assert_allclose(gaussians.rows[-1], expected, rtol=1e-5)


def test_restored_moments_continue_as_the_original() -> None:
    one, other = map_of(4), map_of(4)
    original, copy = Adam(), Adam()
    original.step(one, gradients(one, [0, 2]))
    original.step(other, gradients(other, [0, 2]))
    copy.restore(original.snapshot())
    state = original.snapshot()
    original.step(one, gradients(one, [0, 1], seed=2))
    assert copy.snapshot()["steps"].tobytes() == state["steps"].tobytes()
    other.rows[:] = map_of(4).rows
    again = Adam()
    again.restore(state)
    again.step(other, gradients(other, [0, 1], seed=2))
    assert again.snapshot()["mean"].tobytes() == original.snapshot()["mean"].tobytes()


def test_rates_reach_the_fields_they_are_named_after() -> None:
    rates = AdamConfig(1, 2, 3, 4, 5).rates()
    np.testing.assert_array_equal(rates, [1, 1, 1, 2, 2, 2, 3, 3, 3, 3, 4, 5, 5, 5, 0, 0])


@pytest.mark.parametrize("change", [{"color": -1.0}, {"beta2": 1.0}, {"epsilon": 0.0}])
def test_senseless_configuration_is_refused(change: dict) -> None:
    with pytest.raises(ConfigError):
        AdamConfig(**change)


def test_moments_notice_any_change_that_touch_tells_of() -> None:
    adam, gaussians = Adam(), map_of(3)
    adam.step(gaussians, gradients(gaussians, [0, 1]))
    gaussians.ids[:] += 5  # others in the same places
    gaussians.touch()
    adam.step(gaussians, gradients(gaussians, [6]))
    np.testing.assert_array_equal(adam.snapshot()["ids"], [5, 6, 7])
    np.testing.assert_array_equal(adam.snapshot()["steps"], [0, 1, 0])
