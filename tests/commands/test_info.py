"""The command `ldo info`."""

import json
import re
import shutil
from pathlib import Path

import numpy as np

from ldo_service.datasets import Sequence
from tests.cameras.ros import STORE, header
from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.datasets.bags import COLOR, COLOR_INFO, DEPTH, entries_of, write_bag
from tests.datasets.recordings import small_frames, write_stray


def test_command_prints_a_table_and_json(capsys, room_folder: Path) -> None:
    code, out, _ = ldo(capsys, "info", room_folder, "--probe", "0")
    assert code == 0
    for text in ("TUM RGB-D", "16 in 0.5 s, at 30.00 Hz", "120 poses", "registered to color in"):
        assert text in out
    code, out, _ = ldo(capsys, "info", room_folder, "--json", "--probe", "0")
    found = json.loads(out)
    assert (code, found["layout"], found["timing"]["frames"]) == (0, "TUM RGB-D", 16)
    assert found["estimated_run_s"] is None


def test_topics_of_a_bag_are_listed_with_their_use(capsys, tmp_path: Path, room: Sequence) -> None:
    imu, T = STORE.types["sensor_msgs/msg/Imu"], STORE.types["geometry_msgs/msg/Vector3"]
    quaternion = STORE.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    zeros, covariance = T(0.0, 0.0, 0.0), np.zeros(9)
    samples = [
        (k, "/imu", imu(header(k), quaternion, covariance, zeros, covariance, zeros, covariance))
        for k in range(1, 6)
    ]
    path = write_bag(tmp_path, "mcap", [*samples, *entries_of(room, range(3))])
    code, out, _ = ldo(capsys, "info", path, "--json", "--probe", "0")
    assert code == 0
    streams = {stream["name"]: stream for stream in json.loads(out)["streams"]}
    used = {name: stream["use"] for name, stream in streams.items()}
    assert used == {COLOR: "color", DEPTH: "depth", COLOR_INFO: "calibration", "/imu": ""}
    assert (streams["/imu"]["kind"], streams["/imu"]["messages"]) == ("sensor_msgs/Imu", 5)
    _, out, _ = ldo(capsys, "info", path, "--probe", "0")
    lines = [line.strip("│ \n") for line in out.splitlines()]
    assert any(line.startswith("not used") and "/imu (sensor_msgs/Imu, 5" in line for line in lines)


def test_inertial_measurements_of_a_phone_are_listed_as_not_used(capsys, tmp_path: Path) -> None:
    folder = write_stray(tmp_path / "desk", small_frames(3))
    assert "imu.csv" not in ldo(capsys, "info", folder, "--probe", "0")[1]
    (folder / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    code, out, _ = ldo(capsys, "info", folder, "--probe", "0")
    assert (code, "imu.csv (inertial measurements)" in out) == (0, True)


def test_time_of_a_run_is_estimated(capsys, room_folder: Path) -> None:
    code, out, _ = ldo(capsys, "info", room_folder, "--json")
    assert code == 0
    assert 0 < json.loads(out)["estimated_run_s"] < 600


def test_source_that_does_not_exist_is_one_paragraph(capsys, tmp_path: Path) -> None:
    code, _, err = ldo(capsys, "info", tmp_path / "nowhere")
    assert code == 3
    assert_one_paragraph(err)


def test_reason_of_unreadable_frames_is_printed(capsys, tmp_path: Path, room_folder: Path) -> None:
    folder = shutil.copytree(room_folder, tmp_path / "room")
    for image in (folder / "depth").iterdir():
        image.write_bytes(b"no image")
    code, out, _ = ldo(capsys, "info", folder, "--json", "--probe", "0")
    assert code == 0
    found = json.loads(out)
    assert found["unreadable_frames"] == found["sampled_frames"] > 0
    assert "depth" in found["why_unreadable"]
    code, out, _ = ldo(capsys, "info", folder)
    assert (code, "the run of 30 frames failed" in out) == (0, True)


def test_brackets_in_a_path_are_printed(capsys, tmp_path: Path, room_folder: Path) -> None:
    folder = shutil.copytree(room_folder, tmp_path / "q[" / "b]")
    code, out, _ = ldo(capsys, "info", folder, "--probe", "0")
    assert code == 0
    assert "q[/b]" in re.sub(r"[\s│]", "", out)  # A long path is broken anywhere.


def test_negative_probe_is_refused(capsys) -> None:
    code, _, err = ldo(capsys, "info", "synthetic:room", "--probe", "-1")
    assert (code, "--probe -1 must be at least 0" in err) == (2, True)


def test_topic_chooses_between_two_cameras_of_a_bag(capsys, tmp_path: Path, room: Sequence) -> None:
    """The commands run and simulate share the option; the error about two topics names it."""
    path = two_cameras(tmp_path, room)
    code, _, err = ldo(capsys, "info", path)
    assert code == 3
    assert_one_paragraph(err)
    assert "--topic color=/back/color/image_raw" in " ".join(err.split())
    chosen = "--topic", "color=/front/color/image_raw"
    assert ldo(capsys, "info", path, *chosen)[0] == 0
    code, out, _ = ldo(capsys, "simulate", path, *chosen, "--json")
    assert (code, "tracker" in json.loads(out)) == (0, True)
    assert ldo(capsys, "run", path, "--out", tmp_path / "run", *chosen)[0] == 0
    code, _, err = ldo(capsys, "run", path, "--out", tmp_path / "b", "--topic", "color")
    assert (code, "color=/TOPIC" in err) == (2, True)


def two_cameras(folder: Path, sequence: Sequence) -> Path:
    """Write a bag with the frames of a sequence as those of two cameras."""
    entries = [
        (time_ns, topic.replace("/camera/", f"/{name}/"), message)
        for time_ns, topic, message in entries_of(sequence, range(3))
        for name in ("front", "back")
    ]
    return write_bag(folder, "mcap", entries)
