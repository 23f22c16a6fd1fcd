"""The programs that show faults of commit 18f9264 in a running service do not find them."""

from pathlib import Path

import pytest

from . import connection_reproductions, service_reproductions, state_reproductions
from .earlier_names import MAX_S, outcome

PROGRAMS = [
    (module.__file__, program)
    for module in (service_reproductions, state_reproductions, connection_reproductions)
    for program in module.PROGRAMS
]


@pytest.mark.slow
@pytest.mark.timeout(MAX_S + 60)
@pytest.mark.parametrize(("file", "program"), PROGRAMS, ids=[program for _, program in PROGRAMS])
def test_fault_of_an_earlier_version_does_not_occur_in_a_service(file: str, program: str) -> None:
    verdict, figures = outcome(program, file)
    assert verdict == "NOT SEEN", figures


@pytest.mark.parametrize(
    ("end", "expected"),
    [
        ("return True", "SEEN"),
        ("return False", "NOT SEEN"),
        ("raise ValueError", "ERROR"),
        ("os._exit(0)", "ERROR"),
        ("os.kill(os.getpid(), 9)", "ERROR"),
    ],
)
def test_program_has_a_verdict_only_if_it_returns(tmp_path: Path, end: str, expected: str) -> None:
    file = tmp_path / "programs.py"
    file.write_text(
        f"import os, sys\nsys.path.append({str(Path(__file__).parents[2])!r})\n"
        "from tests.faults.earlier_names import run\n"
        f"def program():\n    print('two figures', flush=True)\n    {end}\n"
        "run({'program': program}, __file__)\n"
    )
    verdict, figures = outcome("program", str(file))
    assert verdict == expected
    assert "two figures" in figures
