from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.gaussians import (
    AdamConfig,
    Exposure,
    GaussianMap,
    Optimised,
    Optimiser,
    OptimiserConfig,
    View,
    insert,
    render,
)
from ldo_service.geometry import RgbdFrame, se3


@pytest.fixture(scope="module")
def start(room) -> tuple[GaussianMap, list[View]]:
    """A map of three views of the synthetic room, of a quarter of its size."""
    truth, gaussians, views = room.truth(), GaussianMap(), []
    for i in (0, 4, 8):
        frame, T_map_camera = halved(halved(room[i])), truth.T_world_camera[i]
        insert(gaussians, frame, T_map_camera, i)
        views.append(View.of(frame, T_map_camera, i))
    return gaussians, views


def halved(frame: RgbdFrame) -> RgbdFrame:
    size = (frame.camera.height // 2, 2, frame.camera.width // 2, 2, -1)
    color = frame.color.astype(float).reshape(size).mean(axis=(1, 3))
    depth_m = frame.depth_m.reshape(size).mean(axis=(1, 3))[..., 0]
    return RgbdFrame(np.round(color).astype(np.uint8), depth_m, frame.camera.halved())


def copied(gaussians: GaussianMap) -> GaussianMap:
    return GaussianMap.restore(gaussians.snapshot())


def optimised(
    start: tuple, config: OptimiserConfig | None = None, *, iterations: int = 30, threads: int = 1
) -> tuple[GaussianMap, Optimised]:
    gaussians, views = copied(start[0]), start[1]
    optimiser = Optimiser(config, threads=threads)
    return gaussians, optimiser.optimise(gaussians, views, iterations, np.random.default_rng(0))


def mean_psnr(gaussians: GaussianMap, views: list[View]) -> float:
    """Of the whole images, exposures applied."""
    errors = []
    for view in views:
        seen = render(gaussians.rows, view.camera, se3.inverse(view.T_map_camera))
        truth = view.color.transpose(1, 2, 0) / 255
        errors.append(np.mean((view.exposure.applied(seen.color) - truth) ** 2))
    return float(np.mean(-10 * np.log10(errors)))


def test_views_look_better_after_optimisation(start: tuple) -> None:
    gaussians, result = optimised(start, iterations=60)
    assert mean_psnr(gaussians, result.views) > mean_psnr(*start) + 3
    newest = [loss.total for i, loss in zip(result.taken, result.losses, strict=True) if i == 2]
    assert newest[-1] < 0.7 * newest[0]
    assert gaussians.version > start[0].version


@pytest.mark.parametrize("threads", [2, 3])
def test_same_inputs_give_the_same_bits_for_any_number_of_threads(
    start: tuple, threads: int
) -> None:
    config = OptimiserConfig(rotation_rate_rad=1e-4, translation_rate_m=1e-4)
    one, a = optimised(start, config, iterations=6)
    many, b = optimised(start, config, iterations=6, threads=threads)
    assert one.rows.tobytes() == many.rows.tobytes()
    assert a.taken == b.taken
    assert [x.total for x in a.losses] == [x.total for x in b.losses]
    for left, right in zip(a.views, b.views, strict=True):
        assert left.T_map_camera.tobytes() == right.T_map_camera.tobytes()
        assert left.exposure.matrix.tobytes() == right.exposure.matrix.tobytes()


def test_restored_optimiser_continues_as_the_original(start: tuple) -> None:
    gaussians, views = copied(start[0]), start[1]
    config = OptimiserConfig(rotation_rate_rad=1e-4)
    original = Optimiser(config)
    views = original.optimise(gaussians, views, 5, np.random.default_rng(1)).views
    copy, other = Optimiser(config), copied(gaussians)
    copy.restore(original.snapshot())
    a, b = (
        optimiser.optimise(rows, views, 5, np.random.default_rng(2))
        for optimiser, rows in ((original, gaussians), (copy, other))
    )
    assert gaussians.rows.tobytes() == other.rows.tobytes()
    assert a.views[2].T_map_camera.tobytes() == b.views[2].T_map_camera.tobytes()
    before, after = original.snapshot(), copy.snapshot()
    assert before.keys() == after.keys()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def test_brightness_of_a_frame_goes_into_its_exposure(start: tuple) -> None:
    darker = replace(start[1][2], color=(start[1][2].color * 0.8).astype(np.uint8))
    config = OptimiserConfig(adam=AdamConfig(color=0.001), exposure_prior=0.0)
    _, result = optimised((start[0], [*start[1][:2], darker]), config, iterations=90)
    shown = result.views[2].exposure.applied(np.full((1, 1, 3), 0.5, np.float32))
    assert np.abs(shown - 0.4).max() < 0.04
    assert result.views[0].exposure.matrix.tobytes() == Exposure().matrix.tobytes()


def test_wrong_pose_comes_back_to_the_true_one(start: tuple) -> None:
    gaussians, views = optimised(start, iterations=150)[0], start[1]
    off = se3.exp(np.array([0.004, -0.003, 0.002, 0.01, -0.008, 0.006]))
    moved = [*views[:2], replace(views[2], T_map_camera=views[2].T_map_camera @ off)]
    config = OptimiserConfig(
        adam=AdamConfig(0, 0, 0, 0, 0),
        newest_share=1.0,
        covisible_share=0.0,
        rotation_rate_rad=3e-4,
        translation_rate_m=5e-4,
    )
    _, result = optimised((gaussians, moved), config, iterations=150)
    left = se3.inverse(views[2].T_map_camera) @ result.views[2].T_map_camera
    assert np.linalg.norm(left[:3, 3]) < 0.15 * np.linalg.norm(off[:3, 3])
    assert se3.rotation_angle(left) < 0.15 * se3.rotation_angle(off)


def test_steps_shrink_to_the_final_rate(start: tuple) -> None:
    gaussians, views = copied(start[0]), start[1]
    before = gaussians.colors.copy()
    Optimiser().optimise(gaussians, views, 1, np.random.default_rng(0))
    first = np.abs(gaussians.colors - before).max()
    optimiser, rng = Optimiser(), np.random.default_rng(0)
    optimiser.optimise(gaussians, views, 20, rng, final_rate=0.01)
    before = gaussians.colors.copy()
    optimiser.step(gaussians, views[2], rate=0.01)
    assert np.abs(gaussians.colors - before).max() < 0.05 * first


def test_poses_stay_unless_they_are_to_be_refined(start: tuple) -> None:
    _, result = optimised(start, iterations=4)
    for before, after in zip(start[1], result.views, strict=True):
        assert before.T_map_camera is after.T_map_camera


def test_without_views_or_iterations_nothing_changes(start: tuple) -> None:
    gaussians = copied(start[0])
    for views, iterations in (([], 10), (start[1], 0)):
        result = Optimiser().optimise(gaussians, views, iterations, np.random.default_rng(0))
        assert result.losses == []
    assert gaussians.rows.tobytes() == start[0].rows.tobytes()


def test_gaussians_come_and_go_between_two_calls(start: tuple) -> None:
    gaussians, views = copied(start[0]), start[1]
    optimiser, rng = Optimiser(), np.random.default_rng(0)
    optimiser.optimise(gaussians, views, 3, rng)
    gaussians.remove(gaussians.ids % 3 == 0)
    gaussians.add(start[0].rows[:50].copy(), 9)
    before = mean_psnr(gaussians, views)
    result = optimiser.optimise(gaussians, views, 30, rng)
    assert np.isfinite(gaussians.rows).all()
    assert mean_psnr(gaussians, result.views) > before


@pytest.mark.parametrize(
    "change",
    [
        {"newest_share": 0.8, "covisible_share": 0.3},
        {"newest_share": -0.1},
        {"exposure_rate": -1.0},
        {"translation_rate_m": -1.0},
        {"max_needle_ratio": 0.5},
    ],
)
def test_senseless_configuration_is_refused(change: dict) -> None:
    with pytest.raises(ConfigError):
        OptimiserConfig(**change)
