"""Command `ldo eval`: evaluate the trajectory, loop closures, map and labels of a run."""

import json
import sys
from math import isfinite
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.config import Config, actor_parameters, load_config
from ldo_service.datasets import open_sequence
from ldo_service.errors import DataError
from ldo_service.evaluation import loops, semantics, trajectory, views
from ldo_service.evaluation.instances import mean_precision
from ldo_service.evaluation.label_lists import load_classes
from ldo_service.evaluation.label_measures import DetectionCounts
from ldo_service.evaluation.loops import LoopErrors
from ldo_service.evaluation.lpips import Lpips
from ldo_service.evaluation.results import Results, evaluate_run, to_json, work
from ldo_service.evaluation.semantics import GATES, LabelErrors
from ldo_service.evaluation.trajectory import TrajectoryErrors
from ldo_service.evaluation.views import RenderingErrors
from ldo_service.geometry.sequence import OdometryAsTruth
from ldo_service.runs.finished import read_run, require_file
from ldo_service.runs.networks import labelled_by

from .options import Json, Source, argument, note_console, progress

FIGURES = {
    "mIoU": "mean_iou",
    "objects": "object_iou",
    "by frequency": "weighted_iou",
    "accuracy": "mean_accuracy",
    "pixels": "pixel_accuracy",
}

WIDTH = 120  # Columns of the tables when the output is no terminal.
NO_TRUTH = "The source has no ground truth, so trajectories are not evaluated."
NO_MAP = "The run localized in {folder} and made no map, so renderings are not evaluated."
NO_PROTOCOL = "`ldo eval --protocol` prints how each metric is defined; so does docs/evaluation.md."
NO_LPIPS = "LPIPS is not computed; --lpips FILE.onnx adds it."


def label_table(rows: list[LabelErrors]) -> Table:
    """Return a table of label metrics.

    The table has a row for each combination of map, list of class names (`LabelErrors.lists`) and
    minimum class size (`GATES`).
    """
    table = Table("map", "names", "classes", *FIGURES, "per image", "frames")
    for row in rows:
        for errors in row.lists:
            for gate, share in GATES.items():
                figures = errors.figures(share)
                cells = [_percent(getattr(figures, figure)) for figure in FIGURES.values()]
                is_all = share == 0
                cells.append(_percent(errors.per_image_iou()) if is_all else "")
                names = f"{errors.labels.name}, {gate}"
                table.add_row(row.map, names, str(figures.classes), *cells, str(len(errors.frames)))
    return table


def open_table(rows: list[LabelErrors], calls_per_frame: float | None) -> Table:
    """Return a table of label consistency, scores of names outside COCO, and labeller requests.

    Args:
        rows: Label errors of each map.
        calls_per_frame: Requests to the labeller per frame; None if the run did not count them.
    """
    columns = ("map", "consistency", "beyond COCO: recall", "precision", "Labeller calls per frame")
    table = Table(*columns)
    for row in rows:
        calls = "not counted" if calls_per_frame is None else f"{calls_per_frame:.3f}"
        agreed = f"{_number(row.consistency.share)}, {row.pairs} pairs"
        table.add_row(row.map, agreed, *_shares(row.objects, "objects"), calls)
        table.add_row("", "", *_shares(row.pixels, "pixels"), "")
    return table


def instance_table(rows: list[LabelErrors]) -> Table:
    """Return a table with the average precision of the objects of each map, by list of classes."""
    table = Table("map", "objects, by names of", "classes", "AP50", "AP", "AP25")
    for row in rows:
        for errors in row.lists:
            if errors.instances is not None:
                mean = mean_precision(errors.instances)
                cells = (_percent(value) for value in (mean.ap50, mean.ap, mean.ap25))
                table.add_row(row.map, errors.labels.name, str(len(errors.instances)), *cells)
    return table


def _shares(found: DetectionCounts, what: str) -> tuple[str, str]:
    return (
        f"{_percent(found.recall)} of {found.wanted:,} {what}",
        f"{_percent(found.precision)} of {found.named:,}",
    )


def _percent(value: float) -> str:
    return f"{value:.1%}" if isfinite(value) else "-"


def _number(value: float) -> str:
    return f"{value:.3f}" if isfinite(value) else "-"


def evaluate(
    folder: Annotated[Path, tyro.conf.Positional, argument(metavar="DIR", help="folder of a run")],
    source: Source,
    lpips: Annotated[
        Path | None,
        argument(
            metavar="FILE.onnx",
            help="network of LPIPS, as torch.onnx.export writes lpips.LPIPS(net='alex'): "
            "two inputs, float32 [1, 3, H, W], RGB in -1..1; one output with a single number",
        ),
    ] = None,
    classes: Annotated[
        str,
        argument(
            metavar="NAME|FILE",
            help="also evaluate the labels with a list of classes: nyu40, scannet20, replica51, or "
            "a text file with one name per line",
        ),
    ] = "",
    odometry_as_truth: Annotated[
        bool,
        argument(
            help="compare with the odometry that the source contains, such as the poses of a "
            "phone, instead of ground truth"
        ),
    ] = False,
    protocol: Annotated[
        bool, argument(help="print the definition of the metrics above each table")
    ] = False,
    json_: Annotated[Json, argument(name="json")] = False,
) -> None:
    """Evaluate a run: its trajectory, loop closures, rendered map and labels.

    Trajectory and loop closures are compared with the true poses of the source. Renderings of the
    map are compared with the frames, and labels of the map with the true labels of the source.
    Without true poses, only the map is evaluated.

    The command writes trajectory.png and rendering.png into DIR. It also writes labels.png if the
    source has true labels and a detector or a labeller ran. `ldo run --hold-out-every 5` keeps
    every fifth frame out of the map, so that the map can be evaluated on these frames.

      ldo run ~/data/rgbd_dataset_freiburg1_desk --out runs/desk --hold-out-every 5
      ldo eval runs/desk ~/data/rgbd_dataset_freiburg1_desk
    """
    listed = load_classes(classes) if classes else None
    config = run_config(folder)
    threads = actor_parameters(config).mapper.thread_count()
    distance = Lpips(lpips, threads=threads) if lpips else None
    run = read_run(folder, has_map=not config.tracker.localization_map)
    sequence = open_sequence(source, config.dataset.options())
    run.require_source(sequence)
    if odometry_as_truth:
        if sequence.odometry() is None:
            raise DataError(f"{source} contains no odometry. Remove --odometry-as-truth.")
        sequence = OdometryAsTruth(sequence)
    with progress("eval", work(run, sequence), note_console()) as advance:
        results = evaluate_run(
            run, sequence, advance, distance=distance, threads=threads, classes=listed
        )
    if json_:
        about = {"lpips": lpips and str(lpips), "labelled_by": labelled_by(config)}
        print(json.dumps({**to_json(results), **about}, indent=1))
    else:
        print_results(results, lpips, config, has_protocol=protocol)


def run_config(folder: Path) -> Config:
    """Read the configuration that a run was made with.

    Raises:
        DataError: The folder has no config.yaml.
    """
    return load_config(require_file(folder, "config.yaml"))


def print_results(
    results: Results, lpips: Path | None, config: Config, *, has_protocol: bool = False
) -> None:
    """Print all results of an evaluation as tables.

    Args:
        results: The results.
        lpips: Network of LPIPS; None if LPIPS was not computed.
        config: Configuration of the run.
        has_protocol: True to print the definition of the metrics above each table.
    """
    width = None if sys.stdout.isatty() else WIDTH
    console = Console(highlight=False, markup=False, width=width)

    def explain(definitions: str) -> None:
        if has_protocol:
            console.print(definitions, style="dim")

    console.print(str(results.counts))
    if results.trajectories is None:
        console.print(NO_TRUTH)
    else:
        explain(trajectory.PROTOCOL)
        console.print(trajectory_table(results.trajectories))
    if results.loops is not None:
        explain(loops.PROTOCOL)
        console.print(loops_table(results.loops))
    if config.tracker.localization_map:
        console.print(NO_MAP.format(folder=config.tracker.localization_map), soft_wrap=True)
    else:
        explain(views.PROTOCOL)
        _print_renderings(console, results, lpips)
        if results.labels:
            explain(semantics.PROTOCOL)
        _print_labels(console, results, labelled_by(config))
    if not has_protocol:
        console.print(NO_PROTOCOL, style="dim")
    console.print("Pictures: " + ", ".join(map(str, results.pictures)), soft_wrap=True)


def _print_renderings(console: Console, results: Results, lpips: Path | None) -> None:
    console.print(results.evaluated.counts(), style="dim")
    console.print(f"LPIPS by {lpips}." if lpips else NO_LPIPS, style="dim")
    if results.renderings:
        console.print(rendering_table(results.renderings, has_lpips=lpips is not None))


def _print_labels(console: Console, results: Results, who: dict[str, str]) -> None:
    """Print the label results, or the reason why labels are not evaluated."""
    if results.unlabelled:
        console.print(results.unlabelled, style="dim")
    if not results.labels:
        return
    named = (f"{kind}: {name or 'none'}" for kind, name in who.items())
    console.print(f"Labels by {', '.join(named)}.", style="dim", soft_wrap=True)
    console.print(label_table(results.labels))
    console.print(open_table(results.labels, results.vlm_calls_per_frame))
    if results.labels[-1].lists[0].instances is not None:
        console.print(instance_table(results.labels))


def trajectory_table(rows: dict[str, TrajectoryErrors]) -> Table:
    """Return a table with the errors of each trajectory."""
    table = Table("trajectory", "poses", "ATE RMSE", "mean", "median", "max", "RPE 1 s")
    for name, errors in rows.items():
        ate = errors.ate_m
        lengths = (ate.rmse, ate.mean, ate.median, ate.max)
        rpe = "-"
        if errors.rpe_translation_m and errors.rpe_rotation_deg:
            rpe = (
                f"{100 * errors.rpe_translation_m.rmse:.2f} cm, "
                f"{errors.rpe_rotation_deg.rmse:.2f} deg"
            )
        table.add_row(name, str(errors.poses), *(f"{100 * m:.2f} cm" for m in lengths), rpe)
    return table


def loops_table(errors: LoopErrors) -> Table:
    """Return a table with the precision, recall, pose errors and times of loop closing."""
    table = Table("loops", "precision", "recall", "position", "rotation", "ms p50", "p95")
    table.add_row(
        f"{errors.closures} of {errors.candidates}",
        _share(errors.precision),
        f"{_share(errors.recall)} of {errors.queries}",
        _spread(errors.position_errors_m, 100, "cm"),
        _spread(errors.rotation_errors_deg, 1, "deg"),
        *(f"{np.percentile(errors.ms, q):.0f}" if errors.ms else "-" for q in (50, 95)),
    )
    return table


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _spread(values: tuple[float, ...], factor: float, unit: str) -> str:
    """Return the median and the maximum of values, times `factor`, as text with a unit."""
    if not values:
        return "-"
    return f"{factor * np.median(values):.2f}, at most {factor * max(values):.2f} {unit}"


def rendering_table(rows: list[RenderingErrors], *, has_lpips: bool) -> Table:
    """Return a table with the image errors of each map under each evaluation protocol."""
    columns = {"PSNR dB": ("psnr_db", 1, ".2f"), "SSIM": ("ssim", 1, ".3f")}
    if has_lpips:
        columns["LPIPS"] = ("lpips", 1, ".3f")
    columns |= {"depth L1 cm": ("depth_l1_m", 100, ".2f"), "of measured": ("depth_share", 1, ".1%")}
    table = Table("map", "protocol", "frames", *columns)
    for row in rows:
        cells = (_mean_and_median(row, *column) for column in columns.values())
        table.add_row(row.map, row.protocol, str(len(row.views)), *cells)
    return table


def _mean_and_median(row: RenderingErrors, figure: str, factor: float, form: str) -> str:
    values = (row.mean(figure), row.median(figure))
    return " / ".join("-" if value is None else f"{value * factor:{form}}" for value in values)
