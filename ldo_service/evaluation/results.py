"""Evaluation of a finished run: scores, pictures, and the results as JSON."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence

from . import loops, semantics, trajectory, views
from .finished_run import FinishedRun, FrameCounts, at_stamps
from .label_lists import LabelSet
from .label_results import finite, plain_labels, sheet_of_labels
from .loops import LoopErrors, evaluate_loops, seen_keyframes
from .pictures import save_picture, trajectory_picture
from .semantics import LabelErrors, evaluate_labels
from .sheet import rendering_sheet
from .trajectory import TrajectoryErrors, evaluate_trajectory
from .views import FIGURES, Distance, EvaluatedFrames, RenderedView, RenderingErrors, view_of

NO_TRUTH = "The source has no true labels, so the labels of the map are not evaluated."
NO_LABELS = "The map has no labels to evaluate. Run with a detector: --set detector.model=NAME."


@dataclass(frozen=True, slots=True)
class Results:
    """Scores and pictures of a run."""

    # Trajectory errors by name of the estimate; None without ground truth.
    trajectories: dict[str, TrajectoryErrors] | None
    evaluated: EvaluatedFrames
    renderings: list[RenderingErrors]
    labels: list[LabelErrors]  # One per map with labels; empty if the source has no true labels.
    unlabelled: str  # Reason why labels are not evaluated, or empty.
    counts: FrameCounts  # Numbers of frames with a pose.
    vlm_calls_per_frame: float | None  # Labeller calls; None if the run did not record them.
    pictures: list[Path]  # Files that were written.
    loops: LoopErrors | None = None  # Loop errors; None without ground truth or loop closing.


def evaluate_run(
    run: FinishedRun,
    sequence: Sequence,
    advance: Callable[[int], None],
    *,
    distance: Distance | None = None,
    threads: int = 1,
    evaluated: EvaluatedFrames | None = None,
    classes: LabelSet | None = None,
) -> Results:
    """Evaluate trajectories, loops, maps and labels of a run, and save pictures of them.

    Args:
        run: The run.
        sequence: Source of the run, with ground truth and true labels if known.
        advance: Progress function, called with the number of frames done so far; the function
            `work` of this module returns the total.
        distance: Function that returns the LPIPS distance of two images; None to omit LPIPS.
        threads: Threads of the renderer.
        evaluated: Frames whose renderings are evaluated; None for all held-out frames and every
            fifth training frame, see `views.PROTOCOL`.
        classes: List of classes to evaluate in addition to COCO and all names; None for no list.

    Raises:
        DataError: If a file of the run does not fit the sequence, or nothing can be evaluated.
        ConfigError: If a picture cannot be written.
    """
    evaluated, truth = evaluated or EvaluatedFrames.of(run.frames), sequence.truth()
    if truth is None and not (evaluated.posed and run.maps):
        missing = "pose to render from" if run.maps else "map"
        raise DataError(
            f"{sequence.name} has no ground truth and {run.folder} has no {missing}, so there is "
            "nothing to evaluate. Evaluate a run with a map, or a source with ground truth."
        )
    trajectories = None if truth is None else compare(run, truth)
    renderings = views.evaluate_rendering(
        sequence, evaluated, run.maps, advance, distance=distance, threads=threads
    )
    rendered = len(evaluated.posed)
    labels = evaluate_labels(
        sequence,
        run,
        evaluated,
        lambda done: advance(rendered + done),
        classes=classes,
        threads=threads,
    )
    pictures = {"trajectory.png": trajectory_picture(run.estimates["final"], truth)}
    if renderings:
        pictures["rendering.png"] = sheet_of_newest(run, sequence, renderings, threads)
    if labels and (sheet := sheet_of_labels(run, sequence, labels[-1], threads)) is not None:
        pictures["labels.png"] = sheet
    drawn, calls = draw(run.folder, pictures), calls_per_frame(run)
    missing = missing_labels(run, sequence)
    loop_errors = None if truth is None else run_loop_errors(run, sequence, truth)
    return Results(
        *(trajectories, evaluated, renderings, labels, missing, run.counts(), calls, drawn),
        loops=loop_errors,
    )


def work(run: FinishedRun, sequence: Sequence) -> int:
    """Return the total number of frames that `evaluate_run` reports to `advance`.

    A frame counts once for its rendering, and a second time if its labels are evaluated.
    """
    labelled = has_labels(run) and sequence.true_labels() is not None
    return len(EvaluatedFrames.of(run.frames).posed) * (1 + labelled)


def has_labels(run: FinishedRun) -> bool:
    """Return whether at least one map of the run has labels."""
    return any(posed.semantics is not None for posed in run.maps)


def missing_labels(run: FinishedRun, sequence: Sequence) -> str:
    """Return the reason why labels are not evaluated, as a text.

    The text is empty if the labels are evaluated. It is also empty if the run has no map, or if
    neither the map nor the source has labels.
    """
    try:
        has_truth = sequence.true_labels() is not None
    except DataError as error:
        return str(error)
    if has_labels(run) and not has_truth:
        return NO_TRUTH
    return NO_LABELS if run.maps and has_truth and not has_labels(run) else ""


def calls_per_frame(run: FinishedRun) -> float | None:
    """Return the labeller calls per frame; None if the run did not record them."""
    if run.vlm_calls is None or not run.frames:
        return None
    return run.vlm_calls / len(run.frames)


def run_loop_errors(run: FinishedRun, sequence: Sequence, truth: Trajectory) -> LoopErrors | None:
    """Score the loop closures of a run; return None if loop closing was off."""
    if run.loops is None:
        return None
    return evaluate_loops(run.loops, seen_keyframes(run.keyframes, sequence, truth))


def compare(run: FinishedRun, truth: Trajectory) -> dict[str, TrajectoryErrors]:
    """Score each estimated trajectory against the ground truth.

    Returns:
        Errors over all frames with a pose, by name of the estimate. If some of these frames do not
        have the status OK, the key "NAME, OK frames" has the errors over the OK frames alone.
    """
    rows = {}
    for name, estimate in run.estimates.items():
        rows[name] = evaluate_trajectory(estimate, truth)
        trusted = at_stamps(estimate, run.stamps_s("OK"))
        if len(trusted) != len(estimate):
            rows[f"{name}, OK frames"] = evaluate_trajectory(trusted, truth)
    return rows


def sheet_of_newest(
    run: FinishedRun, sequence: Sequence, renderings: list[RenderingErrors], threads: int
) -> np.ndarray:
    """Draw the contact sheet of the last map of a run, [H, W, 3] uint8.

    The sheet shows held-out frames, or training frames if no frame was held out.
    """
    newest = run.maps[-1]

    def view(index: int) -> RenderedView:
        return view_of(sequence[index], newest, run.frame(index), threads)

    return rendering_sheet(next(row for row in renderings if row.map == newest.name), view)


def draw(folder: Path, pictures: dict[str, np.ndarray]) -> list[Path]:
    """Save pictures to a folder, and return the paths of their files.

    The keys of `pictures` are the file names.

    Raises:
        ConfigError: If a file cannot be written.
    """
    try:
        for name, picture in pictures.items():
            save_picture(folder / name, picture)
    except OSError as error:
        raise ConfigError(
            f"the results cannot be written to {folder}: {error}. Free some disk space, or make "
            "the folder writable."
        ) from error
    return [folder / name for name in pictures]


def to_json(results: Results) -> dict[str, Any]:
    """Return all results as values for JSON, with the scores of each frame.

    Numbers that are not finite become null.
    """
    trajectories = results.trajectories
    return {
        "protocol": {
            "trajectory": trajectory.PROTOCOL,
            "rendering": views.PROTOCOL,
            "loops": loops.PROTOCOL,
            "labels": semantics.PROTOCOL,
            "frames": results.evaluated.counts(),
        },
        "frames": asdict(results.counts),
        "trajectory": trajectories and {k: _plain_errors(v) for k, v in trajectories.items()},
        "rendering": [_plain_rendering(row) for row in results.renderings],
        "labels": [plain_labels(row) for row in results.labels],
        "vlm_calls_per_frame": results.vlm_calls_per_frame,
        "loops": results.loops and _plain_loops(results.loops),
        "pictures": [str(path) for path in results.pictures],
    }


def _plain_errors(errors: TrajectoryErrors) -> dict[str, Any]:
    return {**asdict(errors), "T_truth_estimate": errors.T_truth_estimate.tolist()}


def _plain_loops(errors: LoopErrors) -> dict[str, Any]:
    return {**asdict(errors), "precision": errors.precision, "recall": errors.recall}


def _plain_rendering(row: RenderingErrors) -> dict[str, Any]:
    return {
        "map": row.map,
        "protocol": row.protocol,
        "frames": len(row.views),
        "mean": {figure: finite(row.mean(figure)) for figure in FIGURES},
        "median": {figure: finite(row.median(figure)) for figure in FIGURES},
        "per_frame": [
            {"frame": view.frame, **{f: finite(getattr(view, f)) for f in FIGURES}}
            for view in row.views
        ],
    }
