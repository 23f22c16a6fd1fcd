from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.gaussians import (
    AdamConfig,
    Exposure,
    GaussianMap,
    GaussianOptimizer,
    GaussianOptimizerConfig,
    ImageLoss,
    TrainingView,
    densify,
    render,
)
from ldo_service.gaussians.adam import MAX_FACTOR, USUAL_L1, residual_factor
from ldo_service.geometry import se3


@pytest.fixture(autouse=True)
def _small_images_are_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Halve the images of these tests, which have 80x60 pixels."""
    monkeypatch.setattr("ldo_service.gaussians.optimizer.MIN_HALVED_PX", 32)


@pytest.fixture(scope="module")
def start(small_room) -> tuple[GaussianMap, list[TrainingView]]:
    """Return a map of three views of the synthetic room, and the views."""
    gaussians, views = GaussianMap(), []
    for i in (0, 4, 8):
        frame, T_map_camera = small_room(i)
        densify(gaussians, frame, T_map_camera, i)
        views.append(TrainingView.of(frame, T_map_camera, i))
    return gaussians, views


def copied(gaussians: GaussianMap) -> GaussianMap:
    return GaussianMap.restore(gaussians.snapshot())


def alternating(iterations: int) -> list[int]:
    """Return view indices in turn, starting with the last view."""
    return [2 - k % 3 for k in range(iterations)]


def optimized(
    start: tuple,
    config: GaussianOptimizerConfig | None = None,
    *,
    plan: list[int] | None = None,
    threads: int = 1,
) -> tuple[GaussianMap, list[TrainingView], list[ImageLoss]]:
    """Return map and views after the optimization, and the losses of its iterations."""
    gaussians, views = copied(start[0]), list(start[1])
    plan = alternating(30) if plan is None else plan
    optimizer = GaussianOptimizer(config, threads=threads)
    return gaussians, views, optimizer.optimize(gaussians, views, plan, fixed=0)


def mean_psnr(gaussians: GaussianMap, views: list[TrainingView]) -> float:
    """Return the mean PSNR of the whole images with exposures applied."""
    errors = []
    for view in views:
        rendering = render(gaussians.rows, view.camera, se3.inverse(view.T_map_camera))
        truth = view.color.transpose(1, 2, 0) / 255
        errors.append(np.mean((view.exposure.applied(rendering.color) - truth) ** 2))
    return float(np.mean(-10 * np.log10(errors)))


def test_optimization_improves_psnr_of_the_views(start: tuple) -> None:
    gaussians, views, losses = optimized(start, plan=alternating(60))
    assert mean_psnr(gaussians, views) > mean_psnr(*start) + 3
    assert losses[-3].total < 0.7 * losses[0].total
    assert gaussians.version > start[0].version


@pytest.mark.parametrize("threads", [2, 3])
def test_result_is_bitwise_equal_for_any_thread_count(start: tuple, threads: int) -> None:
    config = GaussianOptimizerConfig(rotation_rate_rad=1e-4, translation_rate_m=1e-4)
    one, a, losses = optimized(start, config, plan=alternating(6))
    many, b, same_losses = optimized(start, config, plan=alternating(6), threads=threads)
    assert one.rows.tobytes() == many.rows.tobytes()
    assert [x.total for x in losses] == [x.total for x in same_losses]
    for left, right in zip(a, b, strict=True):
        assert left.T_map_camera.tobytes() == right.T_map_camera.tobytes()
        assert left.exposure.matrix.tobytes() == right.exposure.matrix.tobytes()


def test_restored_optimizer_continues_bitwise_equal(start: tuple) -> None:
    gaussians, views = copied(start[0]), list(start[1])
    config = GaussianOptimizerConfig(rotation_rate_rad=1e-4)
    original = GaussianOptimizer(config)
    original.optimize(gaussians, views, alternating(5))
    copy, other, other_views = GaussianOptimizer(config), copied(gaussians), list(views)
    copy.restore(original.snapshot())
    original.optimize(gaussians, views, alternating(5))
    copy.optimize(other, other_views, alternating(5))
    assert gaussians.rows.tobytes() == other.rows.tobytes()
    assert views[2].T_map_camera.tobytes() == other_views[2].T_map_camera.tobytes()
    before, after = original.snapshot(), copy.snapshot()
    assert before.keys() == after.keys()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def test_brightness_of_a_frame_changes_its_exposure(start: tuple) -> None:
    darker = replace(start[1][2], color=(start[1][2].color * 0.8).astype(np.uint8))
    config = GaussianOptimizerConfig(adam=AdamConfig(color=0.001))
    _, views, _ = optimized((start[0], [*start[1][:2], darker]), config, plan=alternating(90))
    adjusted_gray = views[2].exposure.applied(np.full((1, 1, 3), 0.5, np.float32))
    assert np.abs(adjusted_gray - 0.4).max() < 0.04
    assert views[0].exposure.matrix.tobytes() == Exposure().matrix.tobytes()


def test_displaced_pose_converges_to_the_true_pose(start: tuple) -> None:
    gaussians, views = optimized(start, plan=alternating(150))[0], start[1]
    offset = se3.exp(np.array([0.004, -0.003, 0.002, 0.01, -0.008, 0.006]))
    moved = [*views[:2], replace(views[2], T_map_camera=views[2].T_map_camera @ offset)]
    config = GaussianOptimizerConfig(
        adam=AdamConfig(0, 0, 0, 0, 0),
        rotation_rate_rad=3e-4,
        translation_rate_m=5e-4,
    )
    _, refined_views, _ = optimized((gaussians, moved), config, plan=[2] * 150)
    remaining = se3.inverse(views[2].T_map_camera) @ refined_views[2].T_map_camera
    assert np.linalg.norm(remaining[:3, 3]) < 0.15 * np.linalg.norm(offset[:3, 3])
    assert se3.rotation_angle(remaining) < 0.15 * se3.rotation_angle(offset)


def test_steps_decrease_to_the_final_rate(start: tuple) -> None:
    gaussians, views = copied(start[0]), list(start[1])
    before = gaussians.colors.copy()
    GaussianOptimizer().optimize(gaussians, views, [2])
    first = np.abs(gaussians.colors - before).max()
    optimizer = GaussianOptimizer()
    optimizer.optimize(gaussians, views, alternating(20), rates=(1.0, 0.01))
    before = gaussians.colors.copy()
    optimizer.step(gaussians, views[2], rate=0.01)
    assert np.abs(gaussians.colors - before).max() < 0.05 * first


def test_steps_after_a_keyframe_grow_with_the_root_of_the_color_error(start: tuple) -> None:
    """The first step of Adam changes a color by its learning rate times the factor."""
    steps, errors = {False: [], True: []}, []
    for brightness in (1.0, 0.9):
        view = start[1][2]
        views = [replace(view, color=(brightness * view.color).astype(np.uint8))]
        for after_keyframe, found in steps.items():
            gaussians = copied(start[0])
            (loss,) = GaussianOptimizer().optimize(
                gaussians, views, [0], fixed=0, after_keyframe=after_keyframe
            )
            found.append(np.abs(gaussians.colors - start[0].colors).max())
        errors.append(loss.l1)
    rate = AdamConfig().color
    np.testing.assert_allclose(steps[False], rate, rtol=1e-3)
    np.testing.assert_allclose(steps[True], rate * np.sqrt(np.divide(errors, USUAL_L1)), rtol=1e-3)
    assert steps[True][1] > 1.1 * steps[True][0]


def test_factor_of_the_steps_is_limited() -> None:
    """Images of unmapped surface are black in the rendering."""
    assert residual_factor(USUAL_L1) == 1
    assert residual_factor(0.5) == residual_factor(1.0) == MAX_FACTOR


def test_poses_are_not_changed_at_zero_pose_rates(start: tuple) -> None:
    config = GaussianOptimizerConfig(rotation_rate_rad=0.0, translation_rate_m=0.0)
    _, views, _ = optimized(start, config, plan=alternating(4))
    for before, after in zip(start[1], views, strict=True):
        assert before.T_map_camera is after.T_map_camera


def test_empty_plan_changes_nothing(start: tuple) -> None:
    gaussians, _, losses = optimized(start, plan=[])
    assert losses == []
    assert gaussians.rows.tobytes() == start[0].rows.tobytes()


def test_gaussians_may_change_between_two_calls(start: tuple) -> None:
    gaussians, views = copied(start[0]), list(start[1])
    optimizer = GaussianOptimizer()
    optimizer.optimize(gaussians, views, alternating(3))
    gaussians.remove(gaussians.ids % 3 == 0)
    gaussians.add(start[0].rows[:50].copy(), 9)
    before = mean_psnr(gaussians, views)
    optimizer.optimize(gaussians, views, alternating(30))
    assert np.isfinite(gaussians.rows).all()
    assert mean_psnr(gaussians, views) > before


def test_step_counts_increase_exactly_for_changed_gaussians(start: tuple) -> None:
    gaussians, views = copied(start[0]), list(start[1])
    optimizer = GaussianOptimizer()
    before, rows = optimizer.steps(gaussians).copy(), gaussians.rows.copy()
    optimizer.optimize(gaussians, views, [2])
    has_new_steps = optimizer.steps(gaussians) != before
    np.testing.assert_array_equal(has_new_steps, (gaussians.rows != rows).any(axis=1))
    assert 0 < has_new_steps.mean() < 1


@pytest.mark.parametrize(
    "change",
    [
        {"exposure_share": -0.1},
        {"exposure_share": 1.1},
        {"half_share": -0.1},
        {"half_share": 1.1},
        {"translation_rate_m": -1.0},
        {"max_needle_ratio": 0.5},
        {"max_sigma_px": 0.0},
    ],
)
def test_invalid_settings_raise_config_error(change: dict) -> None:
    with pytest.raises(ConfigError):
        GaussianOptimizerConfig(**change)


def test_effort_weights_iterations_by_visible_gaussians(start: tuple) -> None:
    lengths = []
    for usual_reach in (500, 5_000, 50_000):
        gaussians, views = copied(start[0]), list(start[1])
        optimizer = GaussianOptimizer(GaussianOptimizerConfig(usual_reach=usual_reach))
        lengths.append(len(optimizer.optimize(gaussians, views, alternating(30), effort=8)))
    assert 1 <= lengths[0] < lengths[1] < lengths[2] <= 16


def in_half_resolution(
    start: tuple, plan: list[int], *, threads: int = 1, effort: float = 8, **changes
) -> tuple:
    """Return map and views after half of the effort at half resolution, and the visible rows."""
    config = replace(GaussianOptimizerConfig(usual_reach=1000, half_share=0.5), **changes)
    gaussians, views, seen = copied(start[0]), list(start[1]), []
    GaussianOptimizer(config, threads=threads).optimize(
        gaussians, views, plan, fixed=0, effort=effort, after_keyframe=True,
        observe=lambda _, visible: seen.append((visible.indices.copy(), visible.weights.copy())),
    )  # fmt: skip
    return gaussians, views, seen


def test_iterations_at_half_resolution_improve_the_full_images(start: tuple) -> None:
    rates = {"rotation_rate_rad": 1e-5, "translation_rate_m": 1e-5}
    gaussians, views, seen = in_half_resolution(start, alternating(90), **rates)
    only_full = in_half_resolution(start, alternating(90), half_share=0.0)[2]
    assert len(seen) > 1.3 * len(only_full)
    assert mean_psnr(gaussians, views) > mean_psnr(*start) + 3
    for before, after in zip(start[1], views, strict=True):
        assert after.color is before.color
        assert after.camera == before.camera
    again = in_half_resolution(start, alternating(90), threads=2, **rates)[0]
    np.testing.assert_array_equal(again.rows, gaussians.rows)


def test_iterations_at_half_resolution_change_pose_and_exposure(
    start: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ldo_service.gaussians.exposure.MIN_BLOCK_PX", 2)  # The images are small.
    rates = {"rotation_rate_rad": 1e-5, "translation_rate_m": 1e-5}
    _, views, seen = in_half_resolution(start, alternating(6), half_share=1.0, **rates)
    assert len(seen) == 6
    assert not np.array_equal(views[2].T_map_camera, start[1][2].T_map_camera)
    assert (views[2].exposure.matrix != start[1][2].exposure.matrix).any()


def test_effort_below_a_full_iteration_is_spent_at_half_resolution(start: tuple) -> None:
    """Half of an effort of 1.9 leaves 0.95 units for full resolution, half of 2.1 leaves 1.05."""
    rows = {
        (effort, share): in_half_resolution(
            start, alternating(30), effort=effort, half_share=share
        )[0].rows
        for effort in (1.9, 2.1)
        for share in (0.5, 1.0)
    }
    np.testing.assert_array_equal(rows[1.9, 0.5], rows[1.9, 1.0])
    assert not np.array_equal(rows[2.1, 0.5], rows[2.1, 1.0])


def test_size_limit_counts_full_pixels(start: tuple) -> None:
    config = GaussianOptimizerConfig(max_sigma_px=1.5)
    sigmas_m = []
    for is_half in (False, True):
        gaussians = copied(start[0])
        step = GaussianOptimizer(config).step(gaussians, start[1][2], is_half=is_half)
        moved = step.visible.indices[step.visible.weights > 0]
        sigmas_m.append(np.exp(gaussians.rows[moved, 3:6]).max())
    assert sigmas_m[1] == pytest.approx(sigmas_m[0], rel=0.1)


def test_unusable_keyframes_get_no_iteration(start: tuple) -> None:
    gaussians, views, seen = copied(start[0]), list(start[1]), []
    losses = GaussianOptimizer().optimize(
        gaussians, views, alternating(9), observe=lambda k, _: seen.append(k),
        is_usable=lambda k: k != 1,
    )  # fmt: skip
    assert seen == [2, 0, 2, 0, 2, 0]
    assert len(losses) == 6


def test_weights_at_half_resolution_count_full_pixels(start: tuple) -> None:
    (indices, half), *_ = in_half_resolution(start, alternating(1), half_share=1.0)[2]
    (all_indices, full), *_ = in_half_resolution(start, alternating(1), half_share=0.0)[2]
    assert half.sum() == pytest.approx(full.sum(), rel=0.02)
    common = np.isin(all_indices, indices) & (full > 1)
    assert np.median(half[np.isin(indices, all_indices[common])] / full[common]) == pytest.approx(
        1, abs=0.05
    )


def test_small_images_are_not_halved(start: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.gaussians.optimizer.residual_factor", lambda _: 1.0)
    view = start[1][0]
    small = replace(
        view, camera=replace(view.camera, width=20, height=16),
        color=np.ascontiguousarray(view.color[:, :16, :20]),
        depth_m=np.ascontiguousarray(view.depth_m[:16, :20]),
    )  # fmt: skip
    lengths, rows = [], []
    for after_keyframe in (True, False):
        gaussians = copied(start[0])
        losses = GaussianOptimizer().optimize(
            gaussians, [small], [0] * 30, effort=4, after_keyframe=after_keyframe
        )
        lengths.append(len(losses))
        rows.append(gaussians.rows.copy())
    assert lengths[0] == lengths[1] < 30
    np.testing.assert_array_equal(*rows)
