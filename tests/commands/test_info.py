"""The command `ldo info`."""

import json
import shutil
from pathlib import Path

from tests.commands.test_cli import assert_one_paragraph, ldo


def test_command_prints_a_table_and_json(capsys, room_folder: Path) -> None:
    code, out, _ = ldo(capsys, "info", room_folder)
    assert code == 0
    for text in ("TUM RGB-D", "16 in 0.5 s, at 30.00 Hz", "120 poses", "registered to color in"):
        assert text in out
    code, out, _ = ldo(capsys, "info", room_folder, "--json")
    found = json.loads(out)
    assert (code, found["layout"], found["timing"]["frames"]) == (0, "TUM RGB-D", 16)
    assert found["estimated_run_s"] is None


def test_probe_adds_the_time_of_a_run(capsys) -> None:
    code, out, _ = ldo(capsys, "info", "synthetic:room", "--probe", "2")
    assert code == 0
    assert "time of `ldo run`" in out
    assert "about" in out


def test_source_that_does_not_exist_is_one_paragraph(capsys, tmp_path: Path) -> None:
    code, _, err = ldo(capsys, "info", tmp_path / "nowhere")
    assert code == 3
    assert_one_paragraph(err)


def test_reason_of_unreadable_frames_is_printed(capsys, tmp_path: Path, room_folder: Path) -> None:
    folder = shutil.copytree(room_folder, tmp_path / "room")
    for image in (folder / "depth").iterdir():
        image.write_bytes(b"no image")
    code, out, _ = ldo(capsys, "info", folder, "--json")
    assert code == 0
    found = json.loads(out)
    assert found["unreadable_frames"] == found["sampled_frames"] > 0
    assert "depth" in found["why_unreadable"]


def test_brackets_in_a_path_are_printed(capsys, tmp_path: Path, room_folder: Path) -> None:
    folder = shutil.copytree(room_folder, tmp_path / "q[" / "b]")
    code, out, _ = ldo(capsys, "info", folder)
    assert code == 0
    assert "q[/b]" in out.replace("\n", "")


def test_probe_without_frames_is_refused(capsys) -> None:
    code, _, err = ldo(capsys, "info", "synthetic:room", "--probe", "0")
    assert (code, "--probe 0 must be at least 1" in err) == (2, True)
