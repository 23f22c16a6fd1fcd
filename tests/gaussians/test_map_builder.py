"""Map builder: quality, determinism, restart and offloading."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.calibration.correction import CameraCorrection
from ldo_service.errors import ConfigError
from ldo_service.evaluation.views import psnr
from ldo_service.gaussians import GaussianOptimizerConfig, PruningConfig, render
from ldo_service.gaussians.fitting import ViewSamplingConfig
from ldo_service.gaussians.keyframe_store import KeyframeStoreConfig
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.gaussians.visibility import OffloadConfig
from ldo_service.geometry import se3

from .conftest import Posed

KEYFRAMES = (0, 6, 12, 18)
HELD_OUT = (3, 9, 15)


@pytest.fixture(scope="module")
def posed_frames(small_room) -> dict[int, Posed]:
    return {i: small_room(i) for i in sorted((*KEYFRAMES, *HELD_OUT))}


def build_map(
    posed_frames: dict, config: MapBuilderConfig | None = None, *, iterations: int = 10, **options
) -> MapBuilder:
    builder = MapBuilder(config, **options)
    for keyframe, i in enumerate(KEYFRAMES):
        builder.add(*posed_frames[i], keyframe, iterations)
    return builder


def mean_psnr(builder: MapBuilder, posed_frames: dict, frames=HELD_OUT) -> float:
    values = []
    for i in frames:
        frame, T_map_camera = posed_frames[i]
        rendered = render(builder.gaussians.rows, frame.camera, se3.inverse(T_map_camera)).color
        values.append(psnr(rendered.clip(0, 1), frame.color / np.float32(255)))
    return float(np.mean(values))


def test_optimization_improves_held_out_views(posed_frames: dict) -> None:
    inserted, fitted = build_map(posed_frames, iterations=0), build_map(posed_frames, iterations=15)
    assert mean_psnr(fitted, posed_frames) > mean_psnr(inserted, posed_frames) + 1
    refined = build_map(posed_frames, iterations=15)
    refined.refine(60, (1.0, 0.1))
    assert mean_psnr(refined, posed_frames) > mean_psnr(fitted, posed_frames) + 0.5


@pytest.mark.parametrize("threads", [2, 3])
def test_map_is_bitwise_equal_for_any_thread_count(posed_frames: dict, threads: int) -> None:
    config = MapBuilderConfig(
        optimizer=GaussianOptimizerConfig(rotation_rate_rad=1e-4, translation_rate_m=1e-4)
    )
    one, many = (
        build_map(posed_frames, config, iterations=4),
        build_map(posed_frames, config, iterations=4, threads=threads),
    )
    assert one.gaussians.rows.tobytes() == many.gaussians.rows.tobytes()
    assert [T.tobytes() for T in one.views.poses.values()] == [
        T.tobytes() for T in many.views.poses.values()
    ]


def test_restored_builder_continues_bitwise_equal(posed_frames: dict, tmp_path: Path) -> None:
    first = MapBuilder(folder=tmp_path)
    for keyframe, i in enumerate(KEYFRAMES[:3]):
        first.add(*posed_frames[i], keyframe, 5)
    second = MapBuilder(folder=tmp_path)
    second.restore(first.snapshot())
    for builder in (first, second):
        builder.add(*posed_frames[KEYFRAMES[3]], 3, 5)
        builder.refine(5)
    assert first.gaussians.rows.tobytes() == second.gaussians.rows.tobytes()
    assert first.metrics()["iterations"] == second.metrics()["iterations"]


def test_new_map_ignores_earlier_keyframes_in_its_folder(
    posed_frames: dict, tmp_path: Path
) -> None:
    build_map(posed_frames, iterations=0, folder=tmp_path)
    fresh = MapBuilder(folder=tmp_path)
    fresh.add(*posed_frames[KEYFRAMES[0]], 0, 3)
    assert fresh.views.store.keyframes() == [0]


def test_darker_keyframe_keeps_the_brightness_of_the_map(posed_frames: dict) -> None:
    """The exposure is estimated before densification, so new Gaussians have the map's colors."""
    frame, T = posed_frames[6]
    darkened = {
        **posed_frames,
        6: (replace(frame, color=(0.7 * frame.color + 8).astype(np.uint8)), T),
    }
    builder = build_map(darkened, iterations=4)
    assert np.abs(builder.views.exposures[1].gain - 0.7).max() < 0.07  # A prior pulls it to 1.
    undarkened = build_map(posed_frames, iterations=4)
    assert mean_psnr(builder, posed_frames) > mean_psnr(undarkened, posed_frames) - 1.5


def test_late_estimate_of_the_vignetting_corrects_the_map_and_its_keyframes(
    posed_frames: dict, tmp_path: Path
) -> None:
    """The first keyframes were mapped as the camera recorded them, with dark corners."""
    vignetting = CameraCorrection(vignetting=((-0.8, 0.0, 0.0),) * 3)
    # The strongest vignetting divided by that of a pixel.
    gain = vignetting.gain(posed_frames[0][0].camera)
    recorded = {
        i: (replace(frame, color=(frame.color * (gain.min() / gain)).astype(np.uint8)), T)
        for i, (frame, T) in posed_frames.items()
    }

    def mapped(corrections: tuple[CameraCorrection, ...]) -> MapBuilder:
        builder = MapBuilder(folder=tmp_path)
        for keyframe, (i, correction) in enumerate(zip(KEYFRAMES, corrections, strict=True)):
            frame, T = recorded[i]
            builder.add(correction.applied(frame), T, keyframe, 10, correction=correction)
        return builder

    none = CameraCorrection()
    before = mapped((none,) * 4)
    late = mapped((none, none, none, vignetting))
    factor = gain[gain.shape[0] // 2, gain.shape[1] // 2]
    np.testing.assert_allclose(late.views.exposures[0].gain, factor)
    np.testing.assert_allclose(before.views.exposures[0].gain, 1)
    converted = late.views[1].color.transpose(1, 2, 0)
    flat = posed_frames[KEYFRAMES[1]][0].color * gain.min()
    assert np.abs(converted - flat).max() < 2
    late.refine(60)
    before.refine(60)
    assert mean_psnr(late, posed_frames) > mean_psnr(before, posed_frames) + 3
    restored = MapBuilder(folder=tmp_path)
    restored.restore(late.snapshot())
    for keyframe in range(4):
        assert (restored.views[keyframe].color == late.views[keyframe].color).all()
    assert restored.views.store.correction == vignetting


def test_state_of_an_older_version_keeps_its_exposures_and_images(
    posed_frames: dict, tmp_path: Path
) -> None:
    """Older versions saved no correction, so the images of their keyframes are not converted."""
    vignetting = CameraCorrection(vignetting=((-0.8, 0.0, 0.0),) * 3)
    first = build_map(posed_frames, iterations=0, folder=tmp_path)
    state = first.snapshot()
    for key in ("correction", "unconverted"):
        del state["views"][key]
    for keyframe in first.views.cameras:
        images = first.views.store.get(keyframe)
        assert images is not None
        first.views.store.put(replace(images, correction=None))
    restored = MapBuilder(folder=tmp_path)
    restored.restore(state)
    gains = [exposure.gain.tolist() for exposure in restored.views.exposures.values()]
    restored.views.convert_to(CameraCorrection())
    restored.views.convert_to(vignetting)
    assert [exposure.gain.tolist() for exposure in restored.views.exposures.values()] == gains
    assert (restored.views[1].color == first.views[1].color).all()
    again = MapBuilder(folder=tmp_path)
    again.restore(restored.snapshot())
    again.views.convert_to(CameraCorrection())
    assert [exposure.gain.tolist() for exposure in again.views.exposures.values()] == gains


def test_black_rim_of_rectification_is_not_mapped(posed_frames: dict) -> None:
    """A keyframe whose rim is black must not darken the surface that other keyframes see."""
    rim = np.ones((*posed_frames[0][0].depth_m.shape, 1), bool)
    rim[12:-12, 12:-12] = False
    cut = {
        i: (
            replace(frame, color=frame.color * ~rim, depth_m=frame.depth_m * ~rim[..., 0])
            if i != KEYFRAMES[0]
            else frame,
            T,
        )
        for i, (frame, T) in posed_frames.items()
    }
    builder = build_map(cut, iterations=10)
    mask = builder.views[1].mask
    assert mask is not None
    assert (mask == 0)[:13].all()
    assert (mask > 0)[13:-13, 13:-13].all()
    assert builder.views[0].mask is None
    frame, T_map_camera = posed_frames[KEYFRAMES[0]]
    rendered = render(builder.gaussians.rows, frame.camera, se3.inverse(T_map_camera)).color
    whole = build_map(posed_frames, iterations=10)
    expected = render(whole.gaussians.rows, frame.camera, se3.inverse(T_map_camera)).color
    seen = frame.color / np.float32(255)
    assert psnr(rendered.clip(0, 1), seen) > psnr(expected.clip(0, 1), seen) - 1


def test_keyframes_damaged_on_disk_are_skipped(posed_frames: dict, tmp_path: Path) -> None:
    builder = MapBuilder(folder=tmp_path)
    builder.views.store.config = replace(builder.views.store.config, cache_mb=0)
    for keyframe, i in enumerate(KEYFRAMES[:3]):
        builder.add(*posed_frames[i], keyframe, 2)
    for file in sorted((tmp_path / "images").iterdir())[:2]:
        file.write_bytes(file.read_bytes()[:-20])
    builder.add(*posed_frames[KEYFRAMES[3]], 3, 20)
    assert builder.views.store.keyframes() == [2, 3]
    assert builder.metrics()["keyframes_skipped"] >= 2


def test_pruning_removes_transparent_gaussians(posed_frames: dict) -> None:
    config = MapBuilderConfig(pruning=PruningConfig(min_opacity=0.9), prune_keyframes=1)
    builder = build_map(posed_frames, config, iterations=3)
    assert builder.metrics()["gaussians_pruned"] > 100
    assert (1 / (1 + np.exp(-builder.gaussians.opacity_logits))).min() < 0.9 + 0.1


def test_correction_moves_gaussians_and_views_together(posed_frames: dict) -> None:
    builder = build_map(posed_frames, iterations=2)
    before = mean_psnr(builder, posed_frames, KEYFRAMES[:1])
    T_new_old = se3.exp(np.array([0.1, -0.2, 0.05, 0.3, 0.1, -0.2]))
    builder.move_keyframes(dict.fromkeys(range(len(KEYFRAMES)), T_new_old))
    frame, T = posed_frames[KEYFRAMES[0]]
    np.testing.assert_allclose(builder.views.poses[0], T_new_old @ T, atol=1e-12)
    moved = {KEYFRAMES[0]: (frame, T_new_old @ T)}
    assert abs(mean_psnr(builder, moved, KEYFRAMES[:1]) - before) < 0.1
    assert builder.refined() == {}, "moves from outside are not reported"


def test_refined_poses_are_reported_once(posed_frames: dict) -> None:
    config = MapBuilderConfig(
        optimizer=GaussianOptimizerConfig(rotation_rate_rad=1e-3, translation_rate_m=1e-3)
    )
    builder = build_map(posed_frames, config, iterations=10)
    refined = builder.refined()
    assert refined
    assert 0 not in refined, "the first keyframe fixes the map frame"
    assert builder.refined() == {}


def displaced_frames(posed_frames: dict, x_m: float) -> dict:
    """Return the frames at poses displaced by x_m, out of view of the others."""
    T = np.eye(4)
    T[0, 3] = x_m
    return {i: (frame, T @ pose) for i, (frame, pose) in posed_frames.items()}


def map_with_offloaded(posed_frames: dict, **options) -> MapBuilder:
    """Return a map with most Gaussians of its first half offloaded."""
    config = MapBuilderConfig(offload=OffloadConfig(max_active=2000, reach_m=20), recent_cameras=2)
    builder, displaced = MapBuilder(config, **options), displaced_frames(posed_frames, 100.0)
    for keyframe, i in enumerate(KEYFRAMES):
        builder.add(*posed_frames[i], keyframe, 2)
        builder.changes(with_changed=True)
    for keyframe, i in enumerate(KEYFRAMES, len(KEYFRAMES)):
        builder.add(*displaced[i], keyframe, 2)
        builder.changes(with_changed=True)
        builder.offload_excess()
    return builder


def test_offloaded_gaussians_are_loaded_when_revisited(posed_frames: dict) -> None:
    builder = map_with_offloaded(posed_frames)
    offloaded = builder.metrics()["gaussians_offloaded"]
    assert offloaded > 1000
    assert builder.size() == len(builder.gaussians) + offloaded
    all_ids = np.concatenate([batch.ids for batch in builder.batches()])
    assert np.all(np.diff(all_ids) > 0)
    assert len(all_ids) == builder.size()
    keyframes_of_offloaded = [k for k in builder.views.cameras if not builder.is_resident(k)]
    assert len(keyframes_of_offloaded) > 1
    assert builder.refine(12) == 12
    assert builder.refine(2, first=keyframes_of_offloaded[:2]) == 0, (
        "views of offloaded Gaussians are skipped"
    )
    size = builder.size()
    builder.add(*posed_frames[KEYFRAMES[0]], 2 * len(KEYFRAMES), 0)  # Back at the first pose.
    assert builder.metrics()["gaussians_loaded_total"] > 1000
    assert builder.size() < 1.15 * size, "the Gaussians are not inserted a second time"
    assert mean_psnr(builder, posed_frames, KEYFRAMES[:1]) > 20


def test_gaussians_lost_on_disk_are_published_as_removed(
    posed_frames: dict, tmp_path: Path
) -> None:
    builder = map_with_offloaded(posed_frames, folder=tmp_path)
    before = np.concatenate([batch.ids for batch in builder.batches()])
    for file in sorted((tmp_path / "gaussians").iterdir())[:2]:
        file.write_bytes(file.read_bytes()[:-20])
    after = np.concatenate([batch.ids for batch in builder.batches()])
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
def test_invalid_sampling_settings_raise_config_error(change: dict) -> None:
    with pytest.raises(ConfigError):
        ViewSamplingConfig(**change)


def test_dynamic_pixels_do_not_affect_the_map(posed_frames: dict) -> None:
    frame, T_map_camera = posed_frames[0]
    dynamic_mask = np.zeros(frame.depth_m.shape, bool)
    dynamic_mask[15:40, 20:50] = True
    repainted = replace(
        frame, color=np.where(dynamic_mask[..., None], 255 - frame.color, frame.color)
    )
    maps = []
    for observed in (frame, repainted):
        builder = MapBuilder()
        builder.add(observed, T_map_camera, 0, 4, dynamic_mask)
        maps.append(builder.gaussians.rows)
    assert maps[0].tobytes() == maps[1].tobytes(), "dynamic pixels affect the map"
    p_camera = se3.transform(se3.inverse(T_map_camera), maps[0][:, :3].astype(float))
    u, v = frame.camera.project(p_camera).round().astype(int).T
    inside = (u > 20) & (u < 49) & (v > 15) & (v < 39)
    assert not inside.any()
    assert len(maps[0]) > 100


def test_keyframe_without_images_keeps_only_its_pose(posed_frames: dict, tmp_path: Path) -> None:
    """A restored builder continues bitwise equal."""
    config = MapBuilderConfig(
        store=KeyframeStoreConfig(cache_mb=0.0, max_keyframes=2, newest_kept=1), prune_keyframes=2
    )
    first, second = (MapBuilder(config, folder=tmp_path / name) for name in ("first", "second"))
    for keyframe, i in enumerate(KEYFRAMES[:3]):
        first.add(*posed_frames[i], keyframe, 5)
    assert list(first.views.cameras) == [0, 2]
    assert list(first.views.poses) == [0, 1, 2]
    assert first.deduplicate_keyframe(1, 5) == 0
    shutil.copytree(tmp_path / "first", tmp_path / "second", dirs_exist_ok=True)
    second = MapBuilder(config, folder=tmp_path / "second")
    second.restore(first.snapshot())
    T_new_old = se3.exp(np.full(6, 0.01))
    for builder in (first, second):
        builder.move_keyframes(dict.fromkeys(range(3), T_new_old))
        builder.add(*posed_frames[KEYFRAMES[3]], 3, 5)
        builder.refine(5)
        assert builder.refined().keys() <= {0, 3}
    assert first.gaussians.rows.tobytes() == second.gaussians.rows.tobytes()
    np.testing.assert_array_equal(first.views.poses[1], T_new_old @ posed_frames[KEYFRAMES[1]][1])
