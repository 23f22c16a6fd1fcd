"""Tests of the scene of a run folder, finished or in progress."""

import json
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.errors import DataError
from ldo_service.gaussians.file_formats import read_ply, write_ply
from ldo_service.gaussians.pruning import weights
from ldo_service.geometry import Trajectory
from ldo_service.runs.records import write_objects
from ldo_service.schemas import MapObjects, ObjectView
from ldo_service.viewer.panel import escaped
from ldo_service.viewer.run_folder import PARTS, RunFolder
from ldo_service.viewer.view_config import ViewerConfig
from tests.schemas.examples import EXAMPLES

CONFIG = ViewerConfig()
EXAMPLE_OBJECTS = EXAMPLES["map_objects"]
assert isinstance(EXAMPLE_OBJECTS, MapObjects)


@pytest.fixture
def run(finished_run: Path, tmp_path: Path) -> Path:
    """Copy of a finished run; a test may change the copy."""
    return shutil.copytree(finished_run, tmp_path / "run")


def test_scene_holds_all_results_of_a_finished_run(run: Path) -> None:
    folder = RunFolder(run, CONFIG)
    assert folder.update() >= {"gaussians", "online", "final", "keyframes", "loops", "facts"}
    scene, summary = folder.scene, json.loads((run / "summary.json").read_text())
    keyframes = json.loads((run / "keyframes.json").read_text())
    assert len(scene.rows) == summary["gaussians"]
    assert list(scene.keyframes) == [entry["keyframe"] for entry in keyframes]
    np.testing.assert_allclose(scene.keyframes[0], keyframes[0]["T_map_camera"])
    assert scene.camera is not None
    assert scene.camera.width == keyframes[0]["camera"]["width"]
    T_map_camera = Trajectory.load(run / "trajectory.txt").T_world_camera
    np.testing.assert_array_equal(scene.final, T_map_camera[:, :3, 3])
    assert scene.T_map_camera is not None
    np.testing.assert_array_equal(scene.T_map_camera, T_map_camera[-1])
    assert f"{summary['gaussians']:,} Gaussians" in scene.facts
    assert folder.update() == set()


def test_objects_have_boxes_in_the_keyframes_that_show_them(run: Path) -> None:
    view = ObjectView(keyframe=0, box_px=(1.0, 2.0, 3.0, 4.0))
    map_object = msgspec.structs.replace(EXAMPLE_OBJECTS.objects[0], views=(view,))
    write_objects(run, msgspec.structs.replace(EXAMPLE_OBJECTS, objects=(map_object,)))
    folder = RunFolder(run, CONFIG)
    folder.update()
    assert folder.scene.objects is not None
    (detection,) = folder.scene.detections[0]
    assert (detection.name, detection.box_px) == (map_object.name, view.box_px)


def test_loops_are_pairs_of_keyframes(run: Path) -> None:
    closure = {
        "keyframe": 3,
        "reference": 0,
        "T_reference_keyframe": np.eye(4).tolist(),
    }
    text = json.dumps({"candidates": [], "closures": [closure]})
    (run / "loops.json").write_text(text)
    folder = RunFolder(run, CONFIG)
    folder.update()
    assert folder.scene.loops == ((0, 3),)


@pytest.mark.parametrize("name", PARTS)
def test_missing_file_is_skipped_without_a_complaint(run: Path, name: str) -> None:
    (run / name).unlink(missing_ok=True)
    folder = RunFolder(run, CONFIG)
    shown = folder.update()
    others = [layers for other, (layers, _) in PARTS.items() if (run / other).is_file()]
    assert shown == {"facts"}.union(*others)
    assert escaped(str(run)) not in folder.scene.facts


def test_unfinished_run_is_shown_as_its_files_appear(run: Path, tmp_path: Path) -> None:
    unfinished = tmp_path / "unfinished"
    unfinished.mkdir()
    for name in ("config.yaml", "frames.csv"):
        shutil.copy(run / name, unfinished)
    folder = RunFolder(unfinished, CONFIG)
    assert folder.update() == {"facts"}
    assert "in progress**: 16 frames" in folder.scene.facts
    for name in ("trajectory.txt", "map.ply"):
        shutil.copy(run / name, unfinished)
    assert folder.update() == {"facts", "camera", "final", "gaussians"}
    assert len(folder.scene.rows)


def test_changed_map_is_read_again(run: Path) -> None:
    folder = RunFolder(run, CONFIG)
    folder.update()
    rows = read_ply(run / "map.ply")[:10]
    write_ply(run / "map.ply", rows)
    assert folder.update() == {"gaussians", "facts"}
    np.testing.assert_array_equal(folder.scene.rows[:, 0:6], rows[:, 0:6])


def test_overwritten_run_replaces_everything_of_the_old_one(run: Path) -> None:
    """`ldo run --overwrite` removes one file after the other and writes the objects last."""
    write_objects(run, EXAMPLE_OBJECTS)
    folder = RunFolder(run, CONFIG)
    folder.update()
    assert folder.scene.objects is not None
    for name in PARTS:
        (run / name).unlink(missing_ok=True)
        folder.update()
    shutil.copy(run / "config.yaml", run / "frames.csv")
    folder.update()
    scene = folder.scene
    assert scene.objects is None
    assert len(scene.rows) == len(scene.online) == len(scene.final) == len(scene.keyframes) == 0
    assert "in progress" in scene.facts


def test_folder_is_not_read_without_a_watcher(run: Path) -> None:
    folder = RunFolder(run, CONFIG)
    assert folder.update(is_watched=False) == set()
    assert len(folder.scene.rows) == 0
    assert "gaussians" in folder.update()


def test_refined_map_replaces_the_map_of_the_run(run: Path) -> None:
    folder = RunFolder(run, CONFIG)
    folder.update()
    (run / "refined").mkdir()
    rows = read_ply(run / "map.ply")[:20]
    shutil.copy(run / "trajectory.txt", run / "refined")
    write_ply(run / "refined" / "map.ply", rows)
    assert folder.update() == {"camera", "final", "gaussians", "facts"}
    np.testing.assert_array_equal(folder.scene.rows[:, 0:6], rows[:, 0:6])


@pytest.mark.parametrize("name", [name for name in PARTS if name != "frames.csv"])
def test_broken_file_is_reported_until_it_is_repaired(run: Path, name: str) -> None:
    path = run / name
    good = path.read_bytes() if path.is_file() else None
    path.write_bytes(b"\xffbroken")
    folder = RunFolder(run, CONFIG)
    shown = folder.update()
    assert escaped(str(path)) in folder.scene.facts
    assert len(shown) > 3  # The other parts are shown.
    if good is not None:
        path.write_bytes(good)
        folder.update()
        assert escaped(str(path)) not in folder.scene.facts


def test_viewer_limits_apply_to_a_run(run: Path) -> None:
    folder = RunFolder(run, ViewerConfig(max_gaussians=100, max_poses=5))
    folder.update()
    rows = read_ply(run / "map.ply")
    assert len(folder.scene.rows) == 100
    assert weights(folder.scene.rows).min() >= np.sort(weights(rows))[-100]
    assert len(folder.scene.final) <= 5
    assert f"100 of {len(rows):,} Gaussians are drawn" in folder.scene.facts


def test_folder_without_a_run_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is not a folder"):
        RunFolder(tmp_path / "absent", CONFIG)
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(DataError, match="holds nothing that `ldo run` writes"):
        RunFolder(tmp_path, CONFIG)
    (tmp_path / "config.yaml").touch()
    (tmp_path / "state").mkdir()
    with pytest.raises(DataError, match="the state of a service"):
        RunFolder(tmp_path, CONFIG)
