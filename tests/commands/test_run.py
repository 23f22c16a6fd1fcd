"""Table that `ldo run` prints; tests/runs has the results of a run."""

import json
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from ldo_service.commands.run import summary_table


@pytest.mark.parametrize(("objects", "is_shown"), [(0, False), (3, True)])
def test_table_has_a_row_for_objects_if_there_are_some(
    finished_run: Path, objects: int, is_shown: bool
) -> None:
    summary = json.loads((finished_run / "summary.json").read_text()) | {"objects": objects}
    out = StringIO()
    Console(file=out).print(summary_table(summary, finished_run))
    assert ("objects" in out.getvalue()) == is_shown
