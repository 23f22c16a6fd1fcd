"""Export of the map or the trajectory of a run for other programs."""

import csv
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from ldo_service.errors import ConfigError, DataError
from ldo_service.gaussians.file_formats import write_ply, write_splat, write_spz
from ldo_service.geometry import Trajectory, se3
from ldo_service.volumes import (
    OccupancyConfig,
    TsdfConfig,
    floor_plan,
    fuse,
    occupancy,
    write_floor_plan,
    write_mesh,
)

from .finished import MapFolder
from .folder import EXPORTED, WRITTEN

ExportFormat = Literal["ply", "splat", "spz", "tum", "csv", "mesh", "occupancy"]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
TRAJECTORY_COLUMNS = ("stamp_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
Advance = Callable[[int, int], None]  # Progress: number of done and of all keyframes.


@dataclass(frozen=True, slots=True)
class Job:
    """Map to export, output file and options, as given to the writer of a format."""

    source: MapFolder
    out: Path
    voxel_m: float | None  # Side of a voxel; None for the default of the format.
    up: Up  # Axis of the map that points up.
    # Lowest and highest height of the voxels in the floor plan, above the first camera.
    heights_m: tuple[float, float]
    threads: int  # Threads of mesh and occupancy.
    advance: Advance


def export_map(
    source: MapFolder,
    format: ExportFormat,
    out: Path,
    *,
    run: Path,
    voxel_m: float | None = None,
    up: Up = "-y",
    heights_m: tuple[float, float] = (-0.5, 0.5),
    overwrite: bool = False,
    threads: int | None = None,
    advance: Advance = lambda _done, _total: None,
) -> str:
    """Write the map or the trajectory to a file.

    Args:
        source: Folder with the map and the trajectory.
        format: Format of the file.
        out: File to write. `occupancy` also writes a floor plan beside it.
        run: Folder of the run, whose outputs are never replaced.
        voxel_m: Side of a voxel for the formats mesh and occupancy, meters; None for the default.
        up: Axis of the map that points up, for the floor plan of occupancy.
        heights_m: Lowest and highest height of the voxels in the floor plan of occupancy, meters
            above the first camera.
        overwrite: True to replace an existing file.
        threads: Number of threads for mesh and occupancy; None for all cores.
        advance: Function that receives the number of finished keyframes and the number of all
            keyframes, for mesh and occupancy.

    Returns:
        A short description of what was written.

    Raises:
        ConfigError: An option does not fit the format, the file exists or is an output of the run,
            or the file cannot be written.
        DataError: The map cannot be read, or has no surface.
    """
    if format not in WRITERS:
        raise ConfigError(
            f"the format {format!r} is unknown. Choose one of: {', '.join(get_args(ExportFormat))}."
        )
    if voxel_m is not None and format not in ("mesh", "occupancy"):
        raise ConfigError(
            f"a voxel size (--voxel) applies to the formats mesh and occupancy, not to {format}. "
            "Remove the voxel size."
        )
    written = [out.with_suffix(Path(name).suffix) for name in EXPORTED[format][1:]]
    if out in written:
        raise ConfigError(
            f"the occupancy grid cannot have the name {out}, because its floor plan is written to "
            f"this file. Use the name {out.with_suffix(Path(EXPORTED[format][0]).suffix).name}."
        )
    require_writable((run, source.folder), [out, *written], overwrite)
    try:
        threads = threads or os.cpu_count() or 1
        return WRITERS[format](Job(source, out, voxel_m, up, heights_m, threads, advance))
    except OSError as error:
        raise ConfigError(
            f"{out} cannot be written: {error.strerror}. Choose another file (--out)."
        ) from error


def require_writable(runs: Iterable[Path], files: list[Path], overwrite: bool) -> None:
    """Check that an export replaces neither an output of a run nor an existing file.

    Args:
        runs: Folders of runs.
        files: Files to write.
        overwrite: True if existing files may be replaced; outputs of a run are never replaced.

    Raises:
        ConfigError: If a file exists already, or is an output of a run.
    """
    exported = {name for names in EXPORTED.values() for name in names}
    kept = {(run / name).resolve() for run in runs for name in WRITTEN - exported}
    for file in files:
        if file.resolve() in kept:
            raise ConfigError(
                f"{file} is an output of the run, not an export. Choose another file (--out)."
            )
        if file.exists() and not overwrite:
            raise ConfigError(
                f"{file} exists. Choose another file (--out), or add --overwrite (in Python: "
                "overwrite=True)."
            )


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
    mesh = fuse(
        rows,
        viewpoints,
        config,
        threads=job.threads,
        advance=lambda done: job.advance(done, len(viewpoints)),
    ).mesh()
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
    grid = occupancy(
        rows,
        viewpoints,
        config,
        threads=job.threads,
        advance=lambda done: job.advance(done, len(viewpoints)),
    )
    plan = floor_plan(grid, job.up, job.heights_m)
    grid.save(job.out)
    write_floor_plan(job.out.with_suffix(".yaml"), plan)
    free, occupied = ((grid.states == state).sum() for state in (1, 2))
    return (
        f"{occupied:,} voxels of {grid.voxel_m} m occupied, {free:,} free; floor plan in "
        f"{job.out.with_suffix('.yaml').name}"
    )


WRITERS: dict[ExportFormat, Callable[[Job], str]] = {
    "ply": _gaussians(write_ply),
    "splat": _gaussians(write_splat),
    "spz": _gaussians(write_spz),
    "tum": _tum,
    "csv": _csv,
    "mesh": _mesh,
    "occupancy": _occupancy,
}
