import errno
import gc
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldo_service.errors import ConfigError, DataError
from ldo_service.gaussians import GaussianMap, render
from ldo_service.gaussians.anchor_spheres import AnchorSpheres, PlacedCamera
from ldo_service.gaussians.chunk import Chunk, packed, unpacked
from ldo_service.gaussians.sleep import SleepingGaussians, whole_map
from ldo_service.gaussians.sleep_choice import SleepConfig, choose_sleepers
from ldo_service.geometry import Camera, se3

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
    return out


def pieces_of(
    gaussians: GaussianMap, sleeping: SleepingGaussians, poses: dict[int, np.ndarray] = POSES
) -> list[np.ndarray]:
    """Ids, rows and anchors of all, awake or asleep."""
    pieces = list(whole_map(gaussians, sleeping, poses))
    return [np.concatenate([piece[k] for piece in pieces]) for k in range(3)]


def one_sign(rows: np.ndarray) -> np.ndarray:
    """With w >= 0 in all quaternions: q and -q are one rotation."""
    out = rows.copy()
    out[:, 6:10] *= np.where(rows[:, 6:7] < 0, -1, 1)
    return out


def assert_whole(gaussians: GaussianMap, sleeping: SleepingGaussians, plain: GaussianMap) -> None:
    for mine, wanted in zip(
        pieces_of(gaussians, sleeping), (plain.ids, plain.rows, plain.anchors), strict=True
    ):
        assert mine.tobytes() == wanted.tobytes()


# --- one chunk --------------------------------------------------------------------------------
def test_a_chunk_comes_back_bit_for_bit() -> None:
    ids = np.array([3, 4, 9, 2**40])
    chunk = unpacked(packed(Chunk(7, ids, rows_of(4))))
    assert (chunk.anchor, chunk.ids.tolist()) == (7, ids.tolist())
    assert chunk.rows.dtype == np.float32
    assert chunk.rows.tobytes() == rows_of(4).tobytes()
    np.testing.assert_array_equal(chunk.anchors, np.full(4, 7, np.int32))


@pytest.mark.parametrize("body", [b"", b"no zstd", packed(Chunk(0, np.arange(3), rows_of(2)))])
def test_other_bytes_are_no_chunk(body: bytes) -> None:
    with pytest.raises(DataError, match="no Gaussians"):
        unpacked(body)


def test_gaussians_of_a_still_anchor_wake_bit_for_bit(tmp_path: Path) -> None:
    sleeping, rows_before = SleepingGaussians(tmp_path), rows_of(5)
    rows_before[:, [0, 7, 14]] = -0.0  # which no motion leaves negative
    assert sleeping.put(2, np.arange(10, 15), rows_before, POSES[2])
    assert 2 in sleeping
    assert len(sleeping) == 5
    ids, rows = sleeping.wake(2, POSES[2])
    assert ids.tolist() == [10, 11, 12, 13, 14]
    assert rows.tobytes() == rows_before.tobytes()
    assert 2 not in sleeping
    with pytest.raises(KeyError):
        sleeping.wake(2, POSES[2])


def test_gaussians_move_with_their_anchor_while_they_sleep(tmp_path: Path) -> None:
    moved = map_of(500)
    moved.move_anchors({0: MOTION})
    sleeping = SleepingGaussians(tmp_path)
    sleeping.put(0, np.arange(500), rows_of(500), POSES[5])
    _, rows = sleeping.wake(0, MOTION @ POSES[5])
    np.testing.assert_allclose(rows, moved.rows, atol=1e-6)
    assert np.abs(rows - rows_of(500)).max() > 0.1


def test_two_motions_in_sleep_are_their_product(tmp_path: Path) -> None:
    sleeping, plain = SleepingGaussians(tmp_path), map_of(50)
    sleeping.put(0, np.arange(50), rows_of(50), POSES[0])
    T_map_anchor = POSES[0]
    for _ in range(30):
        plain.move_anchors({0: MOTION})
        T_map_anchor = MOTION @ T_map_anchor
    _, rows = sleeping.wake(0, T_map_anchor)
    np.testing.assert_allclose(one_sign(rows), one_sign(plain.rows), atol=2e-5)


def test_an_anchor_sleeps_once_and_with_ids_in_order(tmp_path: Path) -> None:
    sleeping = SleepingGaussians(tmp_path)
    sleeping.put(1, np.arange(3), rows_of(3), POSES[1])
    with pytest.raises(ValueError, match="sleeps already"):
        sleeping.put(1, np.arange(3, 6), rows_of(3), POSES[1])
    for ids, count in (([], 0), ([1, 1, 2], 3), ([2, 1, 3], 3), ([1, 2], 3)):
        with pytest.raises(ValueError, match="ids"):
            sleeping.put(2, np.array(ids, int), rows_of(count), POSES[2])
    assert sleeping.anchors() == [1]


# --- beside a map -----------------------------------------------------------------------------
def test_a_map_that_slept_equals_one_that_did_not(tmp_path: Path) -> None:
    gaussians, plain, sleeping = map_of(5, 6, 7, 8), map_of(5, 6, 7, 8), SleepingGaussians(tmp_path)
    assert sleeping.take_from(gaussians, [2, 0, 9], POSES) == [0, 2]
    np.testing.assert_array_equal(np.unique(gaussians.anchors), [1, 3])
    assert_whole(gaussians, sleeping, plain)
    assert sleeping.return_to(gaussians, [2, 0], POSES).tolist() == [*range(5), *range(11, 18)]
    assert len(sleeping) == 0
    assert gaussians.rows.tobytes() == plain.rows.tobytes()
    assert_whole(gaussians, sleeping, plain)


def test_asking_for_nobody_changes_nothing(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(5, 6), SleepingGaussians(tmp_path)
    assert sleeping.take_from(gaussians, [], POSES) == []
    assert sleeping.return_to(gaussians, [], POSES).tolist() == []
    assert len(gaussians) == 11


def test_a_refused_request_leaves_the_map_as_it_was(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(5, 6), SleepingGaussians(tmp_path)
    with pytest.raises(KeyError):
        sleeping.take_from(gaussians, [0, 1], {0: np.eye(4)})
    sleeping.take_from(gaussians, [0], POSES)
    gaussians.add(rows_of(2), 0)
    with pytest.raises(ValueError, match="sleep already"):
        sleeping.take_from(gaussians, [0, 1], POSES)
    assert len(gaussians) == 8


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
    gaussians, plain, sleeping = map_of(4, 3), map_of(4, 3), SleepingGaussians(folder)
    poses, rounded = dict(list(POSES.items())[:2]), set[int]()
    for what, bits, seed in steps:
        anchors = [k for k in poses if bits >> k % 6 & 1]
        rng = np.random.default_rng(seed)
        if what == "add":
            anchor = max(poses) + 1
            poses[anchor] = POSES[anchor % 20]
            for each in (gaussians, plain):
                each.add(rows_of(1 + seed % 5, seed), anchor)
        elif what == "remove":
            gone = gaussians.ids[rng.random(len(gaussians)) < 0.3]
            for each in (gaussians, plain):
                each.remove(np.isin(each.ids, gone))
        elif what == "sleep":
            sleeping.take_from(gaussians, [k for k in anchors if k not in sleeping], poses)
        elif what == "wake":
            sleeping.return_to(gaussians, [k for k in anchors if k in sleeping], poses)
        elif what == "move":
            motions = {k: se3.exp(rng.normal(0, 0.3, 6)) for k in anchors}
            rounded |= {k for k in anchors if k in sleeping}
            poses |= {k: T @ poses[k] for k, T in motions.items()}
            for each in (gaussians, plain):
                each.move_anchors(motions)
        else:
            state = sleeping.snapshot()
            sleeping = SleepingGaussians(folder)
            sleeping.restore(state)
    assert len(gaussians) + len(sleeping) == len(plain)
    for _ in range(2):  # asleep, then awake
        ids, rows, anchors = pieces_of(gaussians, sleeping, poses)
        assert ids.tobytes() == plain.ids.tobytes()
        assert anchors.tobytes() == plain.anchors.tobytes()
        np.testing.assert_allclose(one_sign(rows), one_sign(plain.rows), atol=2e-5)
        exact = ~np.isin(anchors, list(rounded))
        assert rows[exact].tobytes() == plain.rows[exact].tobytes()
        sleeping.return_to(gaussians, sleeping.anchors(), poses)
    assert len(sleeping) == 0


# --- who may see them -------------------------------------------------------------------------
def test_sleepers_are_seen_where_their_anchors_are_now(tmp_path: Path) -> None:
    gaussians, sleeping = GaussianMap(), SleepingGaussians(tmp_path)
    for anchor, z_m in enumerate((3, 5, -4, 60)):
        rows = rows_of(5)
        rows[:, :3] = rows[:, :3] * 0.1 + np.array([0, 0, z_m])
        rows[:, 3:6] = -5
        gaussians.add(rows, anchor)
    sleeping.take_from(gaussians, [0, 1, 2, 3], POSES)
    camera = PlacedCamera(CAMERA, np.eye(4))
    assert sleeping.seen_from(camera, POSES) == [0, 1, 3]
    assert sleeping.seen_from(camera, POSES, reach_m=20) == [0, 1]
    behind = se3.exp(np.array([0, 0, 0, 0, 0, -50]))
    moved = POSES | {1: behind @ POSES[1], 3: behind @ POSES[3]}
    assert sleeping.seen_from(camera, moved, reach_m=20) == [0, 3]
    sleeping.wake(0, moved[0])
    assert sleeping.seen_from(camera, moved, reach_m=20) == [3]


def test_sleeping_and_waking_spheres_agree(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(*range(1, 15)), SleepingGaussians(tmp_path)
    gaussians.log_scales[:] -= 5
    awake = AnchorSpheres.around(gaussians.rows, gaussians.anchors, POSES)
    sleeping.take_from(gaussians, range(14), POSES)
    moved = {k: T @ MOTION @ MOTION for k, T in POSES.items()}
    counts = []
    for angle_rad in range(6):
        T_map_camera = se3.exp(np.array([0, angle_rad, 0, 0, 0, 0.5]))
        camera = PlacedCamera(CAMERA, T_map_camera)
        seen = camera.may_see(awake.centers_map(moved), awake.radii_m, reach_m=9)
        counts.append(np.count_nonzero(seen))
        assert sleeping.seen_from(camera, moved, reach_m=9) == np.flatnonzero(seen).tolist()
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
    config = SleepConfig(max_active=1600, low_water=0.6, reach_m=8)
    gaussians, plain, sleeping = GaussianMap(), GaussianMap(), SleepingGaussians(None)
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
        seen = sleeping.seen_from(recent[-1], poses, config.reach_m)
        sleeping.return_to(gaussians, seen, poses)
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
        spheres = AnchorSpheres.around(gaussians.rows, gaussians.anchors, poses)
        choice = choose_sleepers(spheres, poses, recent, config)
        sleeping.take_from(gaussians, choice.anchors, poses)
        assert choice.excess == 0
        assert len(gaussians) + len(sleeping) == len(plain)
        most = max(most, len(gaussians))
    assert len(plain) == 3200
    assert most <= config.max_active
    assert sleeping.statistics()["gaussians_woken"] > 1000
    assert pieces_of(gaussians, sleeping, poses)[1].tobytes() == plain.rows.tobytes()


# --- files ------------------------------------------------------------------------------------
def test_a_successor_goes_on_from_a_saved_state(tmp_path: Path) -> None:
    gaussians, plain, sleeping = map_of(5, 6, 7), map_of(5, 6, 7), SleepingGaussians(tmp_path)
    sleeping.take_from(gaussians, [0, 1], POSES)
    successor = SleepingGaussians(tmp_path)
    successor.restore(sleeping.snapshot())
    assert successor.anchors() == [0, 1]
    assert_whole(gaussians, successor, plain)
    camera = PlacedCamera(CAMERA, np.eye(4))
    assert successor.seen_from(camera, POSES) == sleeping.seen_from(camera, POSES)


def test_after_a_crash_the_state_saved_before_the_last_steps_is_whole(tmp_path: Path) -> None:
    gaussians, plain, sleeping = map_of(5, 6, 7), map_of(5, 6, 7), SleepingGaussians(tmp_path)
    sleeping.take_from(gaussians, [0], POSES)
    saved = gaussians.snapshot(), sleeping.snapshot()
    sleeping.return_to(gaussians, [0], POSES)  # these steps are lost in the crash
    gaussians.rows[:] += 1
    sleeping.take_from(gaussians, [0, 1], POSES)
    successor = SleepingGaussians(tmp_path)
    successor.restore(saved[1])
    restored = GaussianMap.restore(saved[0])
    assert_whole(restored, successor, plain)
    assert len(list(tmp_path.iterdir())) == 1
    successor.take_from(restored, [1, 2], POSES)
    assert_whole(restored, successor, plain)


def test_files_of_the_woken_go_when_no_saved_state_needs_them(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(5, 6), SleepingGaussians(tmp_path)
    sleeping.take_from(gaussians, [0, 1], POSES)
    counts = []
    sleeping.snapshot()
    sleeping.return_to(gaussians, [0], POSES)
    for _ in range(3):
        counts.append(len(list(tmp_path.iterdir())))
        sleeping.snapshot()
    assert counts == [2, 2, 1]


def test_what_an_earlier_run_left_is_removed(tmp_path: Path) -> None:
    SleepingGaussians(tmp_path).put(3, np.arange(5), rows_of(5), POSES[3])
    SleepingGaussians(tmp_path).put(4, np.arange(5), rows_of(5), POSES[3])
    for sleeping in (SleepingGaussians(tmp_path), SleepingGaussians(tmp_path)):
        sleeping.put(5, np.arange(5), rows_of(5), POSES[3])
        assert len(list(tmp_path.iterdir())) == 1


def test_a_temporary_folder_goes_with_the_sleepers() -> None:
    sleeping = SleepingGaussians(None)
    sleeping.put(0, np.arange(5), rows_of(5), POSES[0])
    sleeping.put(1, np.arange(5, 10), rows_of(5), POSES[1])
    folder = sleeping._files._folder
    sleeping.wake(0, POSES[0])
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
    gaussians, sleeping = map_of(5, 6, 7), SleepingGaussians(tmp_path)
    sleeping.take_from(gaussians, [0, 1], POSES)
    spoil(min(tmp_path.iterdir()))
    with caplog.at_level(logging.WARNING):
        woken = sleeping.return_to(gaussians, [0, 1], POSES)
    assert woken.tolist() == list(range(5, 11))
    assert gaussians.ids.tolist() == list(range(5, 18))
    assert "anchor 0: its 5 sleeping Gaussians are lost" in caplog.text
    assert len(caplog.records) == 1
    assert sleeping.statistics()["gaussians_lost_on_disk"] == 5


@pytest.mark.parametrize("spoil", [cut, delete])
def test_a_chunk_that_a_restored_state_misses_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, spoil: Callable[[Path], None]
) -> None:
    gaussians, sleeping = map_of(5, 6, 7), SleepingGaussians(tmp_path)
    sleeping.take_from(gaussians, [0, 1], POSES)
    state = sleeping.snapshot()
    spoil(min(tmp_path.iterdir()))
    successor = SleepingGaussians(tmp_path)
    successor.restore(state)
    assert pieces_of(gaussians, successor)[0].tolist() == list(range(5, 18))
    assert successor.anchors() == [1]
    assert "lost" in caplog.text


def test_on_a_full_disk_they_stay_awake_and_it_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaussians, plain, sleeping = map_of(5, 6, 7), map_of(5, 6, 7), SleepingGaussians(tmp_path)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(Path, "replace", full)
        assert sleeping.take_from(gaussians, [0, 1], POSES) == []
    assert gaussians.rows.tobytes() == plain.rows.tobytes()
    assert list(tmp_path.iterdir()) == []
    assert len(caplog.records) == 1
    assert "free some disk space" in caplog.text
    assert sleeping.statistics()["chunks_not_written"] == 2
    assert sleeping.take_from(gaussians, [0, 1], POSES) == [0, 1]
    assert_whole(gaussians, sleeping, plain)


def test_a_folder_that_cannot_be_used_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="Choose a folder"):
        SleepingGaussians(tmp_path / "file")


def test_statistics_count_who_slept_and_woke(tmp_path: Path) -> None:
    gaussians, sleeping = map_of(5, 6, 7), SleepingGaussians(tmp_path)
    sleeping.take_from(gaussians, [0, 1], POSES)
    sleeping.return_to(gaussians, [1], POSES)
    told = sleeping.statistics()
    assert told["gaussians_asleep"] == 5
    assert told["anchors_asleep"] == 1
    assert told["gaussians_fell_asleep"] == 11
    assert told["gaussians_woken"] == 6
