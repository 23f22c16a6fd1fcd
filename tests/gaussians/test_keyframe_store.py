import errno
import gc
import logging
import resource
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.calibration.correction import CameraCorrection
from ldo_service.errors import ConfigError, DataError
from ldo_service.gaussians import Exposure
from ldo_service.gaussians.keyframe_store import KeyframeStore, KeyframeStoreConfig
from ldo_service.gaussians.training_views import KeyframeImages, pack, unpack
from ldo_service.geometry import Camera

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
MB_EACH = 64 * 48 * 7 / 1e6  # Size of a keyframe in memory.


def images_of(keyframe: int, *, step_m: float = 0.0, mask: bool = False) -> KeyframeImages:
    """Return images with random color and sloped depth, quantized to `step_m`."""
    rng = np.random.default_rng(keyframe)
    color = rng.integers(0, 256, (3, 48, 64), np.uint8)
    depth = np.linspace(1, 3, 48 * 64).reshape(48, 64) + rng.uniform(0, 0.01, (48, 64))
    depth = np.round(depth / step_m) * step_m if step_m else depth
    depth[:10, :10] = 0
    seen = rng.integers(0, 2, (48, 64), np.uint8) if mask else None
    return KeyframeImages(keyframe, CAMERA, color, depth.astype(np.float32), seen)


def assert_same(a: KeyframeImages | None, b: KeyframeImages) -> None:
    assert a is not None
    assert (a.keyframe, a.camera) == (b.keyframe, b.camera)
    assert a.color.tobytes() == b.color.tobytes()
    assert a.depth_m.tobytes() == b.depth_m.tobytes()
    assert (a.mask is None) == (b.mask is None)
    assert a.mask is None or b.mask is None or a.mask.tobytes() == b.mask.tobytes()


def store_on_disk(folder: Path, keyframes: list[int], **config: float) -> KeyframeStore:
    """Return a store without a cache, so each read is from disk."""
    store = KeyframeStore(folder, KeyframeStoreConfig(cache_mb=0, **config))  # type: ignore[arg-type]
    for keyframe in keyframes:
        store.put(images_of(keyframe))
    return store


def file_of(folder: Path, keyframe: int) -> Path:
    (path,) = folder.glob(f"*{keyframe}.keyframe")
    return path


# --- format -----------------------------------------------------------------------------------
@pytest.mark.parametrize("step_m", [0.0, 0.001, 1 / 5000])
@pytest.mark.parametrize("mask", [False, True])
def test_images_are_restored_bitwise_equal(step_m: float, mask: bool) -> None:
    images = images_of(3, step_m=step_m, mask=mask)
    assert_same(unpack(pack(images)), images)


def test_depth_of_any_bits_is_restored_bitwise_equal() -> None:
    # Any bits, including NaN, -0 and denormals.
    bits = np.random.default_rng(0).integers(0, 2**32, (48, 64), np.uint32)
    images = KeyframeImages(0, CAMERA, images_of(0).color, bits.view(np.float32))
    assert unpack(pack(images)).depth_m.tobytes() == bits.tobytes()


def test_smooth_image_compresses_better_than_noise() -> None:
    ramp = np.add.outer(np.arange(48), 2 * np.arange(64)).astype(np.uint8)
    smooth = KeyframeImages(0, CAMERA, np.stack([ramp] * 3), np.ones((48, 64), np.float32))
    assert 20 * len(pack(smooth)) < smooth.nbytes < 4 * len(pack(images_of(0)))


def test_images_that_mismatch_their_camera_raise() -> None:
    images = images_of(0)
    with pytest.raises(DataError, match=r"depth_m is float32\(48, 63\)"):
        KeyframeImages(0, CAMERA, images.color, images.depth_m[:, 1:])
    with pytest.raises(DataError, match="color"):
        KeyframeImages(0, CAMERA, images.color.transpose(1, 2, 0), images.depth_m)


@pytest.mark.parametrize("body", [b"", b"\x93\x01\x02\x03", b"\xff" * 100])
def test_invalid_bytes_raise(body: bytes) -> None:
    with pytest.raises(DataError, match="cannot be decoded as the images of a keyframe"):
        unpack(body)


def test_view_combines_images_with_pose_and_exposure() -> None:
    images, T = images_of(5, mask=True), np.diag([1.0, -1, -1, 1])
    view = images.view(T, Exposure(np.full(3, 2, np.float32)))
    assert_same(KeyframeImages.of(view), images)
    assert view.T_map_camera is T
    np.testing.assert_array_equal(view.exposure.gain, 2)


# --- the store --------------------------------------------------------------------------------
def test_store_returns_exactly_the_put_keyframes(tmp_path: Path) -> None:
    store = store_on_disk(tmp_path, [7, 3, 12])
    assert store.keyframes() == [3, 7, 12]
    assert len(store) == 3
    assert 7 in store
    assert 8 not in store
    assert store.get(8) is None
    for keyframe in (12, 3, 7, 7):
        assert_same(store.get(keyframe), images_of(keyframe))


def test_store_copies_its_input_and_returns_read_only_arrays(tmp_path: Path) -> None:
    store, images = KeyframeStore(tmp_path), images_of(1)
    store.put(images)
    images.color[...] = 0
    images.depth_m[...] = 0
    assert_same(store.get(1), images_of(1))
    for other in (store, store_on_disk(tmp_path, [])):
        stored = other.get(1)
        assert stored is not None
        with pytest.raises(ValueError, match="read-only"):
            stored.color[...] = 0
        with pytest.raises(ValueError, match="read-only"):
            stored.depth_m[...] = 0


def test_cache_keeps_recently_used_images_within_its_limit(tmp_path: Path) -> None:
    store = KeyframeStore(tmp_path, KeyframeStoreConfig(cache_mb=3.5 * MB_EACH))
    for keyframe in range(4):
        store.put(images_of(keyframe))
        assert store.metrics()["keyframes_cache_mb"] <= 3.5 * MB_EACH
    store.get(1)
    store.put(images_of(4))  # Evicts 2, because 1 was used.
    assert store.metrics()["keyframes_read"] == 0
    for keyframe in (1, 3, 4):
        store.get(keyframe)
    assert store.metrics()["keyframes_read"] == 0
    for keyframe in (0, 2):
        assert_same(store.get(keyframe), images_of(keyframe))
    assert store.metrics()["keyframes_read"] == 2
    assert store.metrics()["keyframes_cache_mb"] == pytest.approx(3 * MB_EACH)


def test_reopened_store_finds_its_keyframes(tmp_path: Path) -> None:
    store_on_disk(tmp_path, [1, 2, 3])
    (tmp_path / "00000009.keyframe.new").write_bytes(b"half")
    (tmp_path / "notes.txt").write_text("not ours")
    restored = store_on_disk(tmp_path, [4])
    assert restored.keyframes() == [1, 2, 3, 4]
    assert_same(restored.get(2), images_of(2))
    assert not (tmp_path / "00000009.keyframe.new").exists()
    assert (tmp_path / "notes.txt").exists()


def test_keep_only_removes_keyframes_unknown_to_the_checkpoint(tmp_path: Path) -> None:
    store = KeyframeStore(tmp_path)
    for keyframe in (1, 2, 3, 4):
        store.put(images_of(keyframe))
    store.keep_only([1, 3, 99])
    assert store.keyframes() == [1, 3]
    assert store.get(4) is None
    assert store_on_disk(tmp_path, []).keyframes() == [1, 3]


def test_temporary_folder_is_removed_with_the_store() -> None:
    store = KeyframeStore(None, KeyframeStoreConfig(cache_mb=0))
    store.put(images_of(1))
    folder = store.files._folder
    assert_same(store.get(1), images_of(1))
    del store
    gc.collect()
    assert not folder.exists()


def test_unusable_folder_raises_with_advice(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="Choose a folder"):
        KeyframeStore(tmp_path / "file")


@pytest.mark.parametrize("change", [{"cache_mb": -1}, {"quota_mb": 0}, {"newest_kept": 0}])
def test_invalid_settings_raise_config_error(change: dict) -> None:
    with pytest.raises(ConfigError):
        KeyframeStoreConfig(**change)


# --- correction of the camera -----------------------------------------------------------------
SEEN = CameraCorrection((0.01, 0.0, -0.02), ((-0.3, 0.0, 0.0), (-0.4, 0.1, 0.0), (-0.5, 0.0, 0.1)))
BETTER = CameraCorrection((0.02, 0.01, 0.0), ((-0.6, 0.0, 0.0),) * 3)


def test_images_are_converted_from_the_stored_ones_with_and_without_a_cache(
    tmp_path: Path,
) -> None:
    stores = KeyframeStore(tmp_path / "a"), store_on_disk(tmp_path / "b", [])
    for store in stores:
        store.convert_to(CameraCorrection())
        store.put(replace(images_of(1), correction=CameraCorrection()))
        for correction in (SEEN, BETTER):
            store.convert_to(correction)
            images = store.get(1)
            assert images is not None
            # Converted twice, the colors would be rounded twice.
            gains = correction.gain(CAMERA).transpose(2, 0, 1)
            assert (
                images.color == (images_of(1).color * gains + np.float32(0.5)).astype("u1")
            ).all()
            expected_m = correction.corrected_depth(images_of(1).depth_m, CAMERA)
            np.testing.assert_allclose(images.depth_m, expected_m, rtol=1e-6)
        store.convert_to(CameraCorrection())
        assert_same(store.get(1), images_of(1))


def test_masked_keyframe_keeps_its_stored_images(tmp_path: Path) -> None:
    store, pixels = KeyframeStore(tmp_path), np.eye(48, 64, dtype=bool)
    store.put(replace(images_of(1), correction=CameraCorrection()))
    store.convert_to(SEEN)
    store.mask_pixels(1, pixels)
    masked = store.get(1)
    assert masked is not None
    assert masked.correction == SEEN
    store.convert_to(CameraCorrection())
    assert_same(store.get(1), replace(images_of(1), mask=(~pixels).astype(np.uint8)))


def test_images_of_unknown_correction_stay_as_they_are(tmp_path: Path) -> None:
    store = store_on_disk(tmp_path, [1])
    assert images_of(1).correction is None
    store.convert_to(SEEN)
    assert_same(store.get(1), images_of(1))


# --- quota ------------------------------------------------------------------------------------
def quota_for(folder: Path, count: int) -> float:
    """Return a quota in MB for `count` and a half keyframes."""
    store = store_on_disk(folder, [0])
    return (count + 0.5) * store.metrics()["keyframes_disk_mb"]


def test_quota_removes_keyframe_with_the_smallest_gap_first(tmp_path: Path) -> None:
    quota_mb = quota_for(tmp_path / "one", 5)
    store = store_on_disk(tmp_path / "many", [0, 10, 13, 20, 30], quota_mb=quota_mb, newest_kept=2)
    store.put(images_of(31))  # Gaps: 13 at 10, 10 at 13, 17 at 20; the two newest are kept.
    assert store.keyframes() == [0, 10, 20, 30, 31]
    store.put(images_of(40))  # Gaps: 20 at 10 and 20, 11 at 30.
    assert store.keyframes() == [0, 10, 20, 31, 40]
    store.put(images_of(50))  # Gaps: 20 at 10, 21 at 20, 20 at 31; the older one goes.
    assert store.keyframes() == [0, 20, 31, 40, 50]
    assert store.metrics()["keyframes_forgotten"] == 3
    assert len(list((tmp_path / "many").iterdir())) == 5


def test_quota_of_a_long_run_keeps_evenly_spaced_keyframes(tmp_path: Path) -> None:
    quota_mb = quota_for(tmp_path / "one", 8)
    store = store_on_disk(tmp_path / "many", list(range(60)), quota_mb=quota_mb, newest_kept=3)
    assert store.metrics()["keyframes_disk_mb"] <= quota_mb
    kept = store.keyframes()
    assert (len(kept), kept[0], kept[-3:]) == (8, 0, [57, 58, 59])
    assert max(np.diff(kept)) <= 4 * 60 / 8


def test_newest_keyframes_are_kept_above_the_quota(tmp_path: Path) -> None:
    store = store_on_disk(tmp_path, list(range(9)), quota_mb=1e-6, newest_kept=4)
    assert store.keyframes() == [0, 5, 6, 7, 8]


def test_keyframe_removed_by_quota_leaves_the_cache(tmp_path: Path) -> None:
    config = KeyframeStoreConfig(quota_mb=1e-6, newest_kept=1)
    store = KeyframeStore(tmp_path, config)
    for keyframe in range(4):
        store.put(images_of(keyframe))
    assert store.keyframes() == [0, 3]
    assert store.get(1) is None


# --- damage -----------------------------------------------------------------------------------
def truncated(data: bytes) -> bytes:
    return data[: len(data) // 2]


def flipped(data: bytes) -> bytes:
    return data[:-7] + bytes([data[-7] ^ 1]) + data[-6:]


def empty(_: bytes) -> bytes:
    return b""


@pytest.mark.parametrize("damage", [truncated, flipped, empty])
def test_damaged_keyframe_is_dropped_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: Callable[[bytes], bytes]
) -> None:
    store = store_on_disk(tmp_path, [1, 2])
    path = file_of(tmp_path, 1)
    path.write_bytes(damage(path.read_bytes()))
    with caplog.at_level(logging.WARNING):
        assert [store.get(1), store.get(1)] == [None, None]
    assert len(caplog.records) == 1
    assert "images of keyframe 1 cannot be read" in caplog.text
    assert store.keyframes() == [2]
    assert not path.exists()
    assert store.metrics()["keyframes_damaged"] == 1


def test_missing_or_renamed_file_is_dropped(tmp_path: Path) -> None:
    store = store_on_disk(tmp_path, [1, 2, 3])
    file_of(tmp_path, 1).rename(file_of(tmp_path, 2))
    assert store.get(1) is None
    assert store.get(2) is None
    assert store.keyframes() == [3]


def test_full_disk_keeps_newest_in_memory_and_logs_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = KeyframeStore(tmp_path, KeyframeStoreConfig(cache_mb=2.5 * MB_EACH))
    store.put(images_of(0))

    def raise_disk_full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(Path, "replace", raise_disk_full)
        for keyframe in (1, 2, 3):
            store.put(images_of(keyframe))
    assert store.keyframes() == [0, 2, 3]
    assert_same(store.get(3), images_of(3))
    assert_same(store.get(0), images_of(0))
    assert store.metrics()["keyframes_not_written"] == 3
    assert len(caplog.records) == 1
    assert "free some disk space" in caplog.text
    store.put(images_of(4))
    assert 4 in store_on_disk(tmp_path, [])


def test_partial_write_leaves_no_file(tmp_path: Path) -> None:
    """RLIMIT_FSIZE makes the write fail halfway."""
    store = store_on_disk(tmp_path, [1])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
        store.put(images_of(2))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert store.metrics()["keyframes_not_written"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["00000001.keyframe"]
    assert_same(store.get(1), images_of(1))
