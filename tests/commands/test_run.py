"""Table that `ldo run` prints; tests/runs has the results of a run."""

import json
import shutil
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from ldo_service.commands.run import summary_table
from tests.commands.test_cli import ldo


@pytest.mark.parametrize(("objects", "is_shown"), [(0, False), (3, True)])
def test_table_has_a_row_for_objects_if_there_are_some(
    finished_run: Path, objects: int, is_shown: bool
) -> None:
    summary = json.loads((finished_run / "summary.json").read_text()) | {"objects": objects}
    out = StringIO()
    Console(file=out).print(summary_table(summary, finished_run))
    assert ("objects" in out.getvalue()) == is_shown


def test_note_on_an_unreadable_frame_has_its_whole_path_on_one_line(
    capsys, tmp_path: Path, room_folder: Path
) -> None:
    """Rich takes words in brackets for styles, and breaks lines at the width of the terminal."""
    folder = shutil.copytree(room_folder, tmp_path / "[desk]" / ("x" * 80))
    bad = sorted((folder / "depth").iterdir())[2]
    bad.write_bytes(b"no image")
    options = ["--max-frames", "4", "--threads", "1", "--set", "offline.max_rejected_ratio=1"]
    code, out, err = ldo(capsys, "run", folder, "--out", tmp_path / "[out]", *options)
    assert code == 0, err
    assert str(bad) in err
    assert "[out]" in "".join(out.split())
