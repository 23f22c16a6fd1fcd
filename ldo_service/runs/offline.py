"""Offline run over a sequence: actors run on a logical clock, not in real time."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack

from ldo_service.errors import DataError
from ldo_service.schemas import Message

from .actor_run import ActorRun, refinements
from .folder import RunWriter
from .front_end import ACTORS, FrontEnd, FrontEndRecord
from .job import Advance, RunOptions, requests
from .source import FrameReader, interleave_prior
from .summary import Usage


def run_offline(job: RunOptions, advance: Advance) -> RunWriter:
    """Run every actor over the selected frames, and write the results to the folder.

    After the last frame, the map is refitted to keyframes that corrections have moved. It is then
    refined if `job.refine` is not 0. The result does not depend on the load of the machine; see
    `runtime.logical_clock`. An interrupted or failed run leaves partial results, and the summary
    marks the run as interrupted.

    Args:
        job: Options of the run.
        advance: Function that receives the progress.

    Raises:
        DataError: Too few frames can be read.
        StageError: An actor failed.
    """
    with OfflineRun(job, advance) as run:
        try:
            run.stream()
            run.repair()
        finally:
            run.close()
        require_usable(run.record, job.config.offline.max_rejected_ratio)
        if job.refine:
            run.refine()
    return run.record


class OfflineRun:
    """Offline run as a context manager.

    The caller calls its phases in this order: `stream`, `repair`, `close`, and optionally `refine`.
    """

    def __init__(self, job: RunOptions, advance: Advance) -> None:
        self._job, self._advance, self._work = job, advance, job.work
        self._frames = job.selection.indices(job.sequence)
        self._reader = FrameReader(job.sequence, self._frames, job.warn)
        self._kept: FrontEndRecord | None = None
        without = ACTORS if job.front_end else ()
        self._actors = ActorRun(job.config, job.folder, without, self._keep)
        self.record = self._actors.record
        self._started = Usage.now()
        self._is_finished = False

    def __enter__(self) -> "OfflineRun":
        self._actors.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._actors.__exit__(*error)

    def stream(self) -> None:
        """Process every selected frame.

        If `keep_front_end` is set, record the outputs of frame source, tracker and detector.
        """
        job = self._job
        frames = interleave_prior(self._reader, job.prior)
        with ExitStack() as kept:
            if job.keep_front_end:
                record = FrontEndRecord(job.folder, job.config, job.sequence, job.selection)
                self._kept = kept.enter_context(record)
            self._run(self._recorded_messages(job.front_end) if job.front_end else frames)
        self._kept = None
        self._actors.keep_step_times()

    def repair(self) -> None:
        """Refit the map to keyframes that corrections of the pose graph have moved."""
        if due := self._actors.pending_iterations:
            self._work += requests(due)
            self._run(refinements(due, self.record.newest_stamp_ns))
        self._is_finished = True

    def close(self) -> None:
        """Write the results and the summary of all frames processed so far."""
        front_end = self._job.front_end
        rejected = front_end.rejected if front_end else self._reader.rejected
        summary = self._actors.summary(
            len(self._frames),
            rejected,
            Usage.now().since(self._started),
            is_finished=self._is_finished,
        )
        self.record.close(summary)

    def refine(self) -> None:
        """Refine the map by `RunOptions.refine` iterations, and write it to a folder of its own."""
        self._run(refinements(self._job.refine, self.record.newest_stamp_ns))
        self.record.write_refined(self._job.refine)

    def _run(self, source: Iterable[Message | tuple[Message, ...]]) -> None:
        for tick in self._actors.run(source):
            done = tick + 1 + self._reader.rejected
            self._advance(min(done, self._work), self._work)

    def _recorded_messages(self, front_end: FrontEnd) -> Iterator[tuple[Message, ...]]:
        for messages in front_end:
            for message in messages:
                self.record.observe(message, step_ms=0.0)
            yield messages

    def _keep(self, message: Message, tick: int) -> None:
        if self._kept:
            self._kept.observe(message, tick)


def require_usable(record: RunWriter, max_rejected: float) -> None:
    """Check that enough frames could be used.

    Args:
        record: The finished run.
        max_rejected: Maximum fraction of rejected frames.

    Raises:
        DataError: The fraction of rejected frames exceeds `max_rejected`.
    """
    frames, rejected = record.summary["frames"], record.summary["frames_rejected"]
    if rejected > max_rejected * frames:
        raise DataError(
            f"{rejected} of {frames} frames could not be used, more than "
            f"offline.max_rejected_ratio={max_rejected:g} allows. The results of the other frames "
            f"are in {record.folder}. Check the data, or raise the setting."
        )
