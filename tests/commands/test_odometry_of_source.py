"""Commands on a recording with the poses of a phone."""

import json
from pathlib import Path

import numpy as np
import pytest

from ldo_service.commands.publish import SequencePublisher
from ldo_service.conversions.poses import pose_from_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.runs.source import PriorSource
from ldo_service.schemas import CameraRgbd, Pose
from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.datasets.recordings import write_nerfstudio

COUNT = 6


@pytest.fixture(scope="module")
def scan(room: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of nerfstudio with the first frames of the room and their poses."""
    truth = room.truth()
    assert truth is not None
    frames = [room.read(index) for index in range(COUNT)]
    poses = truth.T_world_camera[:COUNT]
    folder = tmp_path_factory.mktemp("scan") / "room"
    return write_nerfstudio(folder, frames, (320, 240), poses)


def test_poses_of_the_phone_are_truth_only_if_asked(capsys, scan: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert ldo(capsys, "run", scan, "--out", run, "--recorded-odometry")[0] == 0
    code, out, _ = ldo(capsys, "eval", run, scan, "--json")
    assert (code, json.loads(out)["trajectory"]) == (0, None)
    code, out, _ = ldo(capsys, "eval", run, scan, "--json", "--odometry-as-truth")
    assert code == 0
    assert json.loads(out)["trajectory"]["final"]["ate_m"]["rmse"] < 0.005


def test_source_without_odometry_is_no_truth(capsys, run: Path, room_folder: Path) -> None:
    code, _, err = ldo(capsys, "eval", run, room_folder, "--odometry-as-truth")
    assert code == 3
    assert_one_paragraph(err)
    assert "contains no odometry" in err


def test_info_counts_the_poses(capsys, scan: Path, room_folder: Path) -> None:
    for source, poses in ((scan, COUNT), (room_folder, 0)):
        code, out, _ = ldo(capsys, "info", source, "--json", "--probe", "0")
        assert (code, json.loads(out)["odometry_poses"]) == (0, poses)


class FakeService:
    """Client that keeps the messages instead of sending them."""

    has_subscriber = True

    def __init__(self) -> None:
        self.sent: list[tuple[str, int, object]] = []

    def publish_prior(self, T_prior_base: Pose, stamp_ns: int) -> None:
        self.sent.append(("prior", stamp_ns, T_prior_base))

    def send(self, frame: CameraRgbd) -> None:
        self.sent.append(("frame", frame.stamp_ns, frame.frame))


@pytest.mark.parametrize("restamp", [False, True])
def test_publisher_sends_each_pose_before_its_frame(scan: Path, restamp: bool) -> None:
    sequence, service = open_sequence(str(scan)), FakeService()
    odometry = sequence.odometry()
    assert odometry is not None
    publisher = SequencePublisher(
        service,  # type: ignore[arg-type]
        sequence,
        PriorSource(odometry),
        restamp,
        pytest.fail,
    )
    for index in range(COUNT):
        publisher.send(index)
    assert [kind for kind, _, _ in service.sent] == ["prior", "frame"] * COUNT
    stamps_ns = [stamp_ns for _, stamp_ns, _ in service.sent]
    np.testing.assert_allclose(stamps_ns[::2], stamps_ns[1::2], rtol=0, atol=1)
    if not restamp:
        assert stamps_ns[1::2] == sequence.stamps_ns.tolist()
    poses = [pose_from_message(pose) for _, _, pose in service.sent[::2]]  # type: ignore[arg-type]
    np.testing.assert_allclose(poses, odometry.T_world_camera, atol=1e-12)
