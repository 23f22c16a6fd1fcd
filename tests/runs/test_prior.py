"""A run with what another odometry said, from a file."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Cached, Sequence
from ldo_service.errors import DataError
from ldo_service.geometry import RawFrame, Trajectory
from ldo_service.runs.offline import run_offline
from ldo_service.runs.realtime import run_realtime
from ldo_service.runs.source import FrameReader, interleave_prior
from ldo_service.schemas import CameraRgbd, OdometryPrior

from .jobs import job

FRAMES, COVERED = 14, range(4, 9)


class Hurried(Cached):
    """Every third frame, some of them black and without depth, at the stamps of the first ones."""

    def read(self, index: int) -> RawFrame:
        raw = super().read(3 * index)
        if index in COVERED:
            nothing = np.zeros_like(raw.color), np.zeros_like(raw.depth)
            raw = replace(raw, color=nothing[0], depth=nothing[1])
        return replace(raw, index=index, stamp_ns=int(self.stamps_ns[index]))


@pytest.fixture(scope="module")
def hurried(room: Sequence) -> Sequence:
    return Hurried(room)


@pytest.fixture(scope="module")
def prior(room: Sequence) -> Trajectory:
    truth = room.truth()
    assert truth is not None
    return Trajectory(room.stamps_ns[:FRAMES] * 1e-9, truth.T_world_camera[: 3 * FRAMES : 3])


def statuses(folder: Path) -> list[str]:
    with (folder / "frames.csv").open() as file:
        return [row["status"] for row in csv.DictReader(file)]


def test_frames_come_behind_the_poses_that_reach_them(room: Sequence) -> None:
    stamps_s = np.arange(12) * 0.02 + float(room.stamps_ns[0]) * 1e-9
    poses = Trajectory(stamps_s, np.tile(np.eye(4), (12, 1, 1)))
    told: list[int] = []
    for *news, frame in interleave_prior(FrameReader(room, range(4), print), poses):
        assert isinstance(frame, CameraRgbd)
        assert all(isinstance(pose, OdometryPrior) for pose in news)
        told += [pose.stamp_ns for pose in news]
        assert told[-1] >= frame.stamp_ns, "none would have to be extrapolated"
        assert sum(stamp_ns >= frame.stamp_ns for stamp_ns in told) == 1, "and none comes early"
    assert told == [round(1e9 * stamp_s) for stamp_s in stamps_s[: len(told)]]


def test_a_covered_camera_is_found_at_once_and_the_run_repeats(
    hurried: Sequence, prior: Trajectory, tmp_path: Path
) -> None:
    for name in ("first", "second"):
        of_run = job(hurried, tmp_path / name, frames=FRAMES, prior=prior)
        run_offline(of_run, lambda *_: None)
    expected = ["LOST" if index in COVERED else "OK" for index in range(FRAMES)]
    assert statuses(tmp_path / "first") == expected
    first, second = (
        (tmp_path / name / "trajectory.txt").read_bytes() for name in ("first", "second")
    )
    assert first == second


def test_a_run_in_real_time_takes_a_prior_too(
    hurried: Sequence, prior: Trajectory, tmp_path: Path
) -> None:
    of_run = job(hurried, tmp_path / "out", frames=4, prior=prior)
    record = run_realtime(of_run, lambda _done: None)
    assert record.summary["status"]["OK"] > 0


def test_a_prior_of_another_clock_is_refused(
    hurried: Sequence, prior: Trajectory, tmp_path: Path
) -> None:
    later = Trajectory(prior.stamps_s + 1e6, prior.T_world_camera)
    with pytest.raises(DataError, match="must be of the same clock"):
        job(hurried, tmp_path / "out", frames=FRAMES, prior=later)
