"""Offline and realtime runs with an odometry prior from a file."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.config import load_config
from ldo_service.datasets import Cached, Sequence
from ldo_service.errors import DataError
from ldo_service.geometry import RawFrame, Trajectory
from ldo_service.runs.offline import run_offline
from ldo_service.runs.realtime import run_realtime
from ldo_service.runs.source import FrameReader, interleave_prior, recorded_prior
from ldo_service.schemas import CameraRgbd, OdometryPrior

from .jobs import job

FRAMES, COVERED = 14, range(4, 9)


class FastCamera(Cached):
    """Every third frame, with the stamps of successive frames; some are black without depth."""

    def read(self, index: int) -> RawFrame:
        raw = super().read(3 * index)
        if index in COVERED:
            black = np.zeros_like(raw.color), np.zeros_like(raw.depth)
            raw = replace(raw, color=black[0], depth=black[1])
        return replace(raw, index=index, stamp_ns=int(self.stamps_ns[index]))


@pytest.fixture(scope="module")
def fast_camera(room: Sequence) -> Sequence:
    return FastCamera(room)


@pytest.fixture(scope="module")
def prior(room: Sequence) -> Trajectory:
    truth = room.truth()
    assert truth is not None
    return Trajectory(room.stamps_ns[:FRAMES] * 1e-9, truth.T_world_camera[: 3 * FRAMES : 3])


def statuses(folder: Path) -> list[str]:
    with (folder / "frames.csv").open() as file:
        return [row["status"] for row in csv.DictReader(file)]


def test_each_frame_follows_the_prior_poses_up_to_its_stamp(room: Sequence) -> None:
    stamps_s = np.arange(12) * 0.02 + float(room.stamps_ns[0]) * 1e-9
    poses = Trajectory(stamps_s, np.tile(np.eye(4), (12, 1, 1)))
    sent_ns: list[int] = []
    for *priors, frame in interleave_prior(FrameReader(room, range(4), print), poses):
        assert isinstance(frame, CameraRgbd)
        assert all(isinstance(pose, OdometryPrior) for pose in priors)
        sent_ns += [pose.stamp_ns for pose in priors]
        assert sent_ns[-1] >= frame.stamp_ns, "no pose must be extrapolated"
        assert sum(stamp_ns >= frame.stamp_ns for stamp_ns in sent_ns) == 1, "no pose comes early"
    assert sent_ns == [round(1e9 * stamp_s) for stamp_s in stamps_s[: len(sent_ns)]]


def test_covered_camera_recovers_at_once_and_the_run_is_repeatable(
    fast_camera: Sequence, prior: Trajectory, tmp_path: Path
) -> None:
    for name in ("first", "second"):
        options = job(fast_camera, tmp_path / name, frames=FRAMES, prior=prior)
        run_offline(options, lambda *_: None)
    expected = ["LOST" if index in COVERED else "OK" for index in range(FRAMES)]
    assert statuses(tmp_path / "first") == expected
    first, second = (
        (tmp_path / name / "trajectory.txt").read_bytes() for name in ("first", "second")
    )
    assert first == second


def test_realtime_run_uses_a_prior(
    fast_camera: Sequence, prior: Trajectory, tmp_path: Path
) -> None:
    options = job(fast_camera, tmp_path / "out", frames=4, prior=prior)
    record = run_realtime(options, lambda _done: None)
    assert record.summary["status"]["OK"] > 0


def test_a_prior_of_another_clock_is_refused(
    fast_camera: Sequence, prior: Trajectory, tmp_path: Path
) -> None:
    later = Trajectory(prior.stamps_s + 1e6, prior.T_world_camera)
    with pytest.raises(DataError, match="must come from the same clock"):
        job(fast_camera, tmp_path / "out", frames=FRAMES, prior=later)


# --- odometry in the recording --------------------------------------------------------------------
class WithOdometry(Cached):
    """Sequence with a recorded odometry."""

    def __init__(self, sequence: Sequence, odometry: Trajectory | None) -> None:
        super().__init__(sequence)
        self._poses = odometry

    def odometry(self) -> Trajectory | None:
        return self._poses


MOUNT = "tracker.T_base_camera.translation_m=[0.1, 0.2, 0.3]"


def test_recorded_odometry_of_the_camera_becomes_that_of_the_base(
    room: Sequence, prior: Trajectory
) -> None:
    config = load_config(None, [MOUNT])
    found = recorded_prior(WithOdometry(room, prior), range(4), config, pytest.fail)
    assert found is not None
    T_base_camera = np.eye(4)
    T_base_camera[:3, 3] = 0.1, 0.2, 0.3
    np.testing.assert_allclose(found.T_world_camera @ T_base_camera, prior.T_world_camera)


@pytest.mark.parametrize("shift_s", [None, 1e6])
def test_missing_odometry_is_only_a_warning(
    room: Sequence, prior: Trajectory, shift_s: float | None
) -> None:
    odometry = None if shift_s is None else replace(prior, stamps_s=prior.stamps_s + shift_s)
    warnings: list[str] = []
    sequence, config = WithOdometry(room, odometry), load_config(None)
    assert recorded_prior(sequence, range(4), config, warnings.append) is None
    assert "has no odometry at the time of its frames" in warnings[0]
