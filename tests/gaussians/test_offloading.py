import errno
import gc
import logging
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldo_service.errors import ConfigError, DataError
from ldo_service.gaussians import GaussianMap, render
from ldo_service.gaussians.chunk import Chunk, pack, unpack
from ldo_service.gaussians.offloading import MAX_MOTIONS, OffloadedGaussians, iter_all_gaussians
from ldo_service.gaussians.visibility import (
    BoundingSpheres,
    OffloadConfig,
    PlacedCamera,
    chunk_numbers,
    plan_offload,
)
from ldo_service.geometry import Camera, se3

from .conftest import labels_of

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
MOTION = se3.exp(np.array([0.4, -1.1, 0.7, 0.5, -0.6, 0.2]))
POSES = {k: se3.exp(np.array([0.1 * k, 0, -0.2, k, 0, 1])) for k in range(20)}


def rows_of(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(n, 16)).astype(np.float32)
    rows[:, 6:10] /= np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    return rows


def map_of(*counts: int) -> GaussianMap:
    out = GaussianMap()
    for keyframe, n in enumerate(counts):
        out.add(rows_of(n, keyframe), keyframe)
    out.labels[:] = labels_of(len(out))
    return out


def chunk_of(anchor: int, first_id: int, n: int) -> Chunk:
    return Chunk(anchor, np.arange(first_id, first_id + n), rows_of(n), labels_of(n))


def offload_anchors(
    gaussians: GaussianMap, offloaded: OffloadedGaussians, anchors: Iterable[int]
) -> list[int]:
    """Offload one chunk for each anchor and return the chunk numbers."""
    return offloaded.offload_from(gaussians, gaussians.anchors, anchors)


def all_arrays(gaussians: GaussianMap, offloaded: OffloadedGaussians) -> list[np.ndarray]:
    """Return ids, rows, anchors and labels of all Gaussians, resident or offloaded."""
    batches = list(iter_all_gaussians(gaussians, offloaded))
    return [np.concatenate(arrays) for arrays in zip(*batches, strict=True)]


def assert_equals(
    gaussians: GaussianMap, offloaded: OffloadedGaussians, reference: GaussianMap
) -> None:
    for actual, expected in zip(all_arrays(gaussians, offloaded), reference.all(), strict=True):
        assert actual.tobytes() == expected.tobytes()


# --- one chunk --------------------------------------------------------------------------------
def test_chunk_is_restored_bitwise_equal() -> None:
    ids = np.array([3, 4, 9, 2**40])
    chunk = unpack(pack(Chunk(7, ids, rows_of(4), labels_of(4))))
    assert (chunk.anchor, chunk.ids.tolist()) == (7, ids.tolist())
    assert chunk.rows.dtype == np.float32
    assert chunk.rows.tobytes() == rows_of(4).tobytes()
    assert chunk.labels.tobytes() == labels_of(4).tobytes()
    np.testing.assert_array_equal(chunk.anchors, np.full(4, 7, np.int32))


def test_chunk_of_an_earlier_version_raises_with_the_reason() -> None:
    with pytest.raises(DataError, match="4 Gaussians without labels"):
        unpack(pack(Chunk(7, np.arange(4), rows_of(4), labels_of(0))))


@pytest.mark.parametrize(
    "body", [b"", b"no zstd", pack(Chunk(0, np.arange(3), rows_of(1), labels_of(1)))]
)
def test_invalid_bytes_raise(body: bytes) -> None:
    with pytest.raises(DataError, match="cannot be decoded as Gaussians"):
        unpack(body)


def test_gaussians_of_an_unmoved_anchor_are_loaded_bitwise_equal(tmp_path: Path) -> None:
    offloaded, rows_before = OffloadedGaussians(tmp_path), rows_of(5)
    rows_before[:, [0, 7, 14]] = -0.0  # Any motion would change the sign of zero.
    number = offloaded.put(Chunk(2, np.arange(10, 15), rows_before, labels_of(5)))
    assert number is not None
    assert offloaded.numbers() == [number]
    assert len(offloaded) == 5
    offloaded.move_anchors({1: MOTION, 3: MOTION})
    chunk = offloaded.load(number)
    assert (chunk.anchor, chunk.ids.tolist()) == (2, [10, 11, 12, 13, 14])
    assert chunk.rows.tobytes() == rows_before.tobytes()
    assert chunk.labels.tobytes() == labels_of(5).tobytes()
    assert offloaded.numbers() == []
    with pytest.raises(KeyError):
        offloaded.load(number)


@pytest.mark.parametrize("motions", [1, 3, MAX_MOTIONS + 3])
def test_offloaded_gaussians_move_like_resident_ones(tmp_path: Path, motions: int) -> None:
    offloaded, gaussians, reference = OffloadedGaussians(tmp_path), map_of(50, 40), map_of(50, 40)
    offload_anchors(gaussians, offloaded, [0])
    for k in range(motions):
        T_new_old = {0: se3.exp(0.1 * (k + 1) * se3.log(MOTION))}
        offloaded.move_anchors(T_new_old)
        gaussians.move_anchors(T_new_old)
        reference.move_anchors(T_new_old)
    assert np.abs(reference.rows[:50] - rows_of(50)).max() > 0.01
    assert_equals(gaussians, offloaded, reference)
    assert offloaded.snapshot()["motion_counts"].max() <= MAX_MOTIONS
    restored = OffloadedGaussians(tmp_path)
    restored.restore(offloaded.snapshot())
    assert_equals(gaussians, restored, reference)


def test_chunk_with_invalid_ids_raises(tmp_path: Path) -> None:
    offloaded = OffloadedGaussians(tmp_path)
    for ids, count in (([], 0), ([1, 1, 2], 3), ([2, 1, 3], 3), ([1, 2], 3)):
        with pytest.raises(ValueError, match="ids"):
            offloaded.put(Chunk(2, np.array(ids, int), rows_of(count), labels_of(count)))
    assert offloaded.numbers() == []


# --- with a map -------------------------------------------------------------------------------
def test_loaded_map_equals_a_map_that_was_never_offloaded(tmp_path: Path) -> None:
    gaussians, reference, offloaded = (
        map_of(5, 6, 7, 8),
        map_of(5, 6, 7, 8),
        OffloadedGaussians(tmp_path),
    )
    numbers = offload_anchors(gaussians, offloaded, [2, 0, 9])
    assert len(numbers) == 2
    np.testing.assert_array_equal(np.unique(gaussians.anchors), [1, 3])
    assert_equals(gaussians, offloaded, reference)
    assert offloaded.load_into(gaussians, numbers).tolist() == [*range(5), *range(11, 18)]
    assert len(offloaded) == 0
    assert gaussians.rows.tobytes() == reference.rows.tobytes()
    assert_equals(gaussians, offloaded, reference)


def test_gaussians_of_an_anchor_may_be_offloaded_in_part(tmp_path: Path) -> None:
    gaussians, reference, offloaded = (
        map_of(9, 20, 7),
        map_of(9, 20, 7),
        OffloadedGaussians(tmp_path),
    )
    chunks = 3 * gaussians.anchors + gaussians.ids % 3  # Chunks with interleaved ids.
    first, second = offloaded.offload_from(gaussians, chunks, [3, 5])
    assert (len(gaussians), len(offloaded)) == (23, 13)
    assert_equals(gaussians, offloaded, reference)
    offloaded.load_into(gaussians, [first])
    assert_equals(gaussians, offloaded, reference)
    offloaded.load_into(gaussians, [second])
    assert gaussians.rows.tobytes() == reference.rows.tobytes()


def test_empty_selection_changes_nothing(tmp_path: Path) -> None:
    gaussians, offloaded = map_of(5, 6), OffloadedGaussians(tmp_path)
    assert offload_anchors(gaussians, offloaded, []) == []
    assert offloaded.load_into(gaussians, []).tolist() == []
    assert len(gaussians) == 11


Step = tuple[str, int, int]
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["add", "remove", "offload", "load", "move", "restart"]),
        st.integers(0, 2**6 - 1),
        st.integers(0, 1000),
    ),
    max_size=25,
)


@given(STEPS)
@settings(deadline=None, max_examples=60)
def test_any_offload_sequence_equals_a_map_that_was_never_offloaded(
    tmp_path_factory: pytest.TempPathFactory, steps: list[Step]
) -> None:
    folder = tmp_path_factory.mktemp("offloaded")
    gaussians, reference, offloaded = map_of(4, 3), map_of(4, 3), OffloadedGaussians(folder)
    anchors = 2
    for action, selection, seed in steps:
        rng = np.random.default_rng(seed)
        if action == "add":
            for gaussian_map in (gaussians, reference):
                gaussian_map.add(rows_of(1 + seed % 5, seed), anchors)
            anchors += 1
        elif action == "remove":
            removed_ids = gaussians.ids[rng.random(len(gaussians)) < 0.3]
            for gaussian_map in (gaussians, reference):
                gaussian_map.remove(np.isin(gaussian_map.ids, removed_ids))
        elif action == "offload":
            chunks = 2 * gaussians.anchors + gaussians.ids % 2
            offloaded.offload_from(gaussians, chunks, [k for k in chunks if selection >> k % 6 & 1])
        elif action == "load":
            offloaded.load_into(
                gaussians, [k for k in offloaded.numbers() if selection >> k % 6 & 1]
            )
        elif action == "move":
            moving = [k for k in range(anchors) if selection >> k % 6 & 1]
            motions = {k: se3.exp(rng.normal(0, 0.3, 6)) for k in moving}
            offloaded.move_anchors(motions)
            for gaussian_map in (gaussians, reference):
                gaussian_map.move_anchors(motions)
        else:
            state = offloaded.snapshot()
            offloaded = OffloadedGaussians(folder)
            offloaded.restore(state)
    assert len(gaussians) + len(offloaded) == len(reference)
    for _ in range(2):  # First offloaded, then resident.
        assert_equals(gaussians, offloaded, reference)
        offloaded.load_into(gaussians, offloaded.numbers())
    assert len(offloaded) == 0


# --- visibility -------------------------------------------------------------------------------
def test_visible_chunks_follow_moved_anchors(tmp_path: Path) -> None:
    gaussians, offloaded = GaussianMap(), OffloadedGaussians(tmp_path)
    for anchor, z_m in enumerate((3, 5, -4, 60)):
        rows = rows_of(5)
        rows[:, :3] = rows[:, :3] * 0.1 + np.array([0, 0, z_m])
        rows[:, 3:6] = -5
        gaussians.add(rows, anchor)
    numbers = offload_anchors(gaussians, offloaded, [0, 1, 2, 3])
    camera = PlacedCamera(CAMERA, np.eye(4))
    assert offloaded.visible_chunks(camera) == [numbers[0], numbers[1], numbers[3]]
    assert offloaded.visible_chunks(camera, reach_m=20) == [numbers[0], numbers[1]]
    behind = se3.exp(np.array([0, 0, 0, 0, 0, -50]))
    offloaded.move_anchors({1: behind, 3: behind})
    assert offloaded.visible_chunks(camera, reach_m=20) == [numbers[0], numbers[3]]
    offloaded.load(numbers[0])
    assert offloaded.visible_chunks(camera, reach_m=20) == [numbers[3]]


def test_visibility_of_offloaded_chunks_equals_resident_spheres(tmp_path: Path) -> None:
    gaussians, offloaded = map_of(*range(1, 15)), OffloadedGaussians(tmp_path)
    gaussians.log_scales[:] -= 5
    for anchor, T in POSES.items():
        gaussians.move_anchors({anchor: T})
    resident_spheres = BoundingSpheres.around(gaussians.rows, gaussians.anchors)
    numbers = offload_anchors(gaussians, offloaded, range(14))
    counts = []
    for angle_rad in range(6):
        T_map_camera = se3.exp(np.array([0, angle_rad, 0, 0, 0, 0.5]))
        camera = PlacedCamera(CAMERA, T_map_camera)
        seen = camera.may_see(resident_spheres.centers, resident_spheres.radii_m, reach_m=9)
        counts.append(np.count_nonzero(seen))
        assert offloaded.visible_chunks(camera, reach_m=9) == [
            numbers[k] for k in np.flatnonzero(seen)
        ]
    assert max(counts) > 2
    assert min(counts) < 12


def wall_at(z_m: float, seed: int) -> np.ndarray:
    """Return rows of a section of a corridor, visible from both directions."""
    rows = rows_of(40, seed)
    rows[:, :3] = rows[:, :3].clip(-1, 1) * np.array([1, 1, 0.3]) + np.array([0, 0, z_m])
    rows[:, 3:6] = -3
    rows[:, 11:14] = rows[:, 11:14].clip(0, 1)
    return rows


def test_corridor_walk_renders_bitwise_equal_within_the_resident_limit() -> None:
    """The camera maps a corridor 2 m ahead, turns and walks back.

    No camera saw Gaussians over 8 m away, so the expected renderings exclude them too.
    """
    config = OffloadConfig(max_active=1600, low_water=0.6, reach_m=8)
    gaussians, reference, offloaded = GaussianMap(), GaussianMap(), OffloadedGaussians(None)
    poses: dict[int, np.ndarray] = {}
    recent: list[PlacedCamera] = []
    turned_pose = se3.exp(np.array([0, np.pi, 0, 0, 0, 0]))
    max_resident = 0
    path = [(0.5 * k, False) for k in range(80)] + [(0.5 * k, True) for k in range(79, -1, -4)]
    for z_m, is_homeward in path:
        T_map_camera = turned_pose.copy() if is_homeward else np.eye(4)
        T_map_camera[:3, 3] = 0.1, 0, z_m
        recent = [*recent[-3:], PlacedCamera(CAMERA, T_map_camera)]
        # Load.
        offloaded.load_into(gaussians, offloaded.visible_chunks(recent[-1], config.reach_m))
        # Render.
        near = np.isin(reference.anchors, [k for k in poses if abs(poses[k][2, 3] + 2 - z_m) < 7])
        is_resident = np.isin(gaussians.anchors, reference.anchors[near])
        renderings = [
            render(np.ascontiguousarray(rows), CAMERA, se3.inverse(T_map_camera)).color
            for rows in (gaussians.rows[is_resident], reference.rows[near])
        ]
        assert renderings[0].tobytes() == renderings[1].tobytes()
        # Map.
        if not is_homeward:
            anchor = len(poses)
            poses[anchor] = T_map_camera
            for gaussian_map in (gaussians, reference):
                gaussian_map.add(wall_at(z_m + 2, anchor), anchor)
        # Offload.
        chunks = chunk_numbers(gaussians.means, gaussians.anchors, config.chunk_edge_m)
        spheres = BoundingSpheres.around(gaussians.rows, gaussians.anchors, chunks)
        choice = plan_offload(spheres, recent, config)
        offloaded.offload_from(gaussians, chunks, choice.chunks)
        assert choice.excess == 0
        assert len(gaussians) + len(offloaded) == len(reference)
        max_resident = max(max_resident, len(gaussians))
    assert len(reference) == 3200
    assert max_resident <= config.max_active
    assert offloaded.metrics()["gaussians_loaded_total"] > 1000
    assert all_arrays(gaussians, offloaded)[1].tobytes() == reference.rows.tobytes()


# --- files ------------------------------------------------------------------------------------
def test_restored_state_equals_the_original(tmp_path: Path) -> None:
    gaussians, reference, offloaded = map_of(5, 6, 7), map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    offload_anchors(gaussians, offloaded, [0, 1])
    restored = OffloadedGaussians(tmp_path)
    restored.restore(offloaded.snapshot())
    assert restored.numbers() == [0, 1]
    assert_equals(gaussians, restored, reference)
    camera = PlacedCamera(CAMERA, np.eye(4))
    assert restored.visible_chunks(camera) == offloaded.visible_chunks(camera)


def test_state_saved_before_a_crash_is_complete(tmp_path: Path) -> None:
    gaussians, reference, offloaded = map_of(5, 6, 7), map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    offload_anchors(gaussians, offloaded, [0])
    saved = gaussians.snapshot(), offloaded.snapshot()
    offloaded.load_into(gaussians, [0])  # The crash loses these steps.
    gaussians.rows[:] += 1
    offload_anchors(gaussians, offloaded, [0, 1])
    restored = OffloadedGaussians(tmp_path)
    restored.restore(saved[1])
    restored_map = GaussianMap.restore(saved[0])
    assert_equals(restored_map, restored, reference)
    assert len(list(tmp_path.iterdir())) == 1
    offload_anchors(restored_map, restored, [1, 2])
    assert_equals(restored_map, restored, reference)


def test_files_of_loaded_chunks_are_removed_after_the_next_save(tmp_path: Path) -> None:
    gaussians, offloaded = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    numbers = offload_anchors(gaussians, offloaded, [0, 1])
    offloaded.snapshot()
    offloaded.retired.saved()
    offloaded.load_into(gaussians, numbers[:1])
    offloaded.retired.saved()  # The same state again.
    for _ in range(3):
        offloaded.snapshot()  # A full disk does not save this.
    assert len(list(tmp_path.iterdir())) == 2
    offloaded.load_into(gaussians, numbers[1:])
    offloaded.retired.saved()
    assert [int(file.stem) for file in tmp_path.iterdir()] == numbers[1:]


def test_files_that_a_kept_generation_needs_stay(tmp_path: Path) -> None:
    gaussians, offloaded = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    numbers = offload_anchors(gaussians, offloaded, [0, 1])
    offloaded.snapshot()
    offloaded.retired.kept(is_previous_complete=True)
    offloaded.load_into(gaussians, numbers[:1])
    offloaded.snapshot()
    for is_complete in (True, False, True):  # The last call makes the first generation needless.
        assert len(list(tmp_path.iterdir())) == 2
        offloaded.retired.kept(is_previous_complete=is_complete)
    assert [int(file.stem) for file in tmp_path.iterdir()] == numbers[1:]


def test_restored_map_keeps_files_of_older_generations_until_the_next_ones(tmp_path: Path) -> None:
    gaussians, offloaded = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    numbers = offload_anchors(gaussians, offloaded, [0, 1])
    offloaded.load_into(gaussians, numbers[:1])
    state = offloaded.snapshot()
    restored = OffloadedGaussians(tmp_path)
    restored.restore(state)
    assert len(list(tmp_path.iterdir())) == 2
    restored.retired.kept(is_previous_complete=False)
    assert len(list(tmp_path.iterdir())) == 2
    restored.retired.kept(is_previous_complete=True)
    assert [int(file.stem) for file in tmp_path.iterdir()] == numbers[1:]


def test_files_of_an_earlier_run_are_removed(tmp_path: Path) -> None:
    OffloadedGaussians(tmp_path).put(chunk_of(3, 0, 5))
    OffloadedGaussians(tmp_path).put(chunk_of(4, 0, 5))
    for offloaded in (OffloadedGaussians(tmp_path), OffloadedGaussians(tmp_path)):
        offloaded.put(chunk_of(5, 0, 5))
        assert len(list(tmp_path.iterdir())) == 1


def test_temporary_folder_is_removed_with_its_owner() -> None:
    offloaded = OffloadedGaussians(None)
    offloaded.put(chunk_of(0, 0, 5))
    offloaded.put(chunk_of(1, 5, 5))
    folder = offloaded.files._folder
    offloaded.load(0)
    assert len(list(folder.iterdir())) == 1
    del offloaded
    gc.collect()
    assert not folder.exists()


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def flip_bit(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:-9] + bytes([data[-9] ^ 4]) + data[-8:])


def delete(path: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("damage", [truncate, flip_bit, delete])
def test_damaged_chunk_is_lost_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: Callable[[Path], None]
) -> None:
    gaussians, offloaded = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    offload_anchors(gaussians, offloaded, [0, 1])
    damage(min(tmp_path.iterdir()))
    with caplog.at_level(logging.WARNING):
        loaded = offloaded.load_into(gaussians, [0, 1])
    assert loaded.tolist() == list(range(5, 11))
    assert gaussians.ids.tolist() == list(range(5, 18))
    assert "5 Gaussians of anchor keyframe 0 are lost" in caplog.text
    assert len(caplog.records) == 1
    assert offloaded.metrics()["gaussians_lost_on_disk"] == 5
    assert offloaded.pop_lost_ids(gaussians).tolist() == list(range(5))
    assert offloaded.pop_lost_ids(gaussians).tolist() == [], "lost ids are reported once"


def test_only_ids_of_the_damaged_chunk_are_lost(tmp_path: Path) -> None:
    gaussians, offloaded = map_of(5, 12), OffloadedGaussians(tmp_path)
    chunks = 3 * gaussians.anchors + gaussians.ids % 3
    first, _ = offloaded.offload_from(gaussians, chunks, [3, 4])
    truncate(tmp_path / f"{first:08d}.gaussians")
    assert len(list(iter_all_gaussians(gaussians, offloaded))) == 3
    assert offloaded.pop_lost_ids(gaussians).tolist() == [6, 9, 12, 15]


@pytest.mark.parametrize("damage", [truncate, delete])
def test_missing_chunk_of_a_restored_state_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: Callable[[Path], None]
) -> None:
    gaussians, offloaded = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    offload_anchors(gaussians, offloaded, [0, 1])
    state = offloaded.snapshot()
    damage(min(tmp_path.iterdir()))
    restored = OffloadedGaussians(tmp_path)
    restored.restore(state)
    assert all_arrays(gaussians, restored)[0].tolist() == list(range(5, 18))
    assert restored.numbers() == [1]
    assert "lost" in caplog.text


def test_full_disk_keeps_gaussians_resident_and_logs_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaussians, reference, offloaded = map_of(5, 6, 7), map_of(5, 6, 7), OffloadedGaussians(tmp_path)

    def raise_disk_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(Path, "replace", raise_disk_full)
        assert offload_anchors(gaussians, offloaded, [0, 1]) == []
    assert gaussians.rows.tobytes() == reference.rows.tobytes()
    assert list(tmp_path.iterdir()) == []
    assert len(caplog.records) == 1
    assert "free some disk space" in caplog.text
    assert offloaded.metrics()["chunks_not_written"] == 2
    assert offload_anchors(gaussians, offloaded, [0, 1]) == [0, 1]
    assert_equals(gaussians, offloaded, reference)


def test_unusable_folder_raises_with_advice(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="Choose a folder"):
        OffloadedGaussians(tmp_path / "file")


def test_metrics_count_offloaded_and_loaded_gaussians(tmp_path: Path) -> None:
    gaussians, offloaded = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    offload_anchors(gaussians, offloaded, [0, 1])
    offloaded.load_into(gaussians, [1])
    metrics = offloaded.metrics()
    assert metrics["gaussians_offloaded"] == 5
    assert metrics["chunks_offloaded"] == 1
    assert metrics["gaussians_offloaded_total"] == 11
    assert metrics["gaussians_loaded_total"] == 6
