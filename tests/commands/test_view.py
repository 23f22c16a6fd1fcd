"""ldo view"""

import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.service.conftest import LDO, free_endpoint


def test_a_run_is_served_on_loopback_until_it_is_interrupted(run: Path) -> None:
    command = [*LDO, "view", str(run), "--set", "viewer.port=0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as viewer:
        try:
            assert viewer.stderr
            words = viewer.stderr.readline().split()
            assert words[:3] == ["ldo", "view", "run"]
            assert words[-1].startswith("http://127.0.0.1:")
            with urllib.request.urlopen(words[-1]) as page:
                assert page.headers["Content-Type"] == "text/html"
            viewer.send_signal(signal.SIGINT)
            _, err = viewer.communicate(timeout=30)
        finally:
            viewer.kill()  # a viewer serves until somebody stops it
    assert (viewer.returncode, err) == (0, "")


def test_without_the_extra_one_line_says_how_to_get_it(
    capsys, monkeypatch: pytest.MonkeyPatch, run: Path
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    code, _, err = ldo(capsys, "view", run)
    assert code == 2
    assert_one_paragraph(err)
    assert "pip install 'ldo-slam[viewer]'" in err


@pytest.mark.parametrize("name", ["absent", "."])
def test_a_folder_that_no_run_wrote_is_bad_data(capsys, tmp_path: Path, name: str) -> None:
    code, _, err = ldo(capsys, "view", tmp_path / name)
    assert code == 3
    assert_one_paragraph(err)


def test_nobody_to_look_at_is_a_configuration_error(capsys) -> None:
    code, _, err = ldo(capsys, "view", "live", "--endpoint", free_endpoint())
    assert code == 2
    assert_one_paragraph(err)


@pytest.mark.parametrize(
    "setting", ["viewer.most_gaussians=0", "viewer.update_s=0", "viewer.port=70000"]
)
def test_limits_that_make_no_sense_are_refused(capsys, run: Path, setting: str) -> None:
    code, _, err = ldo(capsys, "view", run, "--set", setting)
    assert code == 2
    assert_one_paragraph(err)
    assert setting.partition("=")[0].split(".")[1] in err
