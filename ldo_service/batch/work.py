"""Processing of one recording of a batch: copying, SLAM, evaluation, export and publication."""

import json
import logging
import resource
import socket
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from ldo_service import __version__
from ldo_service.config import Config, actor_parameters
from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError, LdoError
from ldo_service.evaluation.finished_run import RunFrame
from ldo_service.evaluation.lpips import Lpips
from ldo_service.evaluation.results import Results, evaluate_run, to_json
from ldo_service.evaluation.sheet import VIEWS
from ldo_service.evaluation.views import EvaluatedFrames
from ldo_service.geometry.sequence import Sequence
from ldo_service.runs.export import export_map
from ldo_service.runs.finished import newest_map, read_run
from ldo_service.runs.folder import EXPORTED, RunWriter
from ldo_service.runs.front_end import FrontEnd
from ldo_service.runs.job import RunOptions
from ldo_service.runs.networks import labelled_by, require_usable_networks
from ldo_service.runs.offline import run_offline
from ldo_service.runs.source import Selection

from .job import BatchJob, Costs, Outcome, RunPlan, failed
from .results import EVALUATION, ResultFolder
from .sources import SYNTHETIC
from .staging import staging_folder
from .store import open_store, reason_of

MAX_NOTES = 20
SUMMARY = ("frames", "frames_rejected", "status", "keyframes", "gaussians", "objects", "fps")


class _Notes(logging.Handler):
    """Collector of the warnings of a run."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.found: list[str] = []

    def add(self, text: str) -> None:
        """Keep a warning, unless MAX_NOTES warnings are kept already."""
        if len(self.found) < MAX_NOTES:
            self.found.append(" ".join(str(text).split()))

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the message of a warning that was logged."""
        self.add(record.getMessage())


def process(job: BatchJob) -> Outcome:
    """Process a recording and publish its results.

    The function runs in a process of its own. It raises no exception: a failure becomes an outcome
    with one line of text. A failure therefore does not stop the batch, and no executor retries it.
    """
    if job.version != __version__:
        return failed(
            job,
            f"{socket.gethostname()} has LDO-SLAM {__version__}, but the batch was started with "
            f"{job.version}. Install the same version on all hosts.",
        )
    cv2.setNumThreads(job.plan.threads or cv2.getNumberOfCPUs())
    try:
        folder = ResultFolder.of(job)
        # A worker may be lost after it has published its results; then the retry has nothing to do.
        kept = None if job.repeats else folder.finished()
        return kept or _process(job, folder)
    except LdoError as error:
        return failed(job, str(error))
    except MemoryError:
        return failed(job, "the memory of the host is exhausted. Use fewer --workers.")
    except OSError as error:
        return failed(
            job,
            f"a file cannot be read or written: {reason_of(error)}. Free some disk space, or "
            "choose another folder with --staging.",
        )
    except Exception as error:
        unexpected = failed(
            job, f"unexpected {type(error).__name__}: {error}. Please report it with the traceback."
        )
        return msgspec.structs.replace(unexpected, notes=(traceback.format_exc(),))


def _process(job: BatchJob, folder: ResultFolder) -> Outcome:
    started_s = time.perf_counter()
    source = job.recording.source
    is_remote = not source.startswith(SYNTHETIC) and not open_store(source).is_local
    staged_bytes = job.recording.size_bytes if is_remote else 0
    with (
        staging_folder(Path(job.staging), staged_bytes, job.max_staged_bytes) as work,
        _collected_notes() as notes,
    ):
        if is_remote:
            source = _download(source, work / "source")
        made = work / "result"
        made.mkdir()
        outcome = _run(job, source, made, notes, started_s)
        return folder.publish(made, outcome)


def _download(source: str, target: Path) -> str:
    """Copy a recording to the folder `target`, and return its local path, which keeps its name."""
    store = open_store(source)
    target.mkdir()
    store.download(target / store.name)
    return str(target / store.name)


def _run(job: BatchJob, source: str, made: Path, notes: _Notes, started_s: float) -> Outcome:
    """Run SLAM on a recording, evaluate and export it; write all files to the folder `made`."""
    plan = job.plan
    config = replace(plan.config, mapper=replace(plan.config.mapper, threads=plan.threads))
    require_usable_networks(config)
    sequence, selection = (
        open_sequence(source, config.dataset.options()),
        Selection(plan.stride, plan.max_frames),
    )
    before_s = time.process_time()
    record = run_offline(_options(job, sequence, selection, made, notes, config), _ignored)
    run_s = time.process_time()
    results = _evaluate(made, sequence, config, plan, notes)
    evaluated_s = time.process_time()
    for format in plan.exports:
        target = made / EXPORTED[format][0]
        export_map(newest_map(made), format, target, run=made, threads=plan.threads or None)
    used = selection.indices(sequence)
    return Outcome(
        source=job.recording.source,
        name=job.recording.name,
        folder=job.folder,
        status="done",
        notes=tuple(notes.found),
        summary=_summary(record, results),
        pictures=tuple(path.name for path in results.pictures) if results else (),
        costs=Costs(
            wall_s=round(time.perf_counter() - started_s, 3),
            cpu_s=round(time.process_time(), 3),
            run_cpu_s=round(run_s - before_s, 3),
            evaluation_cpu_s=round(evaluated_s - run_s, 3),
            peak_rss_mb=round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
            source_bytes=job.recording.size_bytes,
            result_bytes=0,  # Known when the results are published.
            recording_s=round(float(sequence.stamps_ns[used[-1]] - sequence.stamps_ns[0]) / 1e9, 3),
            host=socket.gethostname(),
        ),
    )


def _options(
    job: BatchJob,
    sequence: Sequence,
    selection: Selection,
    made: Path,
    notes: _Notes,
    config: Config,
) -> RunOptions:
    reused = None
    if job.front_end:
        reused = FrontEnd.open(Path(job.out) / job.front_end, config, sequence, selection)
    return RunOptions(
        *(sequence, made, config, selection, notes.add),
        refine=job.plan.refine,
        front_end=reused,
        keep_front_end=job.keeps_front_end,
    )


def _evaluate(
    made: Path, sequence: Sequence, config: Config, plan: RunPlan, notes: _Notes
) -> Results | None:
    """Evaluate the run, and save its pictures.

    A full evaluation takes a quarter of the CPU time of a recording. If the recording has no ground
    truth and `evaluates_all` of the plan is False, only a few frames are rendered. Such a recording
    gets no eval.json. If the run cannot be evaluated, a note says why.

    Raises:
        ConfigError: The network of LPIPS cannot be used, or a picture cannot be written.
    """
    threads = actor_parameters(config).mapper.thread_count()
    try:
        run = read_run(made)
        run.require_source(sequence)
        is_whole = plan.evaluates_all or sequence.truth() is not None
        frames = None if is_whole else sample(run.frames, VIEWS)
        distance = Lpips(Path(plan.lpips), threads=threads) if plan.lpips else None
        results = evaluate_run(
            run, sequence, _ignored, distance=distance, threads=threads, evaluated=frames
        )
    except ConfigError:
        raise
    except LdoError as error:
        notes.add(f"The run cannot be evaluated: {error}")
        return None
    if is_whole:
        about = {
            "pictures": [path.name for path in results.pictures],
            "lpips": plan.lpips or None,
            "labelled_by": labelled_by(config),
        }
        (made / EVALUATION).write_text(json.dumps({**to_json(results), **about}, indent=1))
    return results


def sample(frames: Iterable[RunFrame], count: int) -> EvaluatedFrames:
    """Select at most `count` frames at even intervals from the frames that have a pose.

    Only held-out frames are selected if there are any; otherwise, training frames are selected.
    """
    whole = EvaluatedFrames.of(frames)
    held_out = tuple(frame for frame in whole.held_out if not frame.is_lost)
    training = tuple(frame for frame in whole.training if not frame.is_lost)
    chosen = held_out or training
    places = np.linspace(0, len(chosen) - 1, min(count, len(chosen))).round().astype(int)
    some = tuple(chosen[place] for place in places)
    return EvaluatedFrames(some, ()) if held_out else EvaluatedFrames((), some)


def _summary(record: RunWriter, results: Results | None) -> dict[str, Any]:
    """Return the values of the table: counts of the run, and the scores of its newest map."""
    summary = {name: record.summary[name] for name in SUMMARY}
    if results and results.trajectories:
        newest = [name for name in ("final", "refined") if name in results.trajectories][-1]
        summary["ate_m"] = results.trajectories[newest].ate_m.rmse
    if results and results.renderings:
        held_out = [row for row in results.renderings if row.protocol == "A held out"]
        row = (held_out or results.renderings)[-1]
        summary |= {
            "psnr_db": row.mean("psnr_db"),
            "psnr_protocol": row.protocol,
            "psnr_frames": len(row.views),
        }
    return summary


@contextmanager
def _collected_notes() -> Iterator[_Notes]:
    notes, log = _Notes(), logging.getLogger("ldo_service")
    log.addHandler(notes)
    propagate, log.propagate = log.propagate, False
    try:
        yield notes
    finally:
        log.removeHandler(notes)
        log.propagate = propagate


def _ignored(_done: int, _total: int | None = None, /) -> None:
    pass
