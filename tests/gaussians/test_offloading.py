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

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
MOTION = se3.exp(np.array([0.4, -1.1, 0.7, 0.5, -0.6, 0.2]))
POSES = {k: se3.exp(np.array([0.1 * k, 0, -0.2, k, 0, 1])) for k in range(20)}


def rows_of(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(n, 16)).astype(np.float32)
    rows[:, 6:10] /= np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    return rows


def labels_of(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, 32), np.uint8)


def map_of(*counts: int) -> GaussianMap:
    out = GaussianMap()
    for keyframe, n in enumerate(counts):
        out.add(rows_of(n, keyframe), keyframe)
    out.labels[:] = labels_of(len(out))
    return out


def chunk_of(anchor: int, first_id: int, n: int) -> Chunk:
    return Chunk(anchor, np.arange(first_id, first_id + n), rows_of(n), labels_of(n))


def put_to_sleep(
    gaussians: GaussianMap, sleeping: OffloadedGaussians, anchors: Iterable[int]
) -> list[int]:
    """A chunk for each anchor."""
    return sleeping.offload_from(gaussians, gaussians.anchors, anchors)


def pieces_of(gaussians: GaussianMap, sleeping: OffloadedGaussians) -> list[np.ndarray]:
    """Ids, rows, anchors and labels of all, awake or asleep."""
    pieces = list(iter_all_gaussians(gaussians, sleeping))
    return [np.concatenate(arrays) for arrays in zip(*pieces, strict=True)]


def assert_whole(gaussians: GaussianMap, sleeping: OffloadedGaussians, plain: GaussianMap) -> None:
    for mine, wanted in zip(pieces_of(gaussians, sleeping), plain.all(), strict=True):
        assert mine.tobytes() == wanted.tobytes()


# --- one chunk --------------------------------------------------------------------------------
def test_a_chunk_comes_back_bit_for_bit() -> None:
    ids = np.array([3, 4, 9, 2**40])
    chunk = unpack(pack(Chunk(7, ids, rows_of(4), labels_of(4))))
    assert (chunk.anchor, chunk.ids.tolist()) == (7, ids.tolist())
    assert chunk.rows.dtype == np.float32
    assert chunk.rows.tobytes() == rows_of(4).tobytes()
    assert chunk.labels.tobytes() == labels_of(4).tobytes()
    np.testing.assert_array_equal(chunk.anchors, np.full(4, 7, np.int32))


def test_a_chunk_of_an_earlier_version_is_refused_with_the_reason() -> None:
    with pytest.raises(DataError, match="4 Gaussians without labels, as earlier versions"):
        unpack(pack(Chunk(7, np.arange(4), rows_of(4), labels_of(0))))


@pytest.mark.parametrize(
    "body", [b"", b"no zstd", pack(Chunk(0, np.arange(3), rows_of(1), labels_of(1)))]
)
def test_other_bytes_are_no_chunk(body: bytes) -> None:
    with pytest.raises(DataError, match="no Gaussians"):
        unpack(body)


def test_gaussians_of_a_still_anchor_wake_bit_for_bit(tmp_path: Path) -> None:
    sleeping, rows_before = OffloadedGaussians(tmp_path), rows_of(5)
    rows_before[:, [0, 7, 14]] = -0.0  # which no motion leaves negative
    number = sleeping.put(Chunk(2, np.arange(10, 15), rows_before, labels_of(5)))
    assert number is not None
    assert sleeping.numbers() == [number]
    assert len(sleeping) == 5
    sleeping.move({1: MOTION, 3: MOTION})
    chunk = sleeping.load(number)
    assert (chunk.anchor, chunk.ids.tolist()) == (2, [10, 11, 12, 13, 14])
    assert chunk.rows.tobytes() == rows_before.tobytes()
    assert chunk.labels.tobytes() == labels_of(5).tobytes()
    assert sleeping.numbers() == []
    with pytest.raises(KeyError):
        sleeping.load(number)


@pytest.mark.parametrize("motions", [1, 3, MAX_MOTIONS + 3])
def test_gaussians_move_with_their_anchor_as_if_they_were_awake(
    tmp_path: Path, motions: int
) -> None:
    sleeping, gaussians, plain = OffloadedGaussians(tmp_path), map_of(50, 40), map_of(50, 40)
    put_to_sleep(gaussians, sleeping, [0])
    for k in range(motions):
        T_new_old = {0: se3.exp(0.1 * (k + 1) * se3.log(MOTION))}
        sleeping.move(T_new_old)
        gaussians.move_anchors(T_new_old)
        plain.move_anchors(T_new_old)
    assert np.abs(plain.rows[:50] - rows_of(50)).max() > 0.01
    assert_whole(gaussians, sleeping, plain)
    assert sleeping.snapshot()["motion_counts"].max() <= MAX_MOTIONS
    successor = OffloadedGaussians(tmp_path)
    successor.restore(sleeping.snapshot())
    assert_whole(gaussians, successor, plain)


def test_a_chunk_has_ids_in_order(tmp_path: Path) -> None:
    sleeping = OffloadedGaussians(tmp_path)
    for ids, count in (([], 0), ([1, 1, 2], 3), ([2, 1, 3], 3), ([1, 2], 3)):
        with pytest.raises(ValueError, match="ids"):
            sleeping.put(Chunk(2, np.array(ids, int), rows_of(count), labels_of(count)))
    assert sleeping.numbers() == []


# --- beside a map -----------------------------------------------------------------------------
def test_a_map_that_slept_equals_one_that_did_not(tmp_path: Path) -> None:
    gaussians, plain, sleeping = (
        map_of(5, 6, 7, 8),
        map_of(5, 6, 7, 8),
        OffloadedGaussians(tmp_path),
    )
    numbers = put_to_sleep(gaussians, sleeping, [2, 0, 9])
    assert len(numbers) == 2
    np.testing.assert_array_equal(np.unique(gaussians.anchors), [1, 3])
    assert_whole(gaussians, sleeping, plain)
    assert sleeping.load_into(gaussians, numbers).tolist() == [*range(5), *range(11, 18)]
    assert len(sleeping) == 0
    assert gaussians.rows.tobytes() == plain.rows.tobytes()
    assert_whole(gaussians, sleeping, plain)


def test_a_part_of_an_anchors_gaussians_may_sleep(tmp_path: Path) -> None:
    gaussians, plain, sleeping = map_of(9, 20, 7), map_of(9, 20, 7), OffloadedGaussians(tmp_path)
    clumps = 3 * gaussians.anchors + gaussians.ids % 3  # which interleave
    first, second = sleeping.offload_from(gaussians, clumps, [3, 5])
    assert (len(gaussians), len(sleeping)) == (23, 13)
    assert_whole(gaussians, sleeping, plain)
    sleeping.load_into(gaussians, [first])
    assert_whole(gaussians, sleeping, plain)
    sleeping.load_into(gaussians, [second])
    assert gaussians.rows.tobytes() == plain.rows.tobytes()


def test_asking_for_nobody_changes_nothing(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(5, 6), OffloadedGaussians(tmp_path)
    assert put_to_sleep(gaussians, sleeping, []) == []
    assert sleeping.load_into(gaussians, []).tolist() == []
    assert len(gaussians) == 11


Step = tuple[str, int, int]
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["add", "remove", "sleep", "wake", "move", "restart"]),
        st.integers(0, 2**6 - 1),
        st.integers(0, 1000),
    ),
    max_size=25,
)


@given(STEPS)
@settings(deadline=None, max_examples=60)
def test_whatever_sleeps_and_wakes_the_whole_is_a_map_that_never_slept(
    tmp_path_factory: pytest.TempPathFactory, steps: list[Step]
) -> None:
    folder = tmp_path_factory.mktemp("sleep")
    gaussians, plain, sleeping = map_of(4, 3), map_of(4, 3), OffloadedGaussians(folder)
    anchors = 2
    for what, bits, seed in steps:
        rng = np.random.default_rng(seed)
        if what == "add":
            for each in (gaussians, plain):
                each.add(rows_of(1 + seed % 5, seed), anchors)
            anchors += 1
        elif what == "remove":
            gone = gaussians.ids[rng.random(len(gaussians)) < 0.3]
            for each in (gaussians, plain):
                each.remove(np.isin(each.ids, gone))
        elif what == "sleep":
            clumps = 2 * gaussians.anchors + gaussians.ids % 2
            sleeping.offload_from(gaussians, clumps, [k for k in clumps if bits >> k % 6 & 1])
        elif what == "wake":
            sleeping.load_into(gaussians, [k for k in sleeping.numbers() if bits >> k % 6 & 1])
        elif what == "move":
            moving = [k for k in range(anchors) if bits >> k % 6 & 1]
            motions = {k: se3.exp(rng.normal(0, 0.3, 6)) for k in moving}
            sleeping.move(motions)
            for each in (gaussians, plain):
                each.move_anchors(motions)
        else:
            state = sleeping.snapshot()
            sleeping = OffloadedGaussians(folder)
            sleeping.restore(state)
    assert len(gaussians) + len(sleeping) == len(plain)
    for _ in range(2):  # asleep, then awake
        assert_whole(gaussians, sleeping, plain)
        sleeping.load_into(gaussians, sleeping.numbers())
    assert len(sleeping) == 0


# --- who may see them -------------------------------------------------------------------------
def test_sleepers_are_seen_where_their_anchors_are_now(tmp_path: Path) -> None:
    gaussians, sleeping = GaussianMap(), OffloadedGaussians(tmp_path)
    for anchor, z_m in enumerate((3, 5, -4, 60)):
        rows = rows_of(5)
        rows[:, :3] = rows[:, :3] * 0.1 + np.array([0, 0, z_m])
        rows[:, 3:6] = -5
        gaussians.add(rows, anchor)
    numbers = put_to_sleep(gaussians, sleeping, [0, 1, 2, 3])
    camera = PlacedCamera(CAMERA, np.eye(4))
    assert sleeping.visible_chunks(camera) == [numbers[0], numbers[1], numbers[3]]
    assert sleeping.visible_chunks(camera, reach_m=20) == [numbers[0], numbers[1]]
    behind = se3.exp(np.array([0, 0, 0, 0, 0, -50]))
    sleeping.move({1: behind, 3: behind})
    assert sleeping.visible_chunks(camera, reach_m=20) == [numbers[0], numbers[3]]
    sleeping.load(numbers[0])
    assert sleeping.visible_chunks(camera, reach_m=20) == [numbers[3]]


def test_sleeping_and_waking_spheres_agree(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(*range(1, 15)), OffloadedGaussians(tmp_path)
    gaussians.log_scales[:] -= 5
    for anchor, T in POSES.items():
        gaussians.move_anchors({anchor: T})
    awake = BoundingSpheres.around(gaussians.rows, gaussians.anchors)
    numbers = put_to_sleep(gaussians, sleeping, range(14))
    counts = []
    for angle_rad in range(6):
        T_map_camera = se3.exp(np.array([0, angle_rad, 0, 0, 0, 0.5]))
        camera = PlacedCamera(CAMERA, T_map_camera)
        seen = camera.may_see(awake.centers, awake.radii_m, reach_m=9)
        counts.append(np.count_nonzero(seen))
        assert sleeping.visible_chunks(camera, reach_m=9) == [
            numbers[k] for k in np.flatnonzero(seen)
        ]
    assert max(counts) > 2
    assert min(counts) < 12


def wall_at(z_m: float, seed: int) -> np.ndarray:
    """A slice of a corridor: Gaussians to be seen from before and behind."""
    rows = rows_of(40, seed)
    rows[:, :3] = rows[:, :3].clip(-1, 1) * np.array([1, 1, 0.3]) + np.array([0, 0, z_m])
    rows[:, 3:6] = -3
    rows[:, 11:14] = rows[:, 11:14].clip(0, 1)
    return rows


def test_a_walk_and_back_shows_every_camera_the_whole_map_and_keeps_few_in_memory() -> None:
    """Out along a corridor, mapped 2 m ahead, turn, and home. What is over 8 m away was not seen
    by anybody, and is left out of the pictures of the map that never sleeps, too."""
    config = OffloadConfig(max_active=1600, low_water=0.6, reach_m=8)
    gaussians, plain, sleeping = GaussianMap(), GaussianMap(), OffloadedGaussians(None)
    poses: dict[int, np.ndarray] = {}
    recent: list[PlacedCamera] = []
    turned = se3.exp(np.array([0, np.pi, 0, 0, 0, 0]))
    most = 0
    path = [(0.5 * k, False) for k in range(80)] + [(0.5 * k, True) for k in range(79, -1, -4)]
    for z_m, is_homeward in path:
        T_map_camera = turned.copy() if is_homeward else np.eye(4)
        T_map_camera[:3, 3] = 0.1, 0, z_m
        recent = [*recent[-3:], PlacedCamera(CAMERA, T_map_camera)]
        # wake
        sleeping.load_into(gaussians, sleeping.visible_chunks(recent[-1], config.reach_m))
        # see
        near = np.isin(plain.anchors, [k for k in poses if abs(poses[k][2, 3] + 2 - z_m) < 7])
        awake = np.isin(gaussians.anchors, plain.anchors[near])
        pictures = [
            render(np.ascontiguousarray(rows), CAMERA, se3.inverse(T_map_camera)).color
            for rows in (gaussians.rows[awake], plain.rows[near])
        ]
        assert pictures[0].tobytes() == pictures[1].tobytes()
        # map
        if not is_homeward:
            anchor = len(poses)
            poses[anchor] = T_map_camera
            for each in (gaussians, plain):
                each.add(wall_at(z_m + 2, anchor), anchor)
        # sleep
        clumps = chunk_numbers(gaussians.means, gaussians.anchors, config.clump_m)
        spheres = BoundingSpheres.around(gaussians.rows, gaussians.anchors, clumps)
        choice = plan_offload(spheres, recent, config)
        sleeping.offload_from(gaussians, clumps, choice.clumps)
        assert choice.excess == 0
        assert len(gaussians) + len(sleeping) == len(plain)
        most = max(most, len(gaussians))
    assert len(plain) == 3200
    assert most <= config.max_active
    assert sleeping.metrics()["gaussians_loaded_total"] > 1000
    assert pieces_of(gaussians, sleeping)[1].tobytes() == plain.rows.tobytes()


# --- files ------------------------------------------------------------------------------------
def test_a_successor_goes_on_from_a_saved_state(tmp_path: Path) -> None:
    gaussians, plain, sleeping = map_of(5, 6, 7), map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    put_to_sleep(gaussians, sleeping, [0, 1])
    successor = OffloadedGaussians(tmp_path)
    successor.restore(sleeping.snapshot())
    assert successor.numbers() == [0, 1]
    assert_whole(gaussians, successor, plain)
    camera = PlacedCamera(CAMERA, np.eye(4))
    assert successor.visible_chunks(camera) == sleeping.visible_chunks(camera)


def test_after_a_crash_the_state_saved_before_the_last_steps_is_whole(tmp_path: Path) -> None:
    gaussians, plain, sleeping = map_of(5, 6, 7), map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    put_to_sleep(gaussians, sleeping, [0])
    saved = gaussians.snapshot(), sleeping.snapshot()
    sleeping.load_into(gaussians, [0])  # these steps are lost in the crash
    gaussians.rows[:] += 1
    put_to_sleep(gaussians, sleeping, [0, 1])
    successor = OffloadedGaussians(tmp_path)
    successor.restore(saved[1])
    restored = GaussianMap.restore(saved[0])
    assert_whole(restored, successor, plain)
    assert len(list(tmp_path.iterdir())) == 1
    put_to_sleep(restored, successor, [1, 2])
    assert_whole(restored, successor, plain)


def test_files_of_the_woken_go_when_a_state_without_them_is_saved(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    numbers = put_to_sleep(gaussians, sleeping, [0, 1])
    sleeping.snapshot()
    sleeping.saved()
    sleeping.load_into(gaussians, numbers[:1])
    sleeping.saved()  # the old state once more
    for _ in range(3):
        sleeping.snapshot()  # which a full disk does not take
    assert len(list(tmp_path.iterdir())) == 2
    sleeping.load_into(gaussians, numbers[1:])
    sleeping.saved()
    assert [int(file.stem) for file in tmp_path.iterdir()] == numbers[1:]


def test_what_an_earlier_run_left_is_removed(tmp_path: Path) -> None:
    OffloadedGaussians(tmp_path).put(chunk_of(3, 0, 5))
    OffloadedGaussians(tmp_path).put(chunk_of(4, 0, 5))
    for sleeping in (OffloadedGaussians(tmp_path), OffloadedGaussians(tmp_path)):
        sleeping.put(chunk_of(5, 0, 5))
        assert len(list(tmp_path.iterdir())) == 1


def test_a_temporary_folder_goes_with_the_sleepers() -> None:
    sleeping = OffloadedGaussians(None)
    sleeping.put(chunk_of(0, 0, 5))
    sleeping.put(chunk_of(1, 5, 5))
    folder = sleeping._files._folder
    sleeping.load(0)
    assert len(list(folder.iterdir())) == 1
    del sleeping
    gc.collect()
    assert not folder.exists()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def flip(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:-9] + bytes([data[-9] ^ 4]) + data[-8:])


def delete(path: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("spoil", [cut, flip, delete])
def test_a_damaged_chunk_is_lost_with_one_line_and_the_rest_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, spoil: Callable[[Path], None]
) -> None:
    gaussians, sleeping = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    put_to_sleep(gaussians, sleeping, [0, 1])
    spoil(min(tmp_path.iterdir()))
    with caplog.at_level(logging.WARNING):
        woken = sleeping.load_into(gaussians, [0, 1])
    assert woken.tolist() == list(range(5, 11))
    assert gaussians.ids.tolist() == list(range(5, 18))
    assert "5 Gaussians of anchor keyframe 0 are lost" in caplog.text
    assert len(caplog.records) == 1
    assert sleeping.metrics()["gaussians_lost_on_disk"] == 5
    assert sleeping.pop_lost_ids(gaussians).tolist() == list(range(5))
    assert sleeping.pop_lost_ids(gaussians).tolist() == [], "once is enough"


def test_only_what_is_nowhere_else_is_lost(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(5, 12), OffloadedGaussians(tmp_path)
    clumps = 3 * gaussians.anchors + gaussians.ids % 3
    first, _ = sleeping.offload_from(gaussians, clumps, [3, 4])
    cut(tmp_path / f"{first:08d}.gaussians")
    assert len(list(iter_all_gaussians(gaussians, sleeping))) == 3
    assert sleeping.pop_lost_ids(gaussians).tolist() == [6, 9, 12, 15]


@pytest.mark.parametrize("spoil", [cut, delete])
def test_a_chunk_that_a_restored_state_misses_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, spoil: Callable[[Path], None]
) -> None:
    gaussians, sleeping = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    put_to_sleep(gaussians, sleeping, [0, 1])
    state = sleeping.snapshot()
    spoil(min(tmp_path.iterdir()))
    successor = OffloadedGaussians(tmp_path)
    successor.restore(state)
    assert pieces_of(gaussians, successor)[0].tolist() == list(range(5, 18))
    assert successor.numbers() == [1]
    assert "lost" in caplog.text


def test_on_a_full_disk_they_stay_awake_and_it_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaussians, plain, sleeping = map_of(5, 6, 7), map_of(5, 6, 7), OffloadedGaussians(tmp_path)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(Path, "replace", full)
        assert put_to_sleep(gaussians, sleeping, [0, 1]) == []
    assert gaussians.rows.tobytes() == plain.rows.tobytes()
    assert list(tmp_path.iterdir()) == []
    assert len(caplog.records) == 1
    assert "free some disk space" in caplog.text
    assert sleeping.metrics()["chunks_not_written"] == 2
    assert put_to_sleep(gaussians, sleeping, [0, 1]) == [0, 1]
    assert_whole(gaussians, sleeping, plain)


def test_a_folder_that_cannot_be_used_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="Choose a folder"):
        OffloadedGaussians(tmp_path / "file")


def test_statistics_count_who_slept_and_woke(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(5, 6, 7), OffloadedGaussians(tmp_path)
    put_to_sleep(gaussians, sleeping, [0, 1])
    sleeping.load_into(gaussians, [1])
    told = sleeping.metrics()
    assert told["gaussians_offloaded"] == 5
    assert told["chunks_offloaded"] == 1
    assert told["gaussians_offloaded_total"] == 11
    assert told["gaussians_loaded_total"] == 6
