"""Command `ldo export`."""

import csv
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from ldo_service.errors import ConfigError, DataError
from ldo_service.gaussians.file_formats import write_ply, write_splat, write_spz
from ldo_service.geometry import Trajectory, se3
from ldo_service.runs.finished import MapFolder, newest_map
from ldo_service.runs.folder import EXPORTED, WRITTEN
from ldo_service.volumes import (
    OccupancyConfig,
    TsdfConfig,
    floor_plan,
    fuse,
    occupancy,
    write_floor_plan,
    write_mesh,
)

from .options import argument, progress

Format = Literal["ply", "splat", "spz", "tum", "csv", "mesh", "occupancy"]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
TRAJECTORY_COLUMNS = ("stamp_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")


@dataclass(frozen=True, slots=True)
class Job:
    """Map to export, output file and options, as given to the writer of a format."""

    source: MapFolder
    out: Path
    voxel_m: float | None  # Side of a voxel; None for the default of the format.
    up: Up  # Axis of the map that points up.
    heights_m: tuple[float, float]  # Height range of the floor plan above the first camera.
    console: Console


def export(
    folder: Annotated[Path, tyro.conf.Positional, argument(metavar="DIR", help="folder of a run")],
    format: Annotated[
        Format,
        argument(
            help="Gaussians: ply, splat, spz; trajectory: tum, csv; for planners: mesh, occupancy"
        ),
    ],
    out: Annotated[
        Path | None,
        argument(metavar="FILE", help="default: a file in DIR, named after the format"),
    ] = None,
    online: Annotated[
        bool, argument(help="export the map and poses before the refinement")
    ] = False,
    voxel: Annotated[
        float | None,
        argument(metavar="M", help="side of a voxel, meters; default: mesh 0.02, occupancy 0.1"),
    ] = None,
    up: Annotated[
        Up, argument(help="axis of the map that points up, for the floor plan of occupancy")
    ] = "-y",
    heights: Annotated[
        tuple[float, float],
        argument(
            metavar="MIN MAX", help="height range of the floor plan, meters above the first camera"
        ),
    ] = (-0.5, 0.5),
    overwrite: Annotated[bool, argument(help="replace an earlier FILE")] = False,
) -> None:
    """Write the map or the trajectory of a run for other programs.

    The refined map is exported if there is one. `mesh` is a PLY file with colored triangles.
    `occupancy` is an .npz file with a grid of free, occupied and unknown voxels; a floor plan (.pgm
    and .yaml) for map_server of ROS is written beside it. The map has the axes of the first camera
    pose, so `--up -y` is right if the camera was level at the start.

      ldo export runs/desk --format splat
      ldo export runs/desk --format occupancy --voxel 0.05 --heights -0.8 0.3
    """
    if voxel is not None and format not in ("mesh", "occupancy"):
        raise ConfigError(f"--voxel applies to mesh and occupancy, not to {format}. Remove it.")
    source = MapFolder(folder) if online else newest_map(folder)
    out = out or folder / EXPORTED[format][0]
    written = [out.with_suffix(Path(name).suffix) for name in EXPORTED[format][1:]]
    require_writable((folder, source.folder), [out, *written], overwrite)
    job = Job(source, out, voxel, up, heights, Console(stderr=True, highlight=False))
    try:
        facts = WRITERS[format](job)
    except OSError as error:
        raise ConfigError(
            f"{out} cannot be written: {error.strerror}. Choose another --out."
        ) from error
    Console(highlight=False).print(f"{out}: {facts}", soft_wrap=True)


def require_writable(runs: Iterable[Path], files: list[Path], overwrite: bool) -> None:
    """Check that an export replaces neither an output of a run nor an existing file.

    Args:
        runs: Folders of runs.
        files: Files to write.
        overwrite: True if existing files may be replaced; outputs of a run never may.

    Raises:
        ConfigError: If a file exists already, or is an output of a run.
    """
    exported = {name for names in EXPORTED.values() for name in names}
    kept = {(run / name).resolve() for run in runs for name in WRITTEN - exported}
    for file in files:
        if file.resolve() in kept:
            raise ConfigError(
                f"{file} is an output of the run, not an export. Choose another --out."
            )
        if file.exists() and not overwrite:
            raise ConfigError(f"{file} exists. Choose another --out, or add --overwrite.")


# --- writers: each returns a short description of what it wrote ---------------------------------
def _gaussians(write: Callable) -> Callable[[Job], str]:
    def write_gaussians(job: Job) -> str:
        rows = job.source.gaussians()
        write(job.out, rows)
        return f"{len(rows):,} Gaussians"

    return write_gaussians


def _tum(job: Job) -> str:
    trajectory = job.source.trajectory()
    trajectory.save(job.out)
    return f"{len(trajectory):,} poses"


def _csv(job: Job) -> str:
    trajectory = job.source.trajectory()
    write_csv(job.out, trajectory)
    return f"{len(trajectory):,} poses"


def write_csv(path: Path, trajectory: Trajectory) -> None:
    """Write a CSV file of poses T_map_camera: stamp (s), position (m), quaternion wxyz."""
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(TRAJECTORY_COLUMNS)
        for stamp_s, T in zip(trajectory.stamps_s, trajectory.T_world_camera, strict=True):
            numbers = (stamp_s, *T[:3, 3], *se3.quaternion(T[:3, :3]))
            table.writerow(f"{number:.9f}" for number in numbers)


def _mesh(job: Job) -> str:
    config = TsdfConfig() if job.voxel_m is None else TsdfConfig(job.voxel_m)
    rows, viewpoints = job.source.gaussians(), job.source.viewpoints()
    with progress("mesh", len(viewpoints), job.console) as advance:
        mesh = fuse(rows, viewpoints, config, threads=os.cpu_count() or 1, advance=advance).mesh()
    if not len(mesh.triangles):
        raise DataError(
            "the keyframes see no surface, so the mesh would be empty. Check the map in `ldo view`."
        )
    write_mesh(job.out, mesh)
    vertices, triangles = len(mesh.vertices_m), len(mesh.triangles)
    return f"{vertices:,} vertices, {triangles:,} triangles, {mesh.area_m2:.1f} m2"


def _occupancy(job: Job) -> str:
    config = OccupancyConfig() if job.voxel_m is None else OccupancyConfig(job.voxel_m)
    rows, viewpoints = job.source.gaussians(), job.source.viewpoints()
    with progress("occupancy", len(viewpoints), job.console) as advance:
        grid = occupancy(rows, viewpoints, config, threads=os.cpu_count() or 1, advance=advance)
    plan = floor_plan(grid, job.up, job.heights_m)
    grid.save(job.out)
    write_floor_plan(job.out.with_suffix(".yaml"), plan)
    free, occupied = ((grid.states == state).sum() for state in (1, 2))
    return (
        f"{occupied:,} voxels of {grid.voxel_m} m occupied, {free:,} free; floor plan in "
        f"{job.out.with_suffix('.yaml').name}"
    )


WRITERS: dict[Format, Callable[[Job], str]] = {
    "ply": _gaussians(write_ply),
    "splat": _gaussians(write_splat),
    "spz": _gaussians(write_spz),
    "tum": _tum,
    "csv": _csv,
    "mesh": _mesh,
    "occupancy": _occupancy,
}
