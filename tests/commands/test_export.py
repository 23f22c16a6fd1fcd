"""Files of `ldo export`, read with other libraries: gsply, trimesh, evo, OpenCV and YAML."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ldo_service.commands import cli
from ldo_service.errors import LdoError
from ldo_service.gaussians.file_formats import read_ply, write_ply
from ldo_service.geometry import Trajectory, se3
from ldo_service.runs.folder import WRITTEN, prepare


def ldo_export(*arguments: object) -> tuple[int, str]:
    """Run `ldo export ... --debug`; return its exit code and the error."""
    try:
        cli.main(["export", *map(str, arguments), "--debug"])
    except LdoError as error:
        return error.exit_code, str(error)
    except SystemExit as error:
        return int(error.code or 0), ""
    return 0, ""


def export(run: Path, format: str, *options: object) -> None:
    assert ldo_export(run, "--format", format, *options) == (0, "")


def test_gaussians_as_ply(run: Path) -> None:
    export(run, "ply")
    np.testing.assert_allclose(
        read_ply(run / "gaussians.ply"), read_ply(run / "map.ply"), atol=1e-6
    )


def test_gaussians_as_splat(run: Path) -> None:
    export(run, "splat")
    rows = read_ply(run / "map.ply")
    assert (run / "gaussians.splat").stat().st_size == 32 * len(rows)


def test_gaussians_as_spz(run: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="pip install -e '.[viewer]'")
    export(run, "spz")
    means = gsply.read_spz(run / "gaussians.spz").means
    expected = read_ply(run / "map.ply")[:, 0:3] * [1, -1, -1]
    np.testing.assert_allclose(means, expected, atol=0.0002)


def test_the_trajectory_as_tum(run: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="pip install evo")
    export(run, "tum")
    read = file_interface.read_tum_trajectory_file(str(run / "trajectory.tum"))
    expected = Trajectory.load(run / "trajectory.txt")
    np.testing.assert_allclose(read.poses_se3, expected.T_world_camera, atol=1e-7)
    np.testing.assert_allclose(read.timestamps, expected.stamps_s, atol=1e-9)


def test_the_trajectory_as_csv(run: Path) -> None:
    export(run, "csv")
    with (run / "trajectory.csv").open(newline="") as file:
        lines = [{k: float(v) for k, v in line.items()} for line in csv.DictReader(file)]
    expected = Trajectory.load(run / "trajectory.txt")
    assert len(lines) == 16
    for line, T in zip(lines, expected.T_world_camera, strict=True):
        R = se3.rotation(np.array([line["qw"], line["qx"], line["qy"], line["qz"]]))
        np.testing.assert_allclose([line["x_m"], line["y_m"], line["z_m"]], T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(R, T[:3, :3], atol=1e-7)
    assert [line["stamp_s"] for line in lines] == pytest.approx(expected.stamps_s, abs=1e-9)


def test_a_mesh_for_planners(run: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh")
    export(run, "mesh", "--voxel", "0.04", "--out", run / "surface.ply")
    mesh = trimesh.load(run / "surface.ply", process=False)
    assert len(mesh.faces) > 3000
    assert 3 < mesh.area < 100
    assert mesh.visual.vertex_colors[:, :3].std() > 10


def test_occupancy_for_planners(run: Path) -> None:
    export(run, "occupancy", "--up", "-y", "--heights", "-0.4", "0.6", "--out", run / "grid.npz")
    grid = np.load(run / "grid.npz")
    assert grid["voxel_m"] == 0.1
    assert set(np.unique(grid["states"])) == {0, 1, 2}
    corner = np.round(-grid["origin_m"] / grid["voxel_m"]).astype(int)
    around = tuple(slice(i - 1, i + 1) for i in corner)
    assert 1 in grid["states"][around], "the first camera was at the origin, a corner of voxels"
    facts = yaml.safe_load((run / "grid.yaml").read_text())
    picture = cv2.imread(str(run / facts["image"]), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(picture)) == {0, 205, 254}
    # Image axes: z upwards, x to the right.
    assert picture.shape == grid["states"].shape[::2][::-1]


def refine(run: Path) -> None:
    """Add a refined map of 100 Gaussians to the run."""
    (run / "refined").mkdir()
    write_ply(run / "refined" / "map.ply", read_ply(run / "map.ply")[:100])


def test_refined_map_is_exported_unless_online_is_requested(run: Path) -> None:
    refine(run)
    export(run, "ply", "--out", run / "a.ply")
    export(run, "ply", "--out", run / "b.ply", "--online")
    assert len(read_ply(run / "a.ply")) == 100
    assert len(read_ply(run / "b.ply")) > 100


def test_existing_file_is_replaced_only_with_overwrite(run: Path) -> None:
    (run / "gaussians.splat").write_text("mine")
    code, message = ldo_export(run, "--format", "splat")
    assert code == 2
    assert "--overwrite" in message
    assert (run / "gaussians.splat").read_text() == "mine"
    export(run, "splat", "--overwrite")


def test_existing_floor_plan_blocks_the_export_of_occupancy(run: Path) -> None:
    (run / "occupancy.yaml").write_text("mine")
    code, message = ldo_export(run, "--format", "occupancy")
    assert (code, "occupancy.yaml exists" in message) == (2, True)
    assert not (run / "occupancy.npz").exists()


def test_voxel_size_for_a_trajectory_is_refused(run: Path) -> None:
    code, message = ldo_export(run, "--format", "tum", "--voxel", "0.1")
    assert (code, "(--voxel) applies to the formats mesh and occupancy" in message) == (2, True)


@pytest.mark.parametrize("name", ["map.ply", "summary.json", "refined/map.ply"])
def test_files_of_the_run_are_never_overwritten(run: Path, name: str) -> None:
    """The path of the refined map counts as a file of the run."""
    refine(run)
    before = (run / name).read_bytes()
    code, message = ldo_export(run, "--format", "ply", "--out", run / name, "--overwrite")
    assert (code, "Choose another" in message) == (2, True)
    assert (run / name).read_bytes() == before


def test_new_run_may_replace_exported_files(run: Path) -> None:
    for format in ("csv", "occupancy"):
        export(run, format)
    assert {path.name for path in run.iterdir()} <= WRITTEN
    prepare(run, overwrite=True)
    assert not list(run.iterdir())


@pytest.mark.parametrize("format", ["mesh", "occupancy"])
def test_keyframes_without_camera_are_bad_data(run: Path, format: str) -> None:
    keyframes = json.loads((run / "keyframes.json").read_text())
    for keyframe in keyframes:
        del keyframe["camera"]
    (run / "keyframes.json").write_text(json.dumps(keyframes))
    code, message = ldo_export(run, "--format", format)
    assert (code, "`ldo run` on the sequence again" in message) == (3, True)


@pytest.mark.parametrize(
    ("name", "content", "format"),
    [
        ("map.ply", "ply", "splat"),
        ("keyframes.json", "[{]", "mesh"),
        ("keyframes.json", "[[]]", "mesh"),
        ("keyframes.json", '[{"camera": {}}]', "mesh"),
        ("trajectory.txt", "1 2 3", "csv"),
    ],
)
def test_damaged_run_is_bad_data_and_names_the_file(
    run: Path, name: str, content: str, format: str
) -> None:
    (run / name).write_text(content)
    code, message = ldo_export(run, "--format", format)
    assert code == 3
    assert name in message


def test_folder_without_a_run_is_bad_data(tmp_path: Path) -> None:
    code, message = ldo_export(tmp_path, "--format", "tum")
    assert (code, "Give the folder of a finished `ldo run`" in message) == (3, True)


def test_missing_output_folder_is_reported(run: Path) -> None:
    code, message = ldo_export(run, "--format", "tum", "--out", run / "absent" / "a.tum")
    assert (code, "cannot be written" in message) == (2, True)
