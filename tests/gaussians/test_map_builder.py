"""Keyframes become a map that looks like them, the same way each time, in bounded memory."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.evaluation.views import psnr
from ldo_service.gaussians import GaussianOptimizerConfig, PruningConfig, render
from ldo_service.gaussians.keyframe_store import KeyframeStoreConfig
from ldo_service.gaussians.map_builder import MapBuilder, MapBuilderConfig, ViewSamplingConfig
from ldo_service.gaussians.visibility import OffloadConfig
from ldo_service.geometry import se3

from .conftest import Posed

KEYFRAMES = (0, 6, 12, 18)
HELD_OUT = (3, 9, 15)


@pytest.fixture(scope="module")
def posed(small_room) -> dict[int, Posed]:
    return {i: small_room(i) for i in sorted((*KEYFRAMES, *HELD_OUT))}


def built(
    posed: dict, config: MapBuilderConfig | None = None, *, iterations: int = 10, **options
) -> MapBuilder:
    builder = MapBuilder(config, **options)
    for keyframe, i in enumerate(KEYFRAMES):
        builder.add(*posed[i], keyframe, iterations)
    return builder


def mean_psnr(builder: MapBuilder, posed: dict, frames=HELD_OUT) -> float:
    values = []
    for i in frames:
        frame, T_map_camera = posed[i]
        seen = render(builder.gaussians.rows, frame.camera, se3.inverse(T_map_camera)).color
        values.append(psnr(seen.clip(0, 1), frame.color / np.float32(255)))
    return float(np.mean(values))


def test_fitting_improves_views_that_it_was_not_fitted_to(posed: dict) -> None:
    inserted, fitted = built(posed, iterations=0), built(posed, iterations=15)
    assert mean_psnr(fitted, posed) > mean_psnr(inserted, posed) + 1
    refined = built(posed, iterations=15)
    refined.refine(60, (1.0, 0.1))
    assert mean_psnr(refined, posed) > mean_psnr(fitted, posed) + 0.5


@pytest.mark.parametrize("threads", [2, 3])
def test_the_same_keyframes_give_the_same_bits(posed: dict, threads: int) -> None:
    config = MapBuilderConfig(
        optimiser=GaussianOptimizerConfig(rotation_rate_rad=1e-4, translation_rate_m=1e-4)
    )
    one, many = (
        built(posed, config, iterations=4),
        built(posed, config, iterations=4, threads=threads),
    )
    assert one.gaussians.rows.tobytes() == many.gaussians.rows.tobytes()
    assert [T.tobytes() for T in one.views.poses.values()] == [
        T.tobytes() for T in many.views.poses.values()
    ]


def test_a_restored_builder_goes_on_as_its_predecessor(posed: dict, tmp_path: Path) -> None:
    first = MapBuilder(folder=tmp_path)
    for keyframe, i in enumerate(KEYFRAMES[:3]):
        first.add(*posed[i], keyframe, 5)
    second = MapBuilder(folder=tmp_path)
    second.restore(first.snapshot())
    for builder in (first, second):
        builder.add(*posed[KEYFRAMES[3]], 3, 5)
        builder.refine(5)
    assert first.gaussians.rows.tobytes() == second.gaussians.rows.tobytes()
    assert first.metrics()["iterations"] == second.metrics()["iterations"]


def test_a_new_journey_finds_nothing_of_another_in_its_folder(posed: dict, tmp_path: Path) -> None:
    built(posed, iterations=0, folder=tmp_path)
    anew = MapBuilder(folder=tmp_path)
    anew.add(*posed[KEYFRAMES[0]], 0, 3)
    assert anew.views.store.keyframes() == [0]


def test_a_darker_camera_leaves_the_brightness_of_the_map(posed: dict) -> None:
    """Its exposure is found before its Gaussians are inserted, and theirs are the map's colours."""
    frame, T = posed[6]
    dark = {**posed, 6: (replace(frame, color=(0.7 * frame.color + 8).astype(np.uint8)), T)}
    builder = built(dark, iterations=4)
    assert np.abs(builder.views.exposures[1].gain - 0.7).max() < 0.06
    assert mean_psnr(builder, posed) > mean_psnr(built(posed, iterations=4), posed) - 1.5


def test_keyframes_that_are_gone_from_the_disk_are_left_out(posed: dict, tmp_path: Path) -> None:
    builder = MapBuilder(folder=tmp_path)
    builder.views.store.config = replace(builder.views.store.config, cache_mb=0)
    for keyframe, i in enumerate(KEYFRAMES[:3]):
        builder.add(*posed[i], keyframe, 2)
    for file in sorted((tmp_path / "images").iterdir())[:2]:
        file.write_bytes(file.read_bytes()[:-20])
    builder.add(*posed[KEYFRAMES[3]], 3, 20)
    assert builder.views.store.keyframes() == [2, 3]
    assert builder.metrics()["keyframes_skipped"] >= 2


def test_pruning_looks_at_what_was_fitted_alone(posed: dict) -> None:
    config = MapBuilderConfig(pruning=PruningConfig(min_opacity=0.9), prune_keyframes=1)
    builder = built(posed, config, iterations=3)
    assert builder.metrics()["gaussians_pruned"] > 100
    assert (1 / (1 + np.exp(-builder.gaussians.opacity_logits))).min() < 0.9 + 0.1


def test_a_correction_moves_gaussians_and_view_together(posed: dict) -> None:
    builder = built(posed, iterations=2)
    before = mean_psnr(builder, posed, KEYFRAMES[:1])
    T_new_old = se3.exp(np.array([0.1, -0.2, 0.05, 0.3, 0.1, -0.2]))
    builder.move(dict.fromkeys(range(len(KEYFRAMES)), T_new_old))
    frame, T = posed[KEYFRAMES[0]]
    np.testing.assert_allclose(builder.views.poses[0], T_new_old @ T, atol=1e-12)
    moved = {KEYFRAMES[0]: (frame, T_new_old @ T)}
    assert abs(mean_psnr(builder, moved, KEYFRAMES[:1]) - before) < 0.1
    assert builder.refined() == {}, "who moved it knows"


def test_moved_keyframes_are_told_once(posed: dict) -> None:
    config = MapBuilderConfig(
        optimiser=GaussianOptimizerConfig(rotation_rate_rad=1e-3, translation_rate_m=1e-3)
    )
    builder = built(posed, config, iterations=10)
    refined = builder.refined()
    assert refined
    assert 0 not in refined, "the first one fixes the place of the map"
    assert builder.refined() == {}


def elsewhere(posed: dict, x_m: float) -> dict:
    """The same walk in another place: nothing is seen from the first."""
    T = np.eye(4)
    T[0, 3] = x_m
    return {i: (frame, T @ pose) for i, (frame, pose) in posed.items()}


def with_sleepers(posed: dict, **options) -> MapBuilder:
    """A map whose first half, seen from the first keyframes, sleeps for the most part."""
    config = MapBuilderConfig(sleep=OffloadConfig(max_active=2000, reach_m=20), recent_cameras=2)
    builder, far = MapBuilder(config, **options), elsewhere(posed, 100.0)
    for keyframe, i in enumerate(KEYFRAMES):
        builder.add(*posed[i], keyframe, 2)
        builder.changes(with_changed=True)
    for keyframe, i in enumerate(KEYFRAMES, len(KEYFRAMES)):
        builder.add(*far[i], keyframe, 2)
        builder.changes(with_changed=True)
        builder.offload_excess()
    return builder


def test_what_no_camera_sees_sleeps_and_wakes_as_it_was(posed: dict) -> None:
    builder = with_sleepers(posed)
    asleep = builder.metrics()["gaussians_offloaded"]
    assert asleep > 1000
    assert builder.size() == len(builder.gaussians) + asleep
    whole = np.concatenate([piece.ids for piece in builder.batches()])
    assert np.all(np.diff(whole) > 0)
    assert len(whole) == builder.size()
    see_sleepers = [k for k in builder.views.cameras if not builder.is_resident(k)]
    assert len(see_sleepers) > 1
    assert builder.refine(12) == 12
    assert builder.refine(2, first=see_sleepers[:2]) == 0, "views of what sleeps are left out"
    size = builder.size()
    builder.add(*posed[KEYFRAMES[0]], 2 * len(KEYFRAMES), 0)  # home again
    assert builder.metrics()["gaussians_loaded_total"] > 1000
    assert builder.size() < 1.15 * size, "inserted a second time"
    assert mean_psnr(builder, posed, KEYFRAMES[:1]) > 20


def test_followers_are_told_what_was_lost_on_disk(posed: dict, tmp_path: Path) -> None:
    builder = with_sleepers(posed, folder=tmp_path)
    before = np.concatenate([piece.ids for piece in builder.batches()])
    for file in sorted((tmp_path / "gaussians").iterdir())[:2]:
        file.write_bytes(file.read_bytes()[:-20])
    after = np.concatenate([piece.ids for piece in builder.batches()])
    assert len(after) < len(before)
    removed = builder.changes(with_changed=False).removed
    assert np.setdiff1d(before, removed).tolist() == after.tolist()
    assert builder.changes(with_changed=False).removed.tolist() == []


@pytest.mark.parametrize(
    "change",
    [
        {"newest_share": 0.8, "covisible_share": 0.3},
        {"newest_share": -0.1},
        {"recent": -1},
        {"min_shared": 1.5},
    ],
)
def test_senseless_windows_are_refused(change: dict) -> None:
    with pytest.raises(ConfigError):
        ViewSamplingConfig(**change)


def test_what_moves_is_neither_mapped_nor_fitted(posed: dict) -> None:
    frame, T_map_camera = posed[0]
    dynamic_mask = np.zeros(frame.depth_m.shape, bool)
    dynamic_mask[15:40, 20:50] = True
    repainted = replace(
        frame, color=np.where(dynamic_mask[..., None], 255 - frame.color, frame.color)
    )
    maps = []
    for seen in (frame, repainted):
        builder = MapBuilder()
        builder.add(seen, T_map_camera, 0, 4, dynamic_mask)
        maps.append(builder.gaussians.rows)
    assert maps[0].tobytes() == maps[1].tobytes(), "what moves has a say"
    p_camera = se3.transform(se3.inverse(T_map_camera), maps[0][:, :3].astype(float))
    u, v = frame.camera.project(p_camera).round().astype(int).T
    inside = (u > 20) & (u < 49) & (v > 15) & (v < 39)
    assert not inside.any()
    assert len(maps[0]) > 100


def test_a_keyframe_without_images_is_known_by_its_pose_alone(posed: dict, tmp_path: Path) -> None:
    """And a successor goes on with the same bits."""
    config = MapBuilderConfig(
        store=KeyframeStoreConfig(cache_mb=0.0, most=2, newest_kept=1), prune_keyframes=2
    )
    first, second = (MapBuilder(config, folder=tmp_path / name) for name in ("first", "second"))
    for keyframe, i in enumerate(KEYFRAMES[:3]):
        first.add(*posed[i], keyframe, 5)
    assert list(first.views.cameras) == [0, 2]
    assert list(first.views.poses) == [0, 1, 2]
    assert first.deduplicate_keyframe(1, 5) == 0
    shutil.copytree(tmp_path / "first", tmp_path / "second", dirs_exist_ok=True)
    second = MapBuilder(config, folder=tmp_path / "second")
    second.restore(first.snapshot())
    T_new_old = se3.exp(np.full(6, 0.01))
    for builder in (first, second):
        builder.move(dict.fromkeys(range(3), T_new_old))
        builder.add(*posed[KEYFRAMES[3]], 3, 5)
        builder.refine(5)
        assert builder.refined().keys() <= {0, 3}
    assert first.gaussians.rows.tobytes() == second.gaussians.rows.tobytes()
    np.testing.assert_array_equal(first.views.poses[1], T_new_old @ posed[KEYFRAMES[1]][1])
