"""Fixtures of the tests of commands."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def run(finished_run: Path, tmp_path: Path) -> Path:
    """A copy of the finished run; tests may change the copy."""
    return shutil.copytree(finished_run, tmp_path / "run")
