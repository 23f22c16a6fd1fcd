import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PROGRAM = ROOT / "deploy" / "check_language.py"
PLAIN = '"""Return the depth."""\nDEPTH_M = 1.0  # Meters; 0 where unknown.\n'


@pytest.fixture
def check(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Return a function that runs the program on a file with a text."""

    def run(text: str, name: str = "module.py") -> subprocess.CompletedProcess[str]:
        path = tmp_path / name
        path.write_text(text)
        return subprocess.run([sys.executable, PROGRAM, path], capture_output=True, text=True)

    return run


def test_plain_sentences_pass(check: Callable) -> None:
    assert check(PLAIN).returncode == 0


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ('"""Whether it is there."""', "opens with 'Whether'"),
        ("COUNT = 1  # of a segment", "opens with 'of'"),
        ("COUNT = 1  # The plain twin.", "retired word 'twin'"),
        ('raise ValueError(f"{self}: wrong")', "prints {self}"),
    ],
)
def test_private_language_is_reported_with_its_line(
    check: Callable, line: str, reason: str
) -> None:
    done = check(line + "\n")
    assert done.returncode == 1
    assert "module.py:1: " in done.stdout
    assert reason in done.stdout


def test_comments_of_kernels_are_checked(check: Callable) -> None:
    assert "opens with 'Of'" in check("// Of a row.\nint a;\n", "kernel.hpp").stdout
