"""What a run left, or has left so far."""

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
FOUND = EXAMPLES["map_objects"]
assert isinstance(FOUND, MapObjects)


@pytest.fixture
def run(finished_run: Path, tmp_path: Path) -> Path:
    """A copy, to be changed."""
    return shutil.copytree(finished_run, tmp_path / "run")


def test_all_that_a_run_left_is_shown(run: Path) -> None:
    folder = RunFolder(run, CONFIG)
    assert folder.update() >= {"gaussians", "online", "final", "keyframes", "loops", "facts"}
    scene, summary = folder.scene, json.loads((run / "summary.json").read_text())
    keyframes = json.loads((run / "keyframes.json").read_text())
    assert len(scene.rows) == summary["gaussians"]
    assert list(scene.keyframes) == [one["keyframe"] for one in keyframes]
    np.testing.assert_allclose(scene.keyframes[0], keyframes[0]["T_map_camera"])
    assert scene.camera is not None
    assert scene.camera.width == keyframes[0]["camera"]["width"]
    T_map_camera = Trajectory.load(run / "trajectory.txt").T_world_camera
    np.testing.assert_array_equal(scene.final, T_map_camera[:, :3, 3])
    assert scene.T_map_camera is not None
    np.testing.assert_array_equal(scene.T_map_camera, T_map_camera[-1])
    assert f"{summary['gaussians']:,} Gaussians" in scene.facts
    assert folder.update() == set()


def test_objects_and_the_keyframes_that_show_them(run: Path) -> None:
    view = ObjectView(keyframe=0, box_px=(1.0, 2.0, 3.0, 4.0))
    one = msgspec.structs.replace(FOUND.objects[0], views=(view,))
    write_objects(run, msgspec.structs.replace(FOUND, objects=(one,)))
    folder = RunFolder(run, CONFIG)
    folder.update()
    assert folder.scene.objects is not None
    (sight,) = folder.scene.sights[0]
    assert (sight.name, sight.box_px) == (one.name, view.box_px)


def test_loops_are_lines_between_keyframes(run: Path) -> None:
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
def test_what_is_not_there_is_left_out(run: Path, name: str) -> None:
    (run / name).unlink(missing_ok=True)
    folder = RunFolder(run, CONFIG)
    shown = folder.update()
    others = [layers for other, (layers, _) in PARTS.items() if (run / other).is_file()]
    assert shown == {"facts"}.union(*others)
    assert escaped(str(run)) not in folder.scene.facts  # no complaint


def test_a_run_under_way_is_shown_as_it_comes(run: Path, tmp_path: Path) -> None:
    young = tmp_path / "young"
    young.mkdir()
    for name in ("config.yaml", "frames.csv"):
        shutil.copy(run / name, young)
    folder = RunFolder(young, CONFIG)
    assert folder.update() == {"facts"}
    assert "in progress**: 16 frames" in folder.scene.facts
    for name in ("trajectory.txt", "map.ply"):
        shutil.copy(run / name, young)
    assert folder.update() == {"facts", "camera", "final", "gaussians"}
    assert len(folder.scene.rows)


def test_a_map_that_changes_is_read_again(run: Path) -> None:
    folder = RunFolder(run, CONFIG)
    folder.update()
    rows = read_ply(run / "map.ply")[:10]
    write_ply(run / "map.ply", rows)
    assert folder.update() == {"gaussians", "facts"}
    np.testing.assert_array_equal(folder.scene.rows[:, 0:6], rows[:, 0:6])


def test_a_run_that_is_written_anew_leaves_nothing_of_the_old_one(run: Path) -> None:
    """As `ldo run --overwrite` does it, one file after the other; there are no objects yet."""
    write_objects(run, FOUND)
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


def test_a_folder_is_not_read_while_nobody_watches(run: Path) -> None:
    folder = RunFolder(run, CONFIG)
    assert folder.update(is_watched=False) == set()
    assert len(folder.scene.rows) == 0
    assert "gaussians" in folder.update()


def test_what_was_refined_is_shown_in_place_of_the_runs_own(run: Path) -> None:
    folder = RunFolder(run, CONFIG)
    folder.update()
    (run / "refined").mkdir()
    rows = read_ply(run / "map.ply")[:20]
    shutil.copy(run / "trajectory.txt", run / "refined")
    write_ply(run / "refined" / "map.ply", rows)
    assert folder.update() == {"camera", "final", "gaussians", "facts"}
    np.testing.assert_array_equal(folder.scene.rows[:, 0:6], rows[:, 0:6])


@pytest.mark.parametrize("name", [name for name in PARTS if name != "frames.csv"])
def test_a_broken_file_is_told_of_until_it_is_mended(run: Path, name: str) -> None:
    path = run / name
    good = path.read_bytes() if path.is_file() else None
    path.write_bytes(b"\xffbroken")
    folder = RunFolder(run, CONFIG)
    shown = folder.update()
    assert escaped(str(path)) in folder.scene.facts
    assert len(shown) > 3  # the others are there
    if good is not None:
        path.write_bytes(good)
        folder.update()
        assert escaped(str(path)) not in folder.scene.facts


def test_limits_hold_for_a_run_too(run: Path) -> None:
    folder = RunFolder(run, ViewerConfig(most_gaussians=100, most_poses=5))
    folder.update()
    rows = read_ply(run / "map.ply")
    assert len(folder.scene.rows) == 100
    assert weights(folder.scene.rows).min() >= np.sort(weights(rows))[-100]
    assert len(folder.scene.final) <= 5
    assert f"100 of {len(rows):,} Gaussians are drawn" in folder.scene.facts


def test_a_folder_that_no_run_wrote_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is not a folder"):
        RunFolder(tmp_path / "absent", CONFIG)
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(DataError, match="holds nothing that `ldo run` writes"):
        RunFolder(tmp_path, CONFIG)
    (tmp_path / "config.yaml").touch()
    (tmp_path / "state").mkdir()
    with pytest.raises(DataError, match="the state of a service"):
        RunFolder(tmp_path, CONFIG)
