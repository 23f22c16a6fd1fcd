"""Errors of `ldo view`; tests/commands/test_interrupt.py starts and stops it."""

import sys
from pathlib import Path

import pytest

from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.ports import free_endpoint


def test_without_viewer_extra_the_error_names_the_install_command(
    capsys, monkeypatch: pytest.MonkeyPatch, run: Path
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    code, _, err = ldo(capsys, "view", run)
    assert code == 2
    assert_one_paragraph(err)
    assert "pip install -e '.[viewer]'" in err


@pytest.mark.parametrize("name", ["absent", "."])
def test_folder_without_a_run_is_bad_data(capsys, tmp_path: Path, name: str) -> None:
    code, _, err = ldo(capsys, "view", tmp_path / name)
    assert code == 3
    assert_one_paragraph(err)


def test_view_without_a_running_service_has_its_own_exit_code(capsys) -> None:
    code, _, err = ldo(capsys, "view", "live", "--endpoint", free_endpoint())
    assert code == 6
    assert_one_paragraph(err)


@pytest.mark.parametrize(
    "setting", ["viewer.max_gaussians=0", "viewer.update_interval_s=0", "viewer.port=70000"]
)
def test_invalid_viewer_settings_are_refused(capsys, run: Path, setting: str) -> None:
    code, _, err = ldo(capsys, "view", run, "--set", setting)
    assert code == 2
    assert_one_paragraph(err)
    assert setting.partition("=")[0].split(".")[1] in err
