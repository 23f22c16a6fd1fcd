"""Command `ldo export`: write the map or the trajectory of a run for other programs."""

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from ldo_service.runs.export import ExportFormat, Up, export_map
from ldo_service.runs.finished import MapFolder, newest_map
from ldo_service.runs.folder import EXPORTED

from .options import argument, note_console, progress


def export(
    folder: Annotated[Path, tyro.conf.Positional, argument(metavar="DIR", help="folder of a run")],
    format: Annotated[
        ExportFormat,
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
    and .yaml) for map_server of ROS is written next to it. The map has the axes of the first camera
    pose, so `--up -y` is right if the camera was level at the start.

      ldo export runs/desk --format splat
      ldo export runs/desk --format occupancy --voxel 0.05 --heights -0.8 0.3
    """
    source = MapFolder(folder) if online else newest_map(folder)
    out = out or folder / EXPORTED[format][0]
    console = note_console()
    # Formats without keyframes finish immediately and show no progress.
    has_progress = format in ("mesh", "occupancy")
    with progress(format, 1, console) if has_progress else nullcontext(_no_progress) as advance:
        facts = export_map(
            source,
            format,
            out,
            run=folder,
            voxel_m=voxel,
            up=up,
            heights_m=heights,
            overwrite=overwrite,
            advance=advance,
        )
    Console(highlight=False, markup=False).print(f"{out}: {facts}", soft_wrap=True)


def _no_progress(_done: int, _total: int | None = None, /) -> None:
    pass
