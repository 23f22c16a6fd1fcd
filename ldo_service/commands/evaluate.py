"""ldo eval"""

import csv
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.config import Config, load_config
from ldo_service.errors import DataError
from ldo_service.evaluation.pictures import save_picture, trajectory_picture
from ldo_service.evaluation.trajectory import (
    PROTOCOL,
    TrajectoryErrors,
    evaluate_trajectory,
)
from ldo_service.geometry import Trajectory
from ldo_service.recordings.sequence import open_source

from .options import Json, Source

WIDTH = 120  # of the table in a file
STAMP_TOLERANCE_S = 1e-6  # the files print stamps to the nanosecond


@dataclass(frozen=True, slots=True)
class Row:
    name: str
    errors: TrajectoryErrors


def evaluate(
    folder: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR", help="what `ldo run` wrote")
    ],
    source: Source,
    json_: Annotated[Json, tyro.conf.arg(name="json")] = False,
) -> None:
    """Compare a run with the ground truth of its source.

    Prints the protocol above the figures, and draws trajectory.png into DIR.
    """
    truth = open_source(source, run_config(folder).data.options()).truth()
    if truth is None:
        raise DataError(f"{source} has no ground truth, so there is nothing to compare with.")
    final = read_trajectory(folder, "trajectory.txt")
    rows = compare(folder, final, truth)
    save_picture(folder / "trajectory.png", trajectory_picture(final, truth))
    if json_:
        print(json.dumps({row.name: plain(row.errors) for row in rows}, indent=1))
        return
    console = Console(highlight=False, width=None if sys.stdout.isatty() else WIDTH)
    console.print(PROTOCOL, style="dim")
    console.print(errors_table(rows))
    console.print(f"Picture: {folder / 'trajectory.png'}")


def run_config(folder: Path) -> Config:
    """The configuration that a run was made with."""
    if not (folder / "config.yaml").is_file():
        raise DataError(f"{folder} has no config.yaml: is it what `ldo run` wrote?")
    return load_config(folder / "config.yaml")


def compare(folder: Path, final: Trajectory, truth: Trajectory) -> list[Row]:
    """Online and final; all frames that have a pose, and those whose pose was trusted."""
    online = read_trajectory(folder, "trajectory_online.txt")
    ok_s = stamps_with_status(folder, "OK")
    rows = []
    for name, trajectory in (("online", online), ("final", final)):
        rows.append(Row(name, evaluate_trajectory(trajectory, truth)))
        trusted = at_stamps(trajectory, ok_s)
        if len(trusted) != len(trajectory):
            rows.append(Row(f"{name}, OK frames", evaluate_trajectory(trusted, truth)))
    return rows


def read_trajectory(folder: Path, name: str) -> Trajectory:
    try:
        return Trajectory.load(folder / name)
    except OSError as error:
        raise DataError(
            f"{folder / name} cannot be read ({error.strerror}): is {folder} what `ldo run` wrote?"
        ) from error


def stamps_with_status(folder: Path, status: str) -> np.ndarray:
    """Stamps in seconds of the frames with a status."""
    try:
        with (folder / "frames.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        return np.array([int(row["stamp_ns"]) * 1e-9 for row in rows if row["status"] == status])
    except (OSError, KeyError, ValueError) as error:
        raise DataError(f"{folder / 'frames.csv'} cannot be read: {error!r}.") from error


def at_stamps(trajectory: Trajectory, stamps_s: np.ndarray) -> Trajectory:
    """The poses whose stamp is among `stamps_s` [M], ascending."""
    if len(stamps_s) == 0:
        return Trajectory(trajectory.stamps_s[:0], trajectory.T_world_camera[:0])
    nearest = np.searchsorted(stamps_s, trajectory.stamps_s - STAMP_TOLERANCE_S)
    gaps_s = stamps_s[np.minimum(nearest, len(stamps_s) - 1)] - trajectory.stamps_s
    chosen = np.abs(gaps_s) <= STAMP_TOLERANCE_S
    return Trajectory(trajectory.stamps_s[chosen], trajectory.T_world_camera[chosen])


def errors_table(rows: list[Row]) -> Table:
    table = Table("trajectory", "poses", "ATE RMSE", "mean", "median", "max", "RPE 1 s")
    for row in rows:
        ate, errors = row.errors.ate_m, row.errors
        lengths = (ate.rmse, ate.mean, ate.median, ate.max)
        rpe = "-"
        if errors.rpe_translation_m and errors.rpe_rotation_deg:
            rpe = (
                f"{100 * errors.rpe_translation_m.rmse:.2f} cm, "
                f"{errors.rpe_rotation_deg.rmse:.2f} deg"
            )
        table.add_row(row.name, str(errors.poses), *(f"{100 * m:.2f} cm" for m in lengths), rpe)
    return table


def plain(errors: TrajectoryErrors) -> dict[str, Any]:
    tree = asdict(errors)
    tree["T_truth_estimate"] = errors.T_truth_estimate.tolist()
    return tree
