"""The command `ldo demo` on the first frames of its room."""

import cv2
import pytest

from ldo_service.commands import demo
from tests.commands.test_cli import ldo


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
