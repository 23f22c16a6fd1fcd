from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.calibration.correction import CameraCorrection
from ldo_service.calibration.shutter import ShutterTiming
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.errors import DataError
from ldo_service.evaluation.finished_run import (
    Exposures,
    FinishedRun,
    FrameCounts,
    PosedMap,
    RunFrame,
    at_stamps,
)
from ldo_service.geometry import Trajectory
from ldo_service.runs.finished import read_run


def test_ok_frame_without_a_pose_is_an_error(finished_run: Path) -> None:
    run = read_run(finished_run)
    posed = run.maps[0]
    kept = np.arange(len(posed.trajectory)) != 7
    poses = Trajectory(posed.trajectory.stamps_s[kept], posed.trajectory.T_world_camera[kept])
    with pytest.raises(DataError, match=r"no pose for frame 7.*has status OK"):
        replace(posed, trajectory=poses).T_map_camera(run.frame(7))


def test_another_source_is_rejected(finished_run: Path, room: Sequence, room_folder: Path) -> None:
    run = read_run(finished_run)
    later = replace(run.frames[3], stamp_ns=run.frames[3].stamp_ns + 1)
    beyond = replace(run.frames[3], index=16)
    sequence = open_sequence(str(room_folder))
    for frame in (later, beyond):
        with pytest.raises(DataError, match="Give the SOURCE of the run"):
            replace(run, frames=(*run.frames[:3], frame)).require_source(sequence)
    assert len(room) > 16


def test_poses_are_chosen_by_stamp() -> None:
    poses = Trajectory(
        np.array([1e9, 1e9 + 0.033333333, 1e9 + 0.066666667]), np.tile(np.eye(4), (3, 1, 1))
    )
    assert at_stamps(poses, np.array([1e9 + 0.0333333335])).stamps_s.tolist() == [poses.stamps_s[1]]
    assert len(at_stamps(poses, np.array([1e9 + 0.04]))) == 0
    assert len(at_stamps(poses, np.zeros(0))) == 0


def test_counts_leave_out_frames_without_a_pose_in_the_map() -> None:
    """Frame 2 is LOST, and frame 3 is in a submap that was never merged."""
    frames = tuple(
        RunFrame(i, i * 10**8, status, False)
        for i, status in enumerate(["OK", "WEAK", "LOST", "OK", "OK"])
    )
    posed = Trajectory(np.array([0.0, 0.1, 0.4]), np.tile(np.eye(4), (3, 1, 1)))
    run = FinishedRun(Path("run"), frames, {"final": posed}, ())
    assert run.counts() == FrameCounts(frames=5, with_pose=3, ok=2)
    assert str(run.counts()).startswith("3 of 5 frames have a pose (60.0%). Of these, 2 have")


def moving_map(timing: ShutterTiming, jump_m: float = 0.0) -> PosedMap:
    """Return a map whose camera moves by 1 cm along x per frame at 30 Hz."""
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, 0, 3] = 0.01 * np.arange(5)
    T[3:, 0, 3] += jump_m
    trajectory, correction = Trajectory(np.arange(5) / 30, T), CameraCorrection(timing=timing)
    empty = Exposures(np.zeros(0, np.int64), np.zeros((0, 2, 3)))
    return PosedMap("online", np.zeros((0, 16)), trajectory, empty, correction=correction)


def test_motion_of_a_frame_comes_from_its_neighbors() -> None:
    timing = ShutterTiming(0.02)
    motion = moving_map(timing).motion(RunFrame(2, round(1e9 * 2 / 30), "OK", True))
    assert motion is not None
    assert motion.timing == timing
    assert motion.velocity == pytest.approx([0, 0, 0, 0.3, 0, 0])


def test_motion_is_unknown_at_the_end_without_timing_and_at_a_jump() -> None:
    timing = ShutterTiming(0.02)
    last, middle = (RunFrame(i, round(1e9 * i / 30), "OK", True) for i in (4, 2))
    assert moving_map(timing).motion(last) is None
    assert moving_map(ShutterTiming()).motion(middle) is None
    assert moving_map(timing, jump_m=2.0).motion(middle) is None
