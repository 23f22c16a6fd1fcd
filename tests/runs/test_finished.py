import json
from pathlib import Path

import numpy as np
import pytest

from ldo_service.errors import DataError
from ldo_service.gaussians.ply import write_ply
from ldo_service.geometry import Camera, se3
from ldo_service.runs.finished import FinishedRun

CAMERA = Camera(320, 240, 260.0, 261.0, 159.5, 119.5)
T_MAP_CAMERA = se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]))


def keyframe(**changes: object) -> dict[str, object]:
    camera = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {"keyframe": 0, "camera": camera, "T_map_camera": T_MAP_CAMERA.tolist(), **changes}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_ply(tmp_path / "map.ply", np.zeros((0, 16), np.float32))
    (tmp_path / "keyframes.json").write_text(json.dumps([keyframe(), keyframe(keyframe=1)]))
    return tmp_path


def test_keyframes_are_seen_from_where_they_were_taken(folder: Path) -> None:
    first, _ = FinishedRun.open(folder).viewpoints()
    assert first.camera == CAMERA
    np.testing.assert_array_equal(first.T_map_camera, T_MAP_CAMERA)


def test_what_was_refined_goes_first(folder: Path) -> None:
    assert FinishedRun.open(folder).folder == folder
    (folder / "refined").mkdir()
    assert FinishedRun.open(folder).folder == folder  # as long as nothing is in it
    write_ply(folder / "refined" / "map.ply", np.zeros((0, 16), np.float32))
    assert FinishedRun.open(folder).folder == folder / "refined"
    assert FinishedRun.open(folder, online=True).folder == folder


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"T_map_camera": np.eye(3).tolist()}, "no finite 4x4"),
        ({"T_map_camera": np.full((4, 4), np.nan).tolist()}, "no finite 4x4"),
        ({"camera": {"width": 320}}, "height"),
        ({"camera": [1, 2]}, "not what `ldo run` writes"),
    ],
)
def test_a_keyframe_without_sense_is_said(folder: Path, changes: dict, said: str) -> None:
    (folder / "keyframes.json").write_text(json.dumps([keyframe(**changes)]))
    with pytest.raises(DataError, match=said):
        FinishedRun.open(folder).viewpoints()
