"""The command `ldo demo` on the first frames of its room."""

import cv2
import pytest

from ldo_service.commands import demo
from tests.commands.test_cli import assert_one_paragraph, ldo


@pytest.mark.timeout(300)
def test_demo_reports_poses_rendering_and_labels(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(demo, "FRAMES", 6)
    code, out, err = ldo(capsys, "demo", "--out", tmp_path / "demo")
    assert code == 0, err
    assert "6 OK" in out
    assert "over 1 held-out frames" in out
    assert "potted plant" in out  # It stands in the middle of all frames.
    for name in ("trajectory.png", "rendering.png", "labels.png"):
        assert cv2.imread(str(tmp_path / "demo" / name)) is not None, name


def test_full_disk_is_reported(capsys, tmp_path, monkeypatch) -> None:
    def fill_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(demo, "prerender", lambda *_: None)
    monkeypatch.setattr(demo, "run_offline", fill_disk)
    code, _, err = ldo(capsys, "demo", "--out", tmp_path / "demo")
    assert code == 2
    assert_one_paragraph(err)
    assert f"{tmp_path / 'demo'} cannot be written: No space left on device" in err
